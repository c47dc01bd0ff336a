"""Make the recordings of this folder from their sources, and the table in README.md.

    python bags/make_bags.py [--source DIR] [--out DIR] [NAME ...]

DIR holds ``broad/``, ``px4_plane/`` and ``drive_0708/`` as README.md describes them;
``broad/`` may hold the public ``data_mat/*.mat`` files of dlaidig/broad instead, and
``drive_0708/`` the files of that name of rtklibexplorer/GNSS_IMU. Running it twice gives the
same messages; the bytes of the files also depend on the version of zstd.
"""

import argparse
import hashlib
import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation
from simulated_recordings import (
    GNSS_FRAME,
    IMU_FRAME,
    STANDARD_GRAVITY,
    WORLD_FRAME,
    simulated_avalanche,
    simulated_head,
    simulated_jump,
)

from imu_fusion.errors import ImuFusionError
from imu_fusion.messages.convert import (
    bool_message,
    fix_message,
    imu_message,
    mag_message,
    pose_message,
    velocity_message,
)
from imu_fusion.messages.layouts import BOOL_TYPE, FIX, IMU, MAG, POSE, TWIST
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.sensors.accelerometer_calibration import calibrate_array

HERE = Path(__file__).resolve().parent

# BROAD gives a sampling rate and no stamps; its recordings start at this arbitrary instant.
BROAD_EPOCH = 1_600_000_000_000_000_000

# sensor_msgs/NavSatStatus
STATUS_FIX, STATUS_GBAS_FIX = 0, 2

FLU_FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
ENU_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Recording:
    """What is known of one recording; ``make(source)`` yields its topics."""

    name: str
    title: str
    origin: str
    licence: str
    licence_file: str
    attribution: str
    sources: tuple
    make: object


def read_broad(path):
    """Samples of one BROAD trial as a mapping, from the npz given here or the public mat file."""
    if path.exists():
        return dict(np.load(path))
    mat = scipy.io.loadmat(path.with_suffix(".mat"), squeeze_me=True)
    names = {"gyr": "imu_gyr", "acc": "imu_acc", "mag": "imu_mag", "quat": "opt_quat",
             "fs": "sampling_rate", "mov": "movement"}
    return {short: np.asarray(mat[name]) for short, name in names.items()}


def broad(trial):
    """Topics of a BROAD trial.

    Source: gyr rad/s, acc m/s^2, mag uT, quaternion w, x, y, z from the sensor to east-north-up.
    Tesla are stored with the 24 bits of mantissa that the source has.
    """
    def make(source):
        data = read_broad(source / "broad" / f"{trial}.npz")
        n = len(data["gyr"])
        stamp = BROAD_EPOCH + np.round(np.arange(n) * (1e9 / float(data["fs"]))).astype(np.int64)
        mag = (data["mag"].astype(np.float64) * 1e-6).astype(np.float32).astype(np.float64)
        quat = np.roll(data["quat"].astype(np.float64), -1, axis=1)
        seen = np.isfinite(quat).all(axis=1)
        moving = data["mov"].astype(bool)
        change = np.flatnonzero(np.r_[True, moving[1:] != moving[:-1]])
        yield "imu/data_raw", IMU.msgtype, [
            (t, imu_message(t, IMU_FRAME, gyr, acc))
            for t, gyr, acc in zip(stamp, data["gyr"].astype(float), data["acc"].astype(float))]
        yield "imu/mag", MAG.msgtype, [
            (t, mag_message(t, IMU_FRAME, m)) for t, m in zip(stamp, mag)]
        yield "reference/pose", POSE.msgtype, [
            (t, pose_message(t, WORLD_FRAME, q)) for t, q in zip(stamp[seen], quat[seen])]
        yield "reference/moving", BOOL_TYPE, [
            (t, bool_message(m)) for t, m in zip(stamp[change], moving[change])]
    return make


def read_csv(path):
    """(stamp (n,) int64, mapping of column name to (n,) float64) of a CSV with a header line."""
    with open(path) as stream:
        names = stream.readline().strip().split(",")
    # Stamps exceed the 53 bits of a float.
    stamp = np.loadtxt(path, delimiter=",", skiprows=1, usecols=0, dtype=np.int64)
    values = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(1, len(names)))
    return stamp, dict(zip(names[1:], values.T))


