"""The driver as a process: what it adds to a sample's way, and what it costs.

    python -m benchmarks.driver [SECONDS]

A device of its own process sends the messages of an x-IMU3 over TCP, each at its time and with it; the
driver publishes them, and a subscriber compares with the time at which they come.
"""

import os
import socket
import subprocess
import sys
import tempfile
import time

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Imu

from benchmarks.acceleration_field_live import cpu_seconds
from benchmarks.table import RESULTS
from imu_fusion.messages.layouts import IMU
from imu_fusion.nodes.flow.qos import sensor_qos
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.sources.source import EPOCH

RATES = (200, 1000)   # Hz
SETTLED = 3.0         # s, that are not counted


def device(rate, seconds):
    """Send samples whose device time is that at which they leave, in us since 1.6e9 s."""
    listener = socket.create_server(("127.0.0.1", 0))
    print(listener.getsockname()[1], flush=True)
    connection, _ = listener.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    began = time.time()
    for k in range(round(rate * seconds)):
        time.sleep(max(began + k / rate - time.time(), 0.0))
        us = (time.time_ns() - EPOCH) // 1000
        connection.sendall(b"I,%d,1.5,2.5,3.5,0.01,0.02,1\r\n" % us)
    sys.stdin.readline()


def once(rate, seconds):
    """(delays (n,) s, share of a core that the driver takes, samples lost) of one run."""
    came = []
    with (tempfile.TemporaryDirectory() as logs, NodeProcesses(logs) as nodes,
          subprocess.Popen([sys.executable, "-m", "benchmarks.driver", "--device", str(rate),
                            str(seconds)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                           text=True) as sender):
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=nodes.domain)
        node = rclpy.create_node("subscriber", context=context)
        node.create_subscription(Imu, "imu/data_raw", lambda cdr: came.append(
            (time.time_ns(), cdr)), sensor_qos(), raw=True)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        nodes.start("driver", source="ximu3", stamp_source="device_raw", wait_for_subscribers=1,
                    transport=f"tcp://127.0.0.1:{sender.stdout.readline().strip()}")
        process = nodes.process("driver")
        began, spent = None, None
        while began is None or time.monotonic() < began + seconds - 0.5:
            executor.spin_once(timeout_sec=0.1)
            if began is None and came:
                began = time.monotonic()
            if began is not None and spent is None and time.monotonic() > began + SETTLED:
                spent = time.monotonic(), cpu_seconds(process)
        share = (cpu_seconds(process) - spent[1]) / (time.monotonic() - spent[0])
        sender.stdin.write("\n")
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    times = np.array([at for at, _ in came])
    stamps, _, _ = IMU.decode_many([cdr for _, cdr in came])
    settled = stamps > stamps[0] + SETTLED * 1e9
    lost = int(np.sum(np.round(np.diff(stamps) * 1e-9 * rate) - 1))
    return (times - stamps)[settled] * 1e-9, share, max(lost, 0)


def main(seconds=20):
    """Run and write the table."""
    lines = [f"`python -m benchmarks.driver {seconds}`: x-IMU3 over TCP, driver and subscriber as "
             f"processes of their own, best effort, {os.cpu_count()} cores. Delays are from the "
             "device's sending to the subscriber's callback. Load: processes that want a core.", "",
             "| rate Hz | delay ms: p50 | p99 | CPU of the driver, % of a core | intervals with a "
             "sample missing or late by one | load |", "|---|---|---|---|---|---|"]
    for rate in RATES:
        delays, share, lost = once(rate, float(seconds))
        p50, p99 = 1e3 * np.percentile(delays, [50, 99])
        lines.append(f"| {rate} | {p50:.2f} | {p99:.2f} | {100 * share:.0f} | {lost} of "
                     f"{len(delays)} | {os.getloadavg()[0]:.1f} |")
        print(lines[-1], flush=True)
    (RESULTS / "driver.md").write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--device"]:
        device(float(sys.argv[2]), float(sys.argv[3]))
    else:
        main(*sys.argv[1:])
