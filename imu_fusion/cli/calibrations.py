"""``imu_fusion calibrate``: sensors and their noise from recordings."""

import click
from rich.table import Table

from imu_fusion.cli.common import console, end, warn


@click.group()
def calibrate() -> None:
    """Calibrate a sensor from a recording, as a parameter file."""


out_option = click.option("--out", type=click.Path(), help="Parameter file to write.")
imu_topic_option = click.option("--topic", default="imu/data_raw", show_default=True,
                                help="Its topic in BAG.")


def _begin(bag: str, *outs: str | None) -> list[str]:
    """Refuse to write over the recording; returns what takes texts on what it lacks."""
    from imu_fusion.recordings.targets import refuse_files
    for out in outs:
        if out is not None:
            refuse_files([bag], out)
    return []


def _show_calibration(title, rows, remarks, text, out, lost):
    """Print what a calibration says of itself; its parameter file goes to ``out`` or is shown.
    lost: texts on what of the recording cannot be read."""
    table = Table(title, "")
    for name, value in rows:
        table.add_row(name, value)
    console.print(table)
    warn(dict.fromkeys([*lost, *remarks]))
    if out is None:
        click.echo(text)
    else:
        from imu_fusion.recordings.targets import whole_file
        with whole_file(out, text.partition(", ")[0]) as file:    # a calibration of the same
            file.write_text(text)
        click.echo(f"written: {out}")
    end(bool(lost))


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
    lost = _begin(bag, out)
    found, remarks = inertial.calibrate_recorded_accelerometer(bag, topic, lost.append)
    _show_calibration("accelerometer", inertial.linear_report("accelerometer", found), remarks,
                      inertial.linear_parameters("accelerometer", found, bag), out, lost)


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
    lost = _begin(bag, out)
    found, remarks = inertial.calibrate_recorded_gyroscope(bag, topic, angle, lost.append)
    _show_calibration("gyroscope", inertial.linear_report("gyroscope", found), remarks,
                      inertial.linear_parameters("gyroscope", found, bag), out, lost)


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
    lost = _begin(bag, out, plot)
    found, remarks = noise.recorded_noise(bag, topic, mag_topic, lost.append)
    if plot is not None:
        from imu_fusion.recordings.targets import whole_file
        with whole_file(plot, "<") as file:
            noise.write_plot(found, file)
        click.echo(f"written: {plot}")
    _show_calibration("noise, x, y, z", [row for s in found for row in noise.noise_report(s)],
                      remarks, noise.noise_parameters(found, bag), out, lost)


@calibrate.command("magnetometer")
@click.argument("bag", type=click.Path())
@click.option("--topic", default="imu/mag", show_default=True, help="Its topic in BAG.")
@out_option
def calibrate_magnetometer(bag: str, topic: str, out: str | None) -> None:
    """Hard and soft iron from BAG, in which the sensor turned about all axes.

    Prints how well it is determined, and calibration.mag_matrix and calibration.mag_bias as the
    orientation estimator and the smoother take them.
    """
    from imu_fusion.calibrate import magnetometer
    lost = _begin(bag, out)
    found, remarks = magnetometer.calibrate_recorded_magnetometer(bag, topic, lost.append)
    _show_calibration("magnetometer", magnetometer.magnetometer_report(found), remarks,
                      magnetometer.magnetometer_parameters(found, bag), out, lost)
