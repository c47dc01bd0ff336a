"""A recording with what all estimators take, as long as asked for: for benchmarks of the nodes."""

from pathlib import Path

import numpy as np
import yaml

from imu_fusion.messages.convert import fix_message, imu_message, mag_message
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate

CONFIG = Path(__file__).parents[1] / "config"
NODE = "acceleration_field_estimator"
MOVEMENT = Path(__file__).parents[1] / "bags" / "broad_06_fast_rotation"
IMU_RATE, FIX_RATE = 200, 10  # Hz; the accelerometers have 1 kHz


def write_parameters(path, config=CONFIG):
    """Those of the head with four accelerometers, which is never still here: their names."""
    values = yaml.safe_load((config / "head_four_accelerometers.yaml").read_text())
    values[NODE]["ros__parameters"]["initial"] = {"mode": "given",
                                                  "angular_velocity": [5.0, 5.0, 5.0]}
    path.write_text(yaml.safe_dump(values))
    return values[NODE]["ros__parameters"]["accelerometers"]["names"]


def write_recording(path, names, seconds):
    """Write it: (sorted names of its topics, number of messages).

    The paper's impacts, read by four accelerometers; Imu and magnetometer of a recorded movement,
    resampled in time; fixes of a body at rest.
    """
    motion = simulate(duration=seconds)
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    readings += np.random.default_rng(0).normal(0, 0.03, readings.shape)
    with open_bag(MOVEMENT) as reader:
        imu, mag = read_log(reader, "imu/data_raw"), read_log(reader, "imu/mag")
    first, messages = int(imu.stamp[0]), []
    for stamp, sample in zip((first + motion.stamp - motion.stamp[0]).tolist(), readings):
        messages += [(stamp, f"/accelerometers/{name}", "sensor_msgs/msg/Imu",
                      imu_message(stamp, name, None, acc))
                     for name, acc in zip(names, sample)]
    for i in range(int(seconds * IMU_RATE)):
        stamp = first + round(i * 1e9 / IMU_RATE)
        messages.append((stamp, "/imu/data_raw", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "imu_link", imu.gyr[i], imu.acc[i])))
        messages.append((stamp, "/imu/mag", "sensor_msgs/msg/MagneticField",
                         mag_message(stamp, "imu_link", mag.mag[i])))
    for i in range(int(seconds * FIX_RATE)):
        stamp = first + round(i * 1e9 / FIX_RATE)
        messages.append((stamp, "/fix", "sensor_msgs/msg/NavSatFix",
                         fix_message(stamp, "gnss", 47.0, 11.0, 500.0, np.diag([1.0, 1.0, 4.0]))))
    messages.sort(key=lambda message: message[0])
    with BagWriter(path) as writer:
        for stamp, topic, msgtype, cdr in messages:
            writer.write(topic, msgtype, cdr, stamp)
    return sorted({topic for _, topic, _, _ in messages}), len(messages)