def columns(table, *names):
    return np.column_stack([table[name] for name in names])


def imu_rows(stamp, table):
    gyr = columns(table, "gyr_x", "gyr_y", "gyr_z")
    acc = columns(table, "acc_x", "acc_y", "acc_z")
    return [(t, imu_message(t, IMU_FRAME, g, a)) for t, g, a in zip(stamp, gyr, acc)]


def velocity_rows(stamp, table):
    velocity = columns(table, "vel_e", "vel_n", "vel_u")
    return [(t, velocity_message(t, WORLD_FRAME, v)) for t, v in zip(stamp, velocity)]


def px4_plane(source):
    """Topics of the flight; the autopilot's own attitude is an estimate, not a reference."""
    folder = source / "px4_plane"
    stamp, imu = read_csv(folder / "imu.csv")
    yield "imu/data_raw", IMU.msgtype, imu_rows(stamp, imu)
    yield "imu/mag", MAG.msgtype, [(t, mag_message(t, IMU_FRAME, m)) for t, m in
                                zip(stamp, columns(imu, "mag_x", "mag_y", "mag_z"))]
    stamp, gnss = read_csv(folder / "gnss.csv")
    yield "fix", FIX.msgtype, [
        (t, fix_message(t, GNSS_FRAME, *position, status=STATUS_FIX))
        for t, position in zip(stamp, columns(gnss, "lat_deg", "lon_deg", "height_m"))]
    yield "fix_velocity", TWIST.msgtype, velocity_rows(stamp, gnss)
    stamp, attitude = read_csv(folder / "onboard_attitude.csv")
    quat = enu_flu_from_euler(columns(attitude, "yaw_deg", "pitch_deg", "roll_deg"))
    yield "onboard_ekf/pose", POSE.msgtype, [
        (t, pose_message(t, WORLD_FRAME, q)) for t, q in zip(stamp, quat)]


def enu_flu_from_euler(yaw_pitch_roll_deg):
    """Quaternions (n, 4) xyzw from forward-left-up to east-north-up.

    Args:
        yaw_pitch_roll_deg: (n, 3) aerospace angles of a forward-right-down body in
            north-east-down: yaw about down, then pitch about right, then roll about forward.
    """
    ned_frd = Rotation.from_euler("ZYX", yaw_pitch_roll_deg, degrees=True)
    return (ENU_NED * ned_frd * FLU_FRD.inv()).as_quat()


def read_public_drive_imu(path):
    """The drive's IMU from the public log, as :func:`read_csv` gives it from the CSV.

    The log has no times but millisecond ticks; the ``.tag`` file beside it says when it began
    and ended. The sensor is mounted with x and y backward and right. Its first and last line
    are incomplete.
    """
    tag = path.with_name(path.name + ".tag").read_bytes()
    whole, fraction = struct.unpack_from("<Id", tag, 64)
    (duration_ms,) = struct.unpack_from("<I", tag, len(tag) - 8)
    lines = path.read_text().splitlines()[1:-1]
    values = np.array([line.split(",") for line in lines], dtype=np.float64)
    ticks = values[:, 6] - values[0, 6]
    since = ticks * (duration_ms * 1e-3 / ticks[-1])
    stamp = whole * 1_000_000_000 + np.round((fraction + since) * 1e6).astype(np.int64) * 1000
    turned = [-1.0, -1.0, 1.0]
    acc = np.round(values[:, :3] * turned * STANDARD_GRAVITY, 5)
    gyr = np.round(np.radians(values[:, 3:6] * turned), 6)
    return stamp, dict(zip(("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"),
                           np.hstack([acc, gyr]).T))


