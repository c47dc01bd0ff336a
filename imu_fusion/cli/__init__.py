"""The command line: ``imu_fusion --help``.

Every command prints errors of the user in one line and ends with exit code 1;
wrong usage ends with 2; one that SIGINT, SIGTERM or SIGHUP has ended with 130, 143 or 129. Where
something was lost, in a damaged recording or on the way, and the rest was used, the code is 3.
"""

import os
import sys

import click

import imu_fusion
from imu_fusion.cli import calibrations, estimates, files, nodes
from imu_fusion.cli.common import Group
from imu_fusion.signals import Interrupted, interruptible


@click.group(cls=Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(imu_fusion.__version__)
@click.option("--max-chunk-mb", type=click.FloatRange(min=1.0), metavar="MB",
              help="Most that a chunk of a recording may unpack to.  [default: 256, or "
                   "IMU_FUSION_MAX_CHUNK_MB]")
def cli(max_chunk_mb: float | None) -> None:
    """Orientation, acceleration fields and trajectories from inertial sensors."""
    if max_chunk_mb is not None:
        os.environ["IMU_FUSION_MAX_CHUNK_MB"] = f"{max_chunk_mb:g}"    # of the nodes, too


for command in (
        files.info, files.convert, files.describe, estimates.process, estimates.pipeline,
        estimates.report, files.export, files.avaframe, estimates.radar,
        estimates.lengths, calibrations.calibrate, files.translate, nodes.run, nodes.play,
        nodes.record, nodes.demo, nodes.compile_kernels):
    cli.add_command(command)


def main() -> None:
    """Entry point of the console script."""
    try:
        with interruptible():
            cli(prog_name="imu_fusion")
    except Interrupted as signal:
        sys.exit(signal.code)
