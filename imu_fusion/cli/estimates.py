"""Commands that estimate and tell of estimates: process, pipeline, report, radar, lengths."""

import sys
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from imu_fusion.cli.common import (
    console,
    end,
    overwrite_option,
    params_file_option,
    remap_option,
    report_option,
    say,
    warn,
    without_option,
)
from imu_fusion.errors import ImuFusionError


@click.command()
@click.argument("bags", type=click.Path(), nargs=-1, required=True, metavar="BAG...")
@click.argument("out", type=click.Path())
@params_file_option
@without_option
@remap_option
@report_option
@overwrite_option
@click.option("--force", is_flag=True,
              help="Estimate even where the samples make it wrong (see info).")
def process(bags: tuple[str, ...], out: str, with_report: bool, **options: Any) -> None:
    """Run the estimators on BAG without ROS and write the rosbag2 directory OUT.

    An estimator runs if its topics are in the recording. The estimates are those
    that the nodes publish, bit for bit. Of several BAGs the estimates go to OUT/NAME each, and what
    was found, a line each, into OUT/summary.csv.
    """
    if len(bags) > 1:
        end(_process_several(bags, Path(out), with_report, options))
    else:
        console.print(_table(_process(bags[0], Path(out), with_report, options)))
        click.echo(f"written: {out}")
        end(_is_incomplete(out))


def _process(bag, out, with_report, options):
    """The StageReports of one recording."""
    from imu_fusion import batch
    reports, warnings = batch.process(bag, out, progress=say, **options)
    warn(warnings)
    for report in reports:
        if report.skipped:
            say(f"{report.node}: not run, {report.skipped}")
    if with_report:
        _write_report(bag, out, out / "report.html", options["params_file"], options["remap"])
    return reports


def _table(reports):
    """What went in and came out."""
    table = Table("estimator", "topic", "in", "refused", "out")
    for report in reports:
        for topic, count in report.used.items():
            refused = report.refused.get(topic, {})
            table.add_row(report.node, topic, str(count),
                          ", ".join(f"{n} {why}" for why, n in refused.items()) or "0", "")
        for topic, count in report.written.items():
            table.add_row(report.node, topic, "", "", str(count))
    return table


def _process_several(bags, out, with_report, options):
    """Whether something was lost. One that fails does not keep the others; exit code 1 then."""
    from imu_fusion.recordings.summary import names_of, refuse_sources, write_summary
    names = names_of(bags)
    refuse_sources(names, out, options["overwrite"])
    table, failed, incomplete = Table("recording", "estimator", "found"), False, False
    for name, bag in names.items():
        say(f"{bag}:")
        try:
            reports = _process(bag, out / name, with_report, options)
        except ImuFusionError as error:
            say(f"imu_fusion: {error}")
            table.add_row(name, "", f"failed: {error}")
            failed = True
            continue
        incomplete |= _is_incomplete(out / name)
        for report in reports:
            if not report.skipped:
                table.add_row(name, report.node, report.summary or ", ".join(
                    f"{count} on {topic}" for topic, count in report.written.items()))
    console.print(table)
    click.echo(f"written: {write_summary(out, names)}")
    if failed:
        sys.exit(1)
    return incomplete


def _is_incomplete(out):
    from imu_fusion.recordings.results import is_incomplete
    return is_incomplete(out)


@click.command()
@click.argument("bag", type=click.Path())
@click.argument("out", type=click.Path())
@params_file_option
@without_option
@report_option
@remap_option
@overwrite_option
def pipeline(bag: str, out: str, params_file: tuple[str, ...], without: tuple[str, ...],
             with_report: bool, remap: dict[str, str], overwrite: bool) -> None:
    """Replay BAG through ROS 2 nodes, smooth it, record all of it into OUT.

    Each node is a process of an own ROS domain. OUT holds what was played and the estimates,
    the same as those of `process`.
    """
    from imu_fusion.nodes.pipeline import run_pipeline
    run_pipeline(bag, out, params_file, without, remap, overwrite, warn=lambda text: warn([text]))
    click.echo(f"written: {out}")
    if with_report:
        _write_report(bag, out, Path(out) / "report.html", params_file, remap)
    end(_is_incomplete(out))


@click.command()
@click.argument("bag", type=click.Path())
@click.option("--estimates", type=click.Path(), metavar="OUT",
              help="Show the estimates in the recording OUT, and make none.")
@params_file_option
@remap_option
@click.option("--out", type=click.Path(), default="report.html", show_default=True)
@click.option("--figures", type=click.Path(), metavar="FOLDER",
              help="Write each figure into FOLDER, too, as wide as a column of a paper.")
@click.option("--format", "form", type=click.Choice(["svg", "pdf", "png"]), default="svg",
              show_default=True, help="Of the figures.")
def report(bag: str, estimates: str | None, params_file: tuple[str, ...], remap: dict[str, str],
           out: str, figures: str | None, form: str) -> None:
    """Write an HTML report of BAG: what it holds, orientation, trajectory, how sure they are.

    Trajectory and orientation are made for the report, unless --estimates OUT names a
    recording that `process` or `pipeline` has written: then it shows what is in that. A reference
    in BAG shows the errors.
    """
    from imu_fusion.recordings.targets import refuse_files
    refuse_files([bag, estimates, *params_file], out)
    complete = _write_report(bag, estimates, out, params_file, remap, figures, form)
    end(not complete)


def _write_report(bag, estimates, path, params_file, remap, figures=None, form=""):
    """Whether nothing of the recording was lost; figures: folder for files of a form, or None."""
    from imu_fusion.kernels import announced_compiling
    from imu_fusion.report.recording import write_recording_report
    with announced_compiling(say):
        written = write_recording_report(bag, estimates, path, params_file, remap)
    click.echo(f"written: {path}")
    if figures is not None:
        from imu_fusion.report.paper import write_figures
        for file in write_figures(written.sections, figures, form):
            click.echo(f"written: {file}")
    return written.complete


@click.command()
@click.argument("bag", type=click.Path())
@click.option("--place", type=float, nargs=3, required=True, metavar="LAT LON HEIGHT",
              help="Where the radar stands: degrees, and m in the datum of the fixes.")
@click.option("--gates", type=click.Path(), metavar="FILE.csv",
              help="What it saw: columns of time, range (m) and velocity (m/s).")
@click.option("--gate-length", type=click.FloatRange(min=0.1), default=25.0, show_default=True,
              help="Of a range gate, m.")
@click.option("--along-beam", is_flag=True,
              help="Its velocities are those along the beam: project them on the slope.")
@click.option("--surface", type=click.Path(), metavar="FILE",
              help="Terrain, whose heights are taken in place of the trajectory's.")
@click.option("--out", type=click.Path(), default="radar.html", show_default=True)
def radar(bag: str, place: tuple[float, float, float], gates: str | None, gate_length: float,
          along_beam: bool, surface: str | None, out: str) -> None:
    """Compare the trajectory in BAG with a Doppler radar's range gates.

    BAG is what `process` has written, or a recording of fixes with velocities. Writes a
    range-time diagram, and velocities against the way down the slope with the gates projected on
    it.
    """
    from imu_fusion.recordings.targets import refuse_files
    from imu_fusion.report.radar import write_radar_report
    refuse_files([bag, gates, surface], out)
    table = Table("trajectory and radar", "")
    lost: list[str] = []
    for row in write_radar_report(bag, place, out, gates, gate_length, along_beam, surface,
                                  lost.append):
        table.add_row(*row)
    console.print(table)
    click.echo(f"written: {out}")
    warn(lost)
    end(bool(lost))


@click.command()
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