def read_public_drive_gnss(path):
    """The drive's GNSS from the public RTKLIB solution, as :func:`read_csv` gives it."""
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("%")]
    stamp = np.array([f"{row[0].replace('/', '-')}T{row[1]}" for row in rows],
                     dtype="datetime64[ns]").astype(np.int64)
    values = np.array([row[2:] for row in rows], dtype=np.float64)
    names = {"lat_deg": 0, "lon_deg": 1, "height_m": 2, "quality": 3, "sd_n": 5, "sd_e": 6,
             "sd_u": 7, "vel_n": 13, "vel_e": 14, "vel_u": 15}
    table = {name: values[:, column] for name, column in names.items()}
    return stamp, {name: np.round(column, 4) if name.startswith("sd_") else column
                   for name, column in table.items()}


def drive(source):
    """Topics of the drive: the RTK positions with their stated standard deviations."""
    folder = source / "drive_0708"
    if (folder / "imu.csv").exists():
        (stamp, imu), gnss = read_csv(folder / "imu.csv"), read_csv(folder / "gnss.csv")
    else:
        stamp, imu = read_public_drive_imu(folder / "imu_1934.csv")
        gnss = read_public_drive_gnss(folder / "gnss_1934_sf.pos")
    yield "imu/data_raw", IMU.msgtype, imu_rows(stamp, imu)
    stamp, gnss = gnss
    position = columns(gnss, "lat_deg", "lon_deg", "height_m")
    sd_enu = columns(gnss, "sd_e", "sd_n", "sd_u")
    status = np.where(gnss["quality"] == 1, STATUS_GBAS_FIX, STATUS_FIX)
    yield "fix", FIX.msgtype, [
        (t, fix_message(t, GNSS_FRAME, *p, cov_enu=np.diag(sd ** 2), status=s))
        for t, p, sd, s in zip(stamp, position, sd_enu, status)]
    yield "fix_velocity", TWIST.msgtype, velocity_rows(stamp, gnss)


# 60 s hold the whole rest at the start and most of the turning, in a few MB.
MIMU_DURATION = 60.0
MIMU_EPOCH = BROAD_EPOCH


def mimu4444(source):
    """Topics of a board of eight IMUs, turned by hand.

    The accelerometers are calibrated from the static poses that come with the data and turned
    into the axes of chip 0 (those of the board); ``imu/data_raw`` is the mean of the eight
    gyroscopes and of the eight accelerometers.
    """
    data = np.load(source / "mimu4444" / "exp1_dynamic.npz")
    keep = data["t"] < MIMU_DURATION
    stamp = MIMU_EPOCH + np.round(data["t"][keep] * 1e9).astype(np.int64)
    acc = calibrate_array(data["static_means_mps2"], STANDARD_GRAVITY).apply(
        data["acc_counts"][keep] * float(data["acc_lsb_mps2"]))
    gyr = np.radians(data["gyr_counts"][keep] * float(data["gyr_lsb_dps"]))
    gyr = np.einsum("kij,nkj->nki", data["frame_R"].astype(float), gyr - data["gyro_bias_radps"])
    # The 24 bits of mantissa that the calibration has; they compress better.
    acc, gyr = (v.astype(np.float32).astype(np.float64) for v in (acc, gyr.mean(axis=1)))
    yield "imu/data_raw", IMU.msgtype, [
        (t, imu_message(t, IMU_FRAME, g, a)) for t, g, a in zip(stamp, gyr, acc.mean(axis=1))]
    for k in range(acc.shape[1]):
        yield f"accelerometers/imu{k}", IMU.msgtype, [
            (t, imu_message(t, IMU_FRAME, None, a)) for t, a in zip(stamp, acc[:, k])]


def _broad(name, trial, title):
    return Recording(
        name, title, "[dlaidig/broad](https://github.com/dlaidig/broad), trial "
        f"`{trial}`", "CC BY 4.0", "licenses/BROAD_CC-BY-4.0.txt",
        "D. Laidig, M. Caruso, A. Cereatti, T. Seel: BROAD - A Benchmark for Robust Inertial "
        "Orientation Estimation. Data 6(7):72, 2021, doi:10.3390/data6070072. Changed: units, "
        "order of the quaternion, stamps from the sampling rate, format",
        (f"broad/{trial}.npz",), broad(trial))


