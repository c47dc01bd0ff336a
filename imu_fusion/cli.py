"""The command line: ``imu_fusion --help``.

Every command prints errors of the user in one line and ends with exit code 1;
wrong usage ends with 2; one that SIGINT, SIGTERM or SIGHUP has ended with 130, 143 or 129. Where
something was lost, in a damaged recording or on the way, and the rest was used, the code is 3.
"""

import sys
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

import imu_fusion
from imu_fusion import nodes
from imu_fusion.demos import DEMOS
from imu_fusion.errors import INCOMPLETE, ImuFusionError, ParameterError
from imu_fusion.nodes import NODES
from imu_fusion.signals import Interrupted, handled, interrupt

PASS_ON = {"ignore_unknown_options": True, "allow_extra_args": True}
console = Console(highlight=False)


class _Group(click.Group):
    """Turns the package's own errors into one line, without a traceback."""

    def invoke(self, ctx):
        try:
            return super().invoke(ctx)
        except ImuFusionError as error:
            click.echo(f"imu_fusion: {error}", err=True)
            ctx.exit(1)
        except ModuleNotFoundError as error:
            extras = {"rclpy": "ros", "plotly": "report", "allantools": "calibrate"}
            extra = extras.get((error.name or "").partition(".")[0])
            if extra is None:
                raise
            click.echo(f"imu_fusion: this needs {error.name}: pip install 'imu_fusion[{extra}]'"
                       + (", or source an installed ROS 2 Jazzy" if extra == "ros" else ""),
                       err=True)
            ctx.exit(1)


class _ListingCommand(click.Command):
    """A command whose help ends with names that it takes: ``listing``, (title, {name: what})."""

    def __init__(self, *args, listing, **kwargs):
        super().__init__(*args, **kwargs)
        self._title, self._entries = listing

    def format_epilog(self, ctx, formatter):
        with formatter.section(self._title):
            formatter.write_dl(list(self._entries.items()))


class _NodeCommand(_ListingCommand):
    """``--help`` ahead of a node's name is ours, behind it the node's."""

    def parse_args(self, ctx, args):
        if args[:1] in (["--help"], ["-h"]):
            click.echo(ctx.get_help())
            ctx.exit()
        return super().parse_args(ctx, args)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(imu_fusion.__version__)
def cli() -> None:
    """Orientation, acceleration fields and trajectories from inertial sensors."""


def _remaps(values):
    """dict of the NAME:=OTHER arguments."""
    result = {}
    for value in values:
        name, sign, other = value.partition(":=")
        if not (name and sign and other):
            raise click.BadParameter(f"'{value}' is not of the form TOPIC:=OTHER",
                                     param_hint="--remap")
        result[name] = other
    return result


remap_option = click.option("--remap", multiple=True, metavar="TOPIC:=OTHER",
                            help="Use topic OTHER of the recording for TOPIC. Repeatable.")
params_file_option = click.option("--params-file", type=click.Path(), multiple=True, metavar="FILE",
                                  help="ROS 2 parameter file, keyed by node name. Repeatable: the "
                                       "last one that names a value counts.")
without_option = click.option("--without", multiple=True, metavar="NODE",
                              help="Leave an estimator out. Repeatable.")
overwrite_option = click.option("--overwrite", is_flag=True,
                                help="Replace OUT if it is a recording.")


@cli.command("run", cls=_NodeCommand, context_settings=PASS_ON, add_help_option=False,
             short_help="Start one node.",
             listing=("Nodes", {name: node.summary for name, node in NODES.items()}))
@click.argument("node", type=click.Choice(list(NODES)), metavar="NODE")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def start_node(node: str, arguments: tuple[str, ...]) -> None:
    """Start NODE as `ros2 run imu_fusion NODE` would; ARGUMENTS go to it.

    Such as --ros-args -p NAME:=VALUE -r FROM:=TO, or --help for its parameters.
    """
    sys.exit(nodes.main(arguments, node))


