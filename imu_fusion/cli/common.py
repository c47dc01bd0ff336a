"""What the commands share: errors as one line, options, the table's console."""

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import click
from rich.console import Console

from imu_fusion.errors import INCOMPLETE, ImuFusionError, shown

PASS_ON = {"ignore_unknown_options": True, "allow_extra_args": True}
console = Console(highlight=False)


class Group(click.Group):
    """Turns the package's own errors into one line, without a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except ImuFusionError as error:
            click.echo(f"imu_fusion: {shown(str(error))}", err=True)
            ctx.exit(1)
        except ModuleNotFoundError as error:
            extras = {"rclpy": "ros", "plotly": "report", "matplotlib": "report",
                      "allantools": "calibrate"}
            extra = extras.get((error.name or "").partition(".")[0])
            if extra is None:
                raise
            click.echo(f"imu_fusion: this needs {error.name}: pip install 'imu_fusion[{extra}]'"
                       + (", or source an installed ROS 2 Jazzy" if extra == "ros" else ""),
                       err=True)
            ctx.exit(1)


class ListingCommand(click.Command):
    """A command whose help ends with names that it takes: ``listing``, (title, {name: what})."""

    def __init__(self, *args: Any, listing: tuple[str, Mapping[str, str]], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._title, self._entries = listing

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section(self._title):
            formatter.write_dl(list(self._entries.items()))


def _remaps(_context: click.Context, _option: click.Parameter, values: Iterable[str]
            ) -> dict[str, str]:
    """Absolute names to those in the recording, of the TOPIC:=OTHER arguments."""
    result = {}
    for value in values:
        name, sign, other = value.partition(":=")
        if not (name.strip("/") and sign and other):
            raise click.BadParameter(f"'{value}' is not of the form TOPIC:=OTHER")
        result["/" + name.lstrip("/")] = other
    return result


remap_option = click.option("--remap", multiple=True, metavar="TOPIC:=OTHER", callback=_remaps,
                            help="Use topic OTHER of the recording for TOPIC. Repeatable.")
params_file_option = click.option("--params-file", type=click.Path(), multiple=True, metavar="FILE",
                                  help="ROS 2 parameter file, keyed by node name. Repeatable: the "
                                       "last one that names a value counts.")
without_option = click.option("--without", multiple=True, metavar="NODE",
                              help="Leave an estimator out. Repeatable.")
overwrite_option = click.option("--overwrite", is_flag=True,
                                help="Replace OUT if it is a recording.")
report_option = click.option("--report", "with_report", is_flag=True,
                             help="Write OUT/report.html, too.")


def end(incomplete: bool) -> None:
    """End with INCOMPLETE if something was lost and the rest was used."""
    if incomplete:
        sys.exit(INCOMPLETE)


def warn(texts: Iterable[str]) -> None:
    """Say what looks wrong."""
    for text in texts:
        click.echo(f"warning: {text}", err=True)


def say(text: str) -> None:
    """Say what happens, beside the output."""
    click.echo(text, err=True)


Watch = Callable[[Any, int], Any]


def progress_bar(label: str) -> Watch:
    """What shows how far a command is: a context that passes messages on."""
    return lambda messages, count: click.progressbar(messages, label=label, length=count,
                                                     file=sys.stderr)