RECORDINGS = {r.name: r for r in (
    _broad("broad_06_fast_rotation", "06_undisturbed_fast_rotation_A",
           "hand-turned sensor, fast rotations, undisturbed field"),
    _broad("broad_15_fast_translation", "15_undisturbed_fast_translation_A",
           "hand-moved sensor, fast translations, undisturbed field"),
    _broad("broad_28_stationary_magnet", "28_disturbed_stationary_magnet_A",
           "combined motion beside a magnet that stands still"),
    Recording("px4_plane", "fixed-wing model aircraft: taxi, take-off and circuits",
              "[priseborough/InertialNav](https://github.com/priseborough/InertialNav)",
              "BSD-3-Clause", "licenses/InertialNav_BSD-3-Clause.txt",
              "Copyright (c) 2014, Paul Riseborough",
              ("px4_plane/imu.csv", "px4_plane/gnss.csv", "px4_plane/onboard_attitude.csv"),
              px4_plane),
    Recording("drive_0708", "car: hilly residential streets, then tight turns on a parking lot",
              "[rtklibexplorer/GNSS_IMU](https://github.com/rtklibexplorer/GNSS_IMU), "
              "`data/drive_0708`", "BSD-3-Clause", "licenses/GNSS_IMU_BSD-3-Clause.txt",
              "Copyright (c) 2025, rtklibexplorer",
              ("drive_0708/imu.csv", "drive_0708/gnss.csv"), drive),
    Recording("mimu4444", "board of eight IMUs, still, then turned by hand at up to 50 rad/s",
              "[hcarlsso/Self-Calibration-Inertial-Sensor-Arrays-BCD.jl]"
              "(https://github.com/hcarlsso/Self-Calibration-Inertial-Sensor-Arrays-BCD.jl), "
              "experiment 1, first 60 s", "MIT", "licenses/mimu4444_MIT.txt",
              "Copyright (c) 2021 Håkan Carlsson. Changed: units, calibration from the static poses, "
              "axes of all chips turned into those of chip 0, gyroscopes averaged, format",
              ("mimu4444/exp1_dynamic.npz",), mimu4444),
    Recording("jump_simulated", "SIMULATED ski jump on the profile of Oberstdorf HS106: a phone "
              "and a GNSS logger with the errors of Fang et al. (2020), tables 3 to 5; nothing "
              "of it was measured",
              "`imu_fusion.simulation` (ski_jump, jump_sensors), seed 2018", "Apache-2.0",
              "../LICENSE", "imu_fusion maintainers", (), simulated_jump),
    Recording("avalanche_simulated", "SIMULATED ball in an avalanche on a plane of 32 deg: the "
              "sensors of Winkler et al. (2025) with figures of data sheets, an accelerometer "
              "that errs by 3 %; nothing of it was measured",
              "`imu_fusion.simulation` (avalanche, ball_sensors), seed 2013", "Apache-2.0",
              "../LICENSE", "imu_fusion maintainers", (), simulated_avalanche),
    Recording("head_simulated", "SIMULATED blow to a head form with four accelerometers, laid out "
              "as in Rahaman et al. (2019), fig. 4, with errors of ordinary sensors; nothing of "
              "it was measured",
              "`imu_fusion.simulation` (rigid_body_impact), seed 2019", "Apache-2.0",
              "../LICENSE", "imu_fusion maintainers", (), simulated_head),
)}


def write_recording(recording, source, out):
    """Write one recording below ``out``, messages in order of stamp; returns its directory."""
    rows = [(stamp, order, topic, msgtype, cdr)
            for order, (topic, msgtype, messages) in enumerate(recording.make(source))
            for stamp, cdr in messages]
    rows.sort(key=lambda row: row[:2])
    directory = out / recording.name
    with BagWriter(directory, overwrite=True, chunk_size=1024 * 1024) as writer:
        for stamp, _, topic, msgtype, cdr in rows:
            writer.write("/" + topic, msgtype, cdr, int(stamp))
    return directory