@cli.command()
@click.argument("bag", type=click.Path())
@click.argument("out", type=click.Path())
@params_file_option
@without_option
@remap_option
@overwrite_option
@click.option("--force", is_flag=True,
              help="Estimate even where the samples make it wrong (see info).")
def process(bag: str, out: str, params_file: tuple[str, ...], without: tuple[str, ...],
            remap: tuple[str, ...], overwrite: bool, force: bool) -> None:
    """Run the estimators on BAG without ROS and write the rosbag2 directory OUT.

    An estimator runs if its topics are in the recording. The estimates are those
    that the nodes publish, bit for bit.
    """
    from imu_fusion import batch
    from imu_fusion.recordings.results import is_incomplete
    reports, warnings = batch.process(bag, out, params_file, without, _remaps(remap), overwrite,
                                      progress=lambda text: click.echo(text, err=True),
                                      force=force)
    for warning in warnings:
        click.echo(f"warning: {warning}", err=True)
    table = Table("estimator", "topic", "in", "refused", "out")
    for report in reports:
        if report.skipped:
            click.echo(f"{report.node}: not run, {report.skipped}", err=True)
        for topic, count in report.used.items():
            refused = report.refused.get(topic, {})
            table.add_row(report.node, topic, str(count),
                          ", ".join(f"{n} {why}" for why, n in refused.items()) or "0", "")
        for topic, count in report.written.items():
            table.add_row(report.node, topic, "", "", str(count))
    console.print(table)
    click.echo(f"written: {out}")
    if is_incomplete(out):
        sys.exit(INCOMPLETE)


@cli.command()
@click.argument("bag", type=click.Path())
@click.argument("out", type=click.Path())
@params_file_option
@without_option
@click.option("--report", "with_report", is_flag=True, help="Write OUT/report.html, too.")
@remap_option
@overwrite_option
def pipeline(bag: str, out: str, params_file: tuple[str, ...], without: tuple[str, ...],
             with_report: bool, remap: tuple[str, ...], overwrite: bool) -> None:
    """Replay BAG through ROS 2 nodes, smooth it, record all of it into OUT.

    Each node is a process of an own ROS domain. OUT holds what was played and the estimates,
    the same as those of `process`.
    """
    from imu_fusion.nodes.pipeline import run_pipeline
    from imu_fusion.recordings.results import is_incomplete
    run_pipeline(bag, out, params_file, without, _remaps(remap), overwrite)
    click.echo(f"written: {out}")
    if with_report:
        from imu_fusion.report.recording import write_recording_report
        path = Path(out) / "report.html"
        # BAG keeps the times of its messages, OUT has those of the replay, but our names.
        write_recording_report(out if remap else bag, out, path, params_file)
        click.echo(f"written: {path}")
    if is_incomplete(out):
        sys.exit(INCOMPLETE)


@cli.command()
@click.argument("bag", type=click.Path())
@click.option("--repair", "target", type=click.Path(), metavar="OUT",
              help="Copy all that can be read into a clean recording OUT.")
def info(bag: str, target: str | None) -> None:
    """What is in BAG: topics, rates, gaps, and what looks wrong."""
    from imu_fusion.recordings.bag_reader import open_bag
    from imu_fusion.recordings.inspect import inspect_topics
    from imu_fusion.recordings.losses import read_losses
    from imu_fusion.recordings.repair import repair
    with open_bag(bag) as reader:
        duration = (reader.end_time - reader.start_time) * 1e-9
        click.echo(f"{bag}: {reader.count} messages, {duration:.1f} s"
                   + (f", {reader.format}" if reader.format else ""))
        losses = read_losses(reader)
        rows = inspect_topics(reader)
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
        click.echo("imu_fusion info --repair OUT writes a clean copy of what can be read",
                   err=True)
    if reader.damaged:
        sys.exit(INCOMPLETE)


def _tell(done):
    """Say what is wrong with a recording that has been read; end with INCOMPLETE if it was not
    all of it."""
    for warning in done.warnings:
        click.echo(f"warning: {warning}", err=True)
    if done.damaged:
        sys.exit(INCOMPLETE)


