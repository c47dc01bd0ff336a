"""Recordings of AvaNodes in and beside avalanches: python -m benchmarks.avanode

Ranges that their authors computed from the fixes and the heights of their terrain lie beside two
descents. While a node lies still, its fixes show by how much they wander.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.integrate import trapezoid

from benchmarks.data import data_path
from benchmarks.table import write_table
from imu_fusion.batch import process
from imu_fusion.calibrate.noise import recorded_noise
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.recordings.avaframe import COLUMNS, export_avaframe
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.convert import convert
from imu_fusion.recordings.inspect import inspect_topics
from imu_fusion.recordings.logs import read_log
from imu_fusion.recordings.radar import read_radar
from imu_fusion.report.radar import read_seen

RADAR = LocalFrame(47.306584, 11.380406, 1900.881)
STILL, MOVING = 0.3, 1.0     # m/s, of the velocities: below one all the while, above the other
AROUND = 3.0, 6.0            # s, left out before and after the motion


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def descent(node, folder):
    """Rows of the table of one node."""
    bag, out = folder / node, folder / f"{node}_smoothed"
    convert(data_path(f"avanode/220222_{node}_avalanche_GPS.txt"), bag)
    process(bag, out)
    raw, smoothed = read_seen(bag, RADAR), read_seen(out, RADAR)
    time, ranges, _ = read_radar(data_path(f"avanode/220222_{node}_radarCS.csv"), raw.start)
    ranges = np.interp(raw.time, time, ranges)
    with open_bag(out) as reader:
        sd = np.sqrt(read_log(reader, "smoother/fix").cov_enu.diagonal(0, 1, 2))
    with open_bag(bag) as reader:
        velocity = read_log(reader, "fix_velocity").vel_world
    moving = raw.time[raw.speed > MOVING]
    before, after = raw.time < moving[0] - AROUND[0], raw.time > moving[-1] + AROUND[1]
    for name, part in (("before", before), ("after", after)):
        # The authors' height of the ground is one number there.
        flat = np.linalg.norm(raw.position[part, :2], axis=1)
        ground = np.median(np.sqrt(ranges[part] ** 2 - flat ** 2))
        of_fixes, of_smoothed = (np.hypot(np.linalg.norm(p[part, :2], axis=1), ground)
                                 for p in (raw.position, smoothed.position))
        wander = rms(raw.range[part] - raw.range[part].mean())
        yield (f"{node}, {np.ptp(raw.time[part]):.0f} s at rest {name} it",
               f"{np.median(np.abs(of_fixes - ranges[part])):.3f}",
               f"{rms(of_smoothed - ranges[part]):.2f}", f"{rms(of_fixes - of_fixes.mean()):.2f}",
               f"{wander:.2f}", "/".join(f"{v:.1f}" for v in np.median(sd[part], axis=0)))
    between = ~before & ~after
    led = trapezoid(velocity[between], raw.time[between], axis=0) - (
        raw.position[after][0] - raw.position[before][-1])
    inside = (raw.time >= moving[0]) & (raw.time <= moving[-1])
    apart = np.abs(smoothed.position - raw.position)[inside] / sd[inside]
    yield (f"{node}, {moving[-1] - moving[0]:.0f} s in motion", "", "", "", "",
           "/".join(f"{v:.1f}" for v in np.median(sd[inside], axis=0))
           + f"; smoothed less fixes at most {apart.max():.1f} of them; the velocities lead "
           + "/".join(f"{v:.1f}" for v in led) + " m away from the fixes")
    count = export_avaframe(out, folder / "ball.csv")
    first = (folder / "ball.csv").read_text().splitlines()
    yield (f"{node}, CSV for AvaFrame", "", "", "", "",
           f"{count} rows; columns as it reads them: "
           f"{'yes' if tuple(first[0].split(',')) == COLUMNS else 'no'}")


def static(name, folder):
    """Text on one IMU log at rest."""
    convert(data_path(f"avanode/{name}Data001.txt"), folder / name)
    (gyr, acc, *_), _ = recorded_noise(folder / name)
    with open_bag(folder / name) as reader:
        said = [finding.text for topic in inspect_topics(reader) for finding in topic.findings
                if "gravity" in finding.text]
    return (f"{name}: gyroscope {np.degrees(gyr.density).max():.4f} deg/s/sqrt(Hz), at rest "
            f"{np.degrees(np.abs(gyr.mean)).max():.2f} deg/s; accelerometer "
            f"{1e3 * acc.density[:2].max() / 9.80665:.2f} mg/sqrt(Hz), norm "
            f"{np.linalg.norm(acc.mean) / 9.80665:.2f} g" + "".join(f" ({text})" for text in said))


def main():
    with TemporaryDirectory() as folder:
        rows = [row for node in ("C07", "C10") for row in descent(node, Path(folder))]
        texts = [static(name, Path(folder)) for name in ("C03L", "C03F")]
    write_table("avanode", (
        "recording", "ranges of the fixes less the authors', m (median)",
        "smoothed less the authors', m (RMS)", "fixes' own wander, horizontal, m (RMS)",
        "fixes' own wander, m (RMS)", "stated e/n/u, m (median)"), rows,
        "Nordkette, 2022-02-22, 10 Hz. Ranges at rest with one height of the ground, as the authors' "
        "are. Logs at rest: " + "; ".join(texts) + ".")


if __name__ == "__main__":
    main()