def file_hash(path):
    """SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def content_hash(directory):
    """SHA-256 over topic, type, log time and bytes of all messages: independent of zstd."""
    digest = hashlib.sha256()
    with open_bag(directory) as reader:
        for topic, msgtype, log_time, cdr in reader.messages():
            digest.update(f"{topic}\n{msgtype}\n{log_time}\n{len(cdr)}\n".encode())
            digest.update(cdr)
    return digest.hexdigest()


def describe(recording, directory, source):
    """What the table and the tests need to know of a recording that was just written."""
    (path,) = directory.glob("*.mcap")
    with open_bag(directory) as reader:
        topics = {name: {"type": info.msgtype, "count": info.count}
                  for name, info in sorted(reader.topics.items())}
        duration = (reader.end_time - reader.start_time) * 1e-9
    sources = {}
    for name in sorted(recording.sources):
        path_of_source = source / name
        if path_of_source.exists():  # the npz or CSV files, not what replaces them
            sources[name] = file_hash(path_of_source)
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": file_hash(path),
            "content_sha256": content_hash(directory), "duration_s": round(duration, 3),
            "topics": topics, "sources": sources}


BEGIN, END = "<!-- made by make_bags.py: begin -->", "<!-- made by make_bags.py: end -->"


def tables(manifest):
    """The generated part of README.md, from the descriptions of all recordings."""
    lines = []
    for name, recording in RECORDINGS.items():
        entry = manifest.get(name)
        if entry is None:
            continue
        lines += [
            f"### {name}", "", f"{recording.title[0].upper()}{recording.title[1:]}.", "",
            f"- origin: {recording.origin}",
            f"- licence: {recording.licence}, [{recording.licence_file}]({recording.licence_file})",
            f"- attribution: {recording.attribution}",
            f"- file: `{name}/{entry['file']}`, {entry['bytes'] / 1e6:.2f} MB, "
            f"{entry['duration_s']:.1f} s",
            f"- sha256 of the file: `{entry['sha256']}`",
            f"- sha256 of the messages: `{entry['content_sha256']}`",
            *(f"- made from `{path}`, sha256 `{digest}`"
              for path, digest in entry["sources"].items()),
            "", "| topic | type | messages | mean rate |", "|---|---|---|---|"]
        for topic, info in entry["topics"].items():
            rate = f"{(info['count'] - 1) / entry['duration_s']:.2f} Hz"
            if info["type"] == BOOL_TYPE:
                rate = "at changes"
            lines.append(f"| `{topic}` | {info['type'].replace('/msg/', '/')} | {info['count']} "
                         f"| {rate} |")
        lines.append("")
    return "\n".join(lines)


def update_readme(readme, manifest):
    """Replace the generated part of ``readme``."""
    text = readme.read_text()
    head, _, rest = text.partition(BEGIN)
    _, _, tail = rest.partition(END)
    readme.write_text(f"{head}{BEGIN}\n\n{tables(manifest)}\n{END}{tail}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME",
                        help=f"recordings to make, default all: {', '.join(RECORDINGS)}")
    parser.add_argument("--source", type=Path, default=HERE.parent.parent / "shared" / "data",
                        help="folder of the sources (default %(default)s)")
    parser.add_argument("--out", type=Path, default=HERE,
                        help="where to write; README.md and manifest.json there are updated")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(RECORDINGS))
    if unknown:
        parser.error(f"unknown recording {', '.join(unknown)}; known: {', '.join(RECORDINGS)}")
    manifest_path = arguments.out / "manifest.json"
    manifest = json.loads(manifest_path.read_text()) if manifest_path.exists() else {}
    for name in arguments.names or RECORDINGS:
        try:
            directory = write_recording(RECORDINGS[name], arguments.source, arguments.out)
            manifest[name] = describe(RECORDINGS[name], directory, arguments.source)
        except (OSError, ImuFusionError) as error:
            parser.exit(1, f"{name}: {error}\n")
        print(f"{name}: {manifest[name]['bytes'] / 1e6:.2f} MB, "
              f"{sum(t['count'] for t in manifest[name]['topics'].values())} messages")
    manifest_path.write_text(json.dumps(manifest, indent=1, sort_keys=True) + "\n")
    if (arguments.out / "README.md").exists():
        update_readme(arguments.out / "README.md", manifest)


if __name__ == "__main__":
    main()