def _number(value, form):
    return "" if value is None else form.format(value)


@cli.command()
@click.argument("source", type=click.Path())
@click.argument("out", type=click.Path())
@click.option("--topic", "topics", multiple=True, help="Keep only this topic. Repeatable.")
@click.option("--description", "--csv", "description", type=click.Path(), metavar="YAML",
              help="What SOURCE does not tell: columns, units and axes of a table.")
@remap_option
@overwrite_option
def convert(source: str, out: str, topics: tuple[str, ...], description: str | None,
            remap: tuple[str, ...], overwrite: bool) -> None:
    """Copy the recording SOURCE into the rosbag2 MCAP directory OUT.

    SOURCE is a recording (MCAP, sqlite3, ROS 1), or a file, folder or zip archive of a
    device, recognised by what is in it: phyphox, Sensor Logger, u-blox and NMEA, GPX, x-IMU3,
    PX4 ULog, AvaNode, tables whose header names sensors, axes and units. Another table needs a
    description; `imu_fusion describe` writes a first one. With accelerometers of an array in
    it OUT.yaml becomes the parameter file that process takes. With --remap TOPIC:=OTHER the
    topic OTHER of SOURCE is called TOPIC in OUT.
    """
    from imu_fusion.recordings.convert import convert as convert_file

    def watch(messages, count):
        return click.progressbar(messages, label=f"converting {Path(source).name}",
                                 length=count, file=sys.stderr)

    done = convert_file(source, out, description, topics, _remaps(remap), overwrite, watch)
    if done.format:
        click.echo(f"{source}: {done.format}")
    click.echo(f"written: {out} with "
               + ", ".join(f"{n} of {topic}" for topic, n in sorted(done.counts.items()))
               + (f", {done.parameter_file}" if done.parameter_file else ""))
    _tell(done)


@cli.command()
@click.argument("bag", type=click.Path())
@click.argument("out", type=click.Path())
@click.option("--topic", "topics", multiple=True, help="Only this topic. Repeatable.")
def export(bag: str, out: str, topics: tuple[str, ...]) -> None:
    """Write BAG, recorded or estimated, as tables into the new folder OUT.

    A CSV file for each topic, with units in its header and a row for each message; poses
    also as TUM trajectories, fixes as a GPX track.
    """
    from imu_fusion.recordings.export import export as export_tables
    for name, rows in export_tables(bag, out, topics).items():
        click.echo(f"written: {Path(out) / name} with {rows} rows")


@cli.command()
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
    click.echo(f"written: {out} with {export_avaframe(bag, out, crs, interval)} rows")


@cli.command()
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
    click.echo(said, err=True)


@cli.command(context_settings=PASS_ON)
@click.argument("bag", type=click.Path())
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
@click.option("--rate", type=float, default=1.0, show_default=True,
              help="Speed; 0: as fast as our nodes take it, nothing lost.")
@click.option("--loop", is_flag=True, help="Start over at the end.")
@click.option("--clock", type=float, default=0.0, metavar="HZ", help="Publish /clock; 0: do not.")
@click.option("--start-offset", type=float, default=0.0, help="Seconds to leave out at the start.")
@click.option("--duration", type=float, help="Seconds to play.")
@click.option("--topic", "topics", multiple=True, help="Play only this topic. Repeatable.")
@click.option("--wait-for", "wait_for_nodes", multiple=True, metavar="NODE",
              help="Wait for one of our nodes. Repeatable.")
def play(bag: str, arguments: tuple[str, ...], **options) -> None:
    """Play BAG through the replayer node; further ARGUMENTS go to the node."""
    sys.exit(nodes.main([*_ros_args(bag=str(Path(bag).absolute()), **options), *arguments],
                        "replayer"))


@cli.command(context_settings=PASS_ON)
@click.argument("out", type=click.Path())
@click.argument("topics", nargs=-1)
@click.option("--compression", type=click.Choice(["zstd", "lz4", "none"]), default="zstd",
              show_default=True)
