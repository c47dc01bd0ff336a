"""Commands between files: info, convert, export, avaframe, describe, translate."""

import sys
from pathlib import Path

import click

from imu_fusion.cli.common import (
    end,
    overwrite_option,
    progress_bar,
    remap_option,
    say,
    warn,
)
from imu_fusion.errors import ParameterError, shown


@click.command()
@click.argument("bag", type=click.Path())
@click.option("--repair", "target", type=click.Path(), metavar="OUT",
              help="Copy all that can be read into a clean recording OUT.")
def info(bag: str, target: str | None) -> None:
    """What is in BAG: topics, rates, gaps, and what looks wrong."""
    from imu_fusion.recordings.bag_reader import open_bag
    from imu_fusion.recordings.inspect import STRETCH, inspect_topics
    from imu_fusion.recordings.losses import read_losses
    from imu_fusion.recordings.repair import repair
    with open_bag(bag) as reader:
        duration = (reader.end_time - reader.start_time) * 1e-9
        click.echo(f"{shown(bag)}: {reader.count} messages, {duration:.1f} s"
                   + (f", {reader.format}" if reader.format else ""))
        losses = read_losses(reader)
        rows = inspect_topics(reader, STRETCH)
        for warning in [*reader.warnings, *losses]:    # reading finds what is damaged inside
            click.echo(f"warning: {warning}")
        click.echo(f"{'topic':<32} {'type':<44} {'messages':>9} {'rate Hz':>9} {'max gap s':>9}")
        for row in rows:
            click.echo(f"{row.topic:<32} {row.msgtype.replace('/msg/', '/'):<44} {row.count:>9} "
                       f"{_number(row.rate, '{:.2f}'):>9} {_number(row.longest_gap, '{:.3f}'):>9}")
        for row in rows:
            for note in row.notes:
                click.echo(f"  {row.topic}: {note}")
    if target:
        counts = repair(bag, target)
        click.echo(f"written: {target} with {sum(counts.values())} messages")
    elif reader.damaged:
        say("imu_fusion info --repair OUT writes a clean copy of what can be read")
    end(reader.damaged)


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


@click.command()
@click.argument("source", type=click.Path())
@click.argument("out", type=click.Path())
@click.option("--topic", "topics", multiple=True, help="Keep only this topic. Repeatable.")
@click.option("--description", "--csv", "description", type=click.Path(), metavar="YAML",
              help="What SOURCE does not tell: columns, units and axes of a table.")
@remap_option
@overwrite_option
def convert(source: str, out: str, topics: tuple[str, ...], description: str | None,
            remap: dict[str, str], overwrite: bool) -> None:
    """Copy the recording SOURCE into the rosbag2 MCAP directory OUT.

    SOURCE is a recording (MCAP, sqlite3, ROS 1), or a file, folder or zip archive of a
    device, recognised by what is in it: phyphox, Sensor Logger, u-blox and NMEA, GPX, x-IMU3,
    PX4 ULog, AvaNode, tables whose header names sensors, axes and units. Another table needs a
    description; `imu_fusion describe` writes a first one. With accelerometers of an array in
    it OUT.yaml becomes the parameter file that process takes. With --remap TOPIC:=OTHER the
    topic OTHER of SOURCE is called TOPIC in OUT.
    """
    from imu_fusion.recordings.convert import convert as convert_file
    done = convert_file(source, out, description, topics, remap, overwrite,
                        progress_bar(f"converting {Path(source).name}"))
    if done.format:
        click.echo(f"{source}: {done.format}")
    click.echo(f"written: {out} with "
               + ", ".join(f"{n} of {topic}" for topic, n in sorted(done.counts.items()))
               + (f", {done.parameter_file}" if done.parameter_file else ""))
    warn(done.warnings)
    end(done.damaged)


