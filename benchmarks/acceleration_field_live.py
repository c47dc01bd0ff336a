"""Four accelerometers at 1 kHz through the node: CPU and loss.

    python -m benchmarks.acceleration_field_live

Replayer, node and recorder are processes of their own, in real time; CPU is that of the node's
process (user and system), and the difference of two durations, so that neither its start nor
other work on the machine counts.
"""

import os
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from benchmarks.table import write_table
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import IMU
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate

NODE = "acceleration_field_estimator"
PRESET = Path(__file__).parents[1] / "config" / "head_four_accelerometers.yaml"
DURATIONS = (5.0, 25.0)  # s


def write_bag(path, names, duration):
    """The paper's impacts, read by its four accelerometers at 1 kHz."""
    motion = simulate(duration=duration)
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    readings += np.random.default_rng(0).normal(0, 0.03, readings.shape)
    with BagWriter(path) as writer:
        for stamp, sample in zip(motion.stamp, readings):
            for name, acc in zip(names, sample):
                writer.write(f"/accelerometers/{name}", IMU.msgtype,
                             imu_message(int(stamp), name, None, acc), int(stamp))
    return len(motion.t)


def cpu_seconds(process):
    """User and system time of a running process so far."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def play(folder, values, duration):
    """(CPU seconds of the node, samples played, samples recorded)."""
    preset = folder / "preset.yaml"
    preset.write_text(yaml.safe_dump(values))
    names = values[NODE]["ros__parameters"]["accelerometers"]["names"]
    count = write_bag(folder / "bag", names, duration)
    with NodeProcesses(folder / "logs") as nodes:
        nodes.start("recorder", out=str(folder / "out"))
        nodes.start(NODE, params_file=preset, qos="reliable")
        nodes.start("replayer", bag=str(folder / "bag"), rate=1.0,
                    wait_for_nodes=("recorder", NODE))
        process, used = nodes.process(NODE), 0.0
        while nodes.process("recorder").poll() is None:
            used = cpu_seconds(process) if process.poll() is None else used
            time.sleep(0.1)
        nodes.wait("recorder", 60)
    with open_bag(folder / "out") as reader:
        return used, count, reader.topics["/acceleration_field/imu"].count


def main():
    """Write the table."""
    values = yaml.safe_load(PRESET.read_text())
    own = values[NODE]["ros__parameters"]
    own["initial"] = {"mode": "given", "angular_velocity": [5.0, 5.0, 5.0]}
    table = []
    for method in ("rigid_body", "ao"):
        own["method"] = method
        found = []
        for duration in DURATIONS:
            with tempfile.TemporaryDirectory() as folder:
                found.append(play(Path(folder), values, duration))
        share = (found[1][0] - found[0][0]) / (DURATIONS[1] - DURATIONS[0])
        table.append([method, f"{100 * share:.0f} %",
                      f"{found[1][1] - found[1][2]} of {found[1][1]}"])
    write_table("acceleration_field_live", ["method", "CPU of one core", "samples lost"], table,
                "Four accelerometers at 1 kHz in, three topics at 1 kHz out, recorder "
                "beside.")


if __name__ == "__main__":
    main()