@overwrite_option
def record(out: str, topics: tuple[str, ...], **options) -> None:
    """Record TOPICS (all, if none are given) into the rosbag2 MCAP directory OUT."""
    sys.exit(nodes.main(_ros_args(out=str(Path(out).absolute()), topics=topics, **options),
                        "recorder"))


def _ros_args(**values):
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


@cli.command()
@click.argument("bag", type=click.Path())
@click.option("--estimates", type=click.Path(),
              help="Recording with imu/data or acceleration_field/*, if not in BAG.")
@params_file_option
@click.option("--out", type=click.Path(), default="report.html", show_default=True)
def report(bag: str, estimates: str | None, params_file: tuple[str, ...], out: str) -> None:
    """Write an HTML report of BAG: what it holds, orientation, trajectory, how sure they are.

    The trajectory is smoothed for the report; the orientation, too, unless BAG (or the
    recording of --estimates) holds imu/data. A reference in BAG shows the errors.
    """
    from imu_fusion.kernels import announced_compiling
    from imu_fusion.recordings.targets import refuse_files
    from imu_fusion.report.recording import write_recording_report
    refuse_files([bag, estimates, *params_file], out)
    with announced_compiling(lambda text: click.echo(text, err=True)):
        complete = write_recording_report(bag, estimates, out, params_file).complete
    click.echo(f"written: {out}")
    if not complete:
        sys.exit(INCOMPLETE)


@cli.group()
def calibrate() -> None:
    """Calibrate a sensor from a recording, as a parameter file."""


out_option = click.option("--out", type=click.Path(), help="Parameter file to write.")
imu_topic_option = click.option("--topic", default="imu/data_raw", show_default=True,
                                help="Its topic in BAG.")


def _show_calibration(title, rows, remarks, text, out):
    """Print what a calibration says of itself; its parameter file goes to ``out`` or is shown."""
    table = Table(title, "")
    for name, value in rows:
        table.add_row(name, value)
    console.print(table)
    for remark in remarks:
        click.echo(f"warning: {remark}", err=True)
    if out is None:
        click.echo(text)
    else:
        try:
            Path(out).write_text(text)
        except OSError as error:
            raise ParameterError(f"{out}: cannot be written ({error.strerror})") from None
        click.echo(f"written: {out}")


@calibrate.command("accelerometer")
@click.argument("bag", type=click.Path())
@imu_topic_option
@out_option
def calibrate_accelerometer(bag: str, topic: str, out: str | None) -> None:
    """Matrix and bias from BAG, in which the sensor lay still in many poses.

    The six sides up in turn, or a dozen poses in any directions, a second or more each;
    rests are found by themselves. Gives calibration.acc_matrix and acc_bias.
    """
    from imu_fusion.calibrate import inertial
    found, remarks = inertial.calibrate_recorded_accelerometer(bag, topic)
    _show_calibration("accelerometer", inertial.linear_report("accelerometer", found), remarks,
                      inertial.linear_parameters("accelerometer", found, bag), out)


@calibrate.command("gyroscope")
@click.argument("bag", type=click.Path())
@imu_topic_option
@click.option("--angle", type=float, metavar="DEG",
              help="By which every turn went, about one axis: 360 for once round.")
@out_option
def calibrate_gyroscope(bag: str, topic: str, angle: float | None, out: str | None) -> None:
    """Matrix and bias from BAG, in which the sensor was turned between rests.

    About all axes, six turns or more, still for a second before and after each. Gravity
    before and after tells what the rates must add up to. Gives calibration.gyro_matrix and
    gyro_bias.
    """
    from imu_fusion.calibrate import inertial
    found, remarks = inertial.calibrate_recorded_gyroscope(bag, topic, angle)
    _show_calibration("gyroscope", inertial.linear_report("gyroscope", found), remarks,
                      inertial.linear_parameters("gyroscope", found, bag), out)