@click.command()
@click.argument("bag", type=click.Path())
@click.argument("out", type=click.Path())
@click.option("--topic", "topics", multiple=True, help="Only this topic. Repeatable.")
@click.option("--csv", "forms", flag_value="csv", multiple=True, help="Tables, a row a message.")
@click.option("--tum", "forms", flag_value="tum", multiple=True,
              help="Trajectories: time, position, quaternion.")
@click.option("--gpx", "forms", flag_value="gpx", multiple=True, help="Tracks of fixes.")
def export(bag: str, out: str, topics: tuple[str, ...], forms: tuple[str, ...]) -> None:
    """Write BAG, recorded or estimated, as tables into the new folder OUT.

    A CSV file for each topic, with units in its header and a row for each message; poses
    also as TUM trajectories, fixes as a GPX track; or only what is asked for.
    """
    from imu_fusion.recordings.export import export as export_tables
    lost: list[str] = []
    for name, rows in export_tables(bag, out, topics, forms, lost.append).items():
        click.echo(f"written: {Path(out) / name} with {rows} rows")
    warn(lost)
    end(bool(lost))


@click.command()
@click.argument("bag", type=click.Path())
@click.argument("out", type=click.Path())
@click.option("--crs", metavar="EPSG:CODE", help="Reference system of X and Y; without it they are "
              "east and north of the origin.")
@click.option("--interval", type=click.FloatRange(min=1e-3), default=0.1, show_default=True,
              help="Seconds between rows.")
def avaframe(bag: str, out: str, crs: str | None, interval: float) -> None:
    """Write the smoothed trajectory in BAG as the CSV file OUT for AvaFrame.

    Its comparison of particles reads these columns: X, Y, Z, ux, uy, uz, velocityMag, uAcc,
    trajectoryLengthXY, trajectoryLengthXYZ, time.
    """
    from imu_fusion.recordings.avaframe import export_avaframe
    lost: list[str] = []
    rows = export_avaframe(bag, out, crs, interval, lost.append)
    click.echo(f"written: {out} with {rows} rows")
    warn(lost)
    end(bool(lost))


@click.command()
@click.argument("source", type=click.Path())
@click.option("--out", type=click.Path(), help="File to write; without it, the text is shown.")
@click.option("--overwrite", is_flag=True, help="Replace it.")
def describe(source: str, out: str | None, overwrite: bool) -> None:
    """A first description, in YAML, of the table SOURCE.

    Names and units are read from the header, the rest is guessed from the values: gravity
    and the Earth's field are always there. Each guess is marked. Check it, then
    `imu_fusion convert SOURCE OUT --description YAML`.
    """
    from imu_fusion.recordings.describe import describe as describe_file
    text, said = describe_file(source, out, overwrite)
    if text and out is None:
        click.echo(text, nl=False)
    say(said)


@click.command()
@click.argument("file", type=click.Path())
@click.option("--out", type=click.Path(), help="Parameter file to write; it must not exist.")
def translate(file: str, out: str | None) -> None:
    """Turn FILE, a parameter file of imu_tools, into one of ours.

    Prints it, or writes it to --out. What has no counterpart here is listed with the reason, and so
    are names that are not imu_tools' own: then the exit code is 1.
    """
    from imu_fusion.parameters.file import dump, parameters_for
    from imu_fusion.parameters.imu_tools import translate as translated
    from imu_fusion.streams.registry import STAGES
    result = translated(file)
    text = dump("orientation_estimator", result.values)
    for line in result.left_out:
        say(f"no counterpart: {line}")
    for name in result.unknown:
        say(f"unknown to imu_tools: {name}")
    if out is None:
        click.echo(text, nl=False)
    else:
        try:
            with open(out, "x") as stream:
                stream.write(text)
        except OSError as error:
            raise ParameterError(f"{out}: cannot be written ({error.strerror})") from None
        stage = STAGES["orientation_estimator"]
        parameters_for(stage.params + stage.node_params, stage.node, out)
        say(f"written: {out}")
    if result.unknown:
        sys.exit(1)
