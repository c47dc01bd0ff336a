"""Commands that start nodes: run, play, record, demo; and compile, ahead of them."""

import sys
from pathlib import Path
from typing import Any

import click

from imu_fusion import nodes
from imu_fusion.cli.common import (
    PASS_ON,
    ListingCommand,
    console,
    overwrite_option,
    remap_option,
    say,
)
from imu_fusion.demos import DEMOS
from imu_fusion.nodes import NODES


class _NodeCommand(ListingCommand):
    """``--help`` ahead of a node's name is ours, behind it the node's."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args[:1] in (["--help"], ["-h"]):
            click.echo(ctx.get_help())
            ctx.exit()
        return super().parse_args(ctx, args)


@click.command("run", cls=_NodeCommand, context_settings=PASS_ON, add_help_option=False,
               short_help="Start one node.",
               listing=("Nodes", {name: node.summary for name, node in NODES.items()}))
@click.argument("node", type=click.Choice(list(NODES)), metavar="NODE")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def run(node: str, arguments: tuple[str, ...]) -> None:
    """Start NODE as `ros2 run imu_fusion NODE` would; ARGUMENTS go to it.

    Such as --ros-args -p NAME:=VALUE -r FROM:=TO, or --help for its parameters.
    """
    sys.exit(nodes.main(arguments, node))


@click.command(context_settings=PASS_ON)
@click.argument("bag", type=click.Path())
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
@click.option("--rate", type=float, default=1.0, show_default=True,
              help="Speed; 0: as fast as our nodes take it, nothing lost.")
@click.option("--loop", is_flag=True, help="Start over at the end.")
@click.option("--clock", type=float, default=0.0, metavar="HZ", help="Publish /clock; 0: do not.")
@click.option("--start-offset", type=float, default=0.0, help="Seconds to leave out at the start.")
@click.option("--duration", type=float, help="Seconds to play.")
@click.option("--topic", "topics", multiple=True, help="Play only this topic. Repeatable.")
@remap_option
@click.option("--wait-for", "wait_for_nodes", multiple=True, metavar="NODE",
              help="Wait for one of our nodes. Repeatable.")
def play(bag: str, arguments: tuple[str, ...], remap: dict[str, str], **options: Any) -> None:
    """Play BAG through the replayer node; further ARGUMENTS go to the node."""
    renamed = tuple(f"{other}:={name}" for name, other in remap.items())
    sys.exit(nodes.main([*_ros_args(bag=str(Path(bag).absolute()), remap=renamed, **options),
                         *arguments], "replayer"))


@click.command(context_settings=PASS_ON)
@click.argument("out", type=click.Path())
@click.argument("topics", nargs=-1)
@click.option("--compression", type=click.Choice(["zstd", "lz4", "none"]), default="zstd",
              show_default=True)
@overwrite_option
def record(out: str, topics: tuple[str, ...], **options: Any) -> None:
    """Record TOPICS (all, if none are given) into the rosbag2 MCAP directory OUT."""
    sys.exit(nodes.main(_ros_args(out=str(Path(out).absolute()), topics=topics, **options),
                        "recorder"))


def _ros_args(**values: Any) -> list[str]:
    """--ros-args that set parameters; what is None or an empty list is left to its default."""
    arguments = ["--ros-args"]
    for name, value in values.items():
        if value is None or value == ():
            continue
        if isinstance(value, tuple):
            value = "[" + ", ".join(f"'{v}'" for v in value) + "]"
        elif isinstance(value, bool):
            value = str(value).lower()
        elif isinstance(value, str):
            value = f"'{value}'"
        arguments += ["-p", f"{name}:={value}"]
    return [*arguments, "--"]


@click.command(cls=ListingCommand, listing=("Demos", DEMOS))
@click.argument("name", default="orientation")
@click.option("--out", type=click.Path(), default="demo_out", show_default=True,
              help="Directory for recording and report.")
def demo(name: str, out: str) -> None:
    """Play a recording through the nodes, record, compare with the truth, report."""
    from imu_fusion.demos import run_demo
    run_demo(name, out, console)


@click.command("compile")
def compile_kernels() -> None:
    """Compile the kernels for this machine now, so that no node does when it starts."""
    from imu_fusion.compile_ahead import compile_ahead
    compile_ahead(say)