@calibrate.command("noise")
@click.argument("bag", type=click.Path())
@imu_topic_option
@click.option("--mag-topic", default="imu/mag", show_default=True, help="Of the magnetometer.")
@click.option("--plot", type=click.Path(), metavar="FILE.html", help="Write the Allan deviations.")
@out_option
def calibrate_noise(bag: str, topic: str, mag_topic: str, plot: str | None, out: str | None
                    ) -> None:
    """White noise, instability and walk from BAG, in which the sensor lay still.

    By the Allan deviation, for the noise that the estimators take; half an hour or more, where
    nobody walks.
    """
    from imu_fusion.calibrate import noise
    found, remarks = noise.recorded_noise(bag, topic, mag_topic)
    if plot is not None:
        noise.write_plot(found, plot)
        click.echo(f"written: {plot}")
    _show_calibration("noise, x, y, z", [row for s in found for row in noise.noise_report(s)],
                      remarks, noise.noise_parameters(found, bag), out)


@calibrate.command("magnetometer")
@click.argument("bag", type=click.Path())
@click.option("--topic", default="imu/mag", show_default=True, help="Its topic in BAG.")
@out_option
def calibrate_magnetometer(bag: str, topic: str, out: str | None) -> None:
    """Hard and soft iron from BAG, in which the sensor turned about all axes.

    Prints how well it is determined, and sensor.mag_offset and sensor.mag_matrix as the
    orientation estimator and the smoother take them.
    """
    from imu_fusion.calibrate import magnetometer
    found, remarks = magnetometer.calibrate_recorded_magnetometer(bag, topic)
    _show_calibration("magnetometer", magnetometer.magnetometer_report(found), remarks,
                      magnetometer.magnetometer_parameters(found, bag), out)


@cli.command(cls=_ListingCommand, listing=("Demos", DEMOS))
@click.argument("name", default="orientation")
@click.option("--out", type=click.Path(), default="demo_out", show_default=True,
              help="Directory for recording and report.")
def demo(name: str, out: str) -> None:
    """Play a recording through the nodes, record, compare with the truth, report."""
    from imu_fusion.demos import run_demo
    run_demo(name, out, console)


@cli.command()
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
        click.echo(f"no counterpart: {line}", err=True)
    for name in result.unknown:
        click.echo(f"unknown to imu_tools: {name}", err=True)
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
        click.echo(f"written: {out}", err=True)
    if result.unknown:
        sys.exit(1)


@cli.command()
@click.argument("table", type=click.Path())
@click.option("--measuring-error", type=click.FloatRange(min=0.0), default=0.0, metavar="M",
              help="Most that a measured length may be off, for the bound of the RMS.")
def lengths(table: str, measuring_error: float) -> None:
    """Compare smoothed jumps with measured lengths.

    TABLE is a CSV file with the columns recording (an OUT of process or pipeline, relative to
    TABLE) and measured (m).
    """
    from imu_fusion.evaluation.jump_length import JumpLengths
    from imu_fusion.recordings.jump_table import read_lengths
    jumps = JumpLengths(*read_lengths(table))
    shown = Table("recording", "estimated m", "σ m", "measured m", "error m")
    for row in zip(jumps.names, jumps.estimated, jumps.sd, jumps.measured, jumps.error):
        shown.add_row(row[0], *(f"{value:.2f}" for value in row[1:4]), f"{row[4]:+.2f}")
    console.print(shown)
    click.echo(f"{len(jumps.names)} jumps: RMS {jumps.rms():.2f} m"
               + (f", at most {jumps.rms(measuring_error):.2f} m where measured lengths are off by "
                  f"up to {measuring_error:g} m" if measuring_error else ""))


@cli.command()
def compile() -> None:
    """Compile the kernels for this machine now, so that no node does when it starts."""
    from imu_fusion.compile_ahead import compile_ahead
    compile_ahead(lambda text: click.echo(text, err=True))


def main() -> None:
    """Entry point of the console script."""
    try:
        with handled(interrupt):
            cli(prog_name="imu_fusion")
    except Interrupted as signal:
        sys.exit(signal.code)


if __name__ == "__main__":
    main()
