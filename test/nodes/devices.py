"""The devices' side of the driver's tests, each a process of its own:

    python -m test.nodes.devices KIND [OPTION ...]

It prints the address under which the driver finds it, waits for the driver, tells all that it has,
and waits to be ended. ``truth(kind)`` is what its own export holds.
"""

import functools
import http.client
import http.server
import json
import os
import socket
import struct
import sys
import time
import tty

from imu_fusion.sources.description import Description
from imu_fusion.sources.gnss import Receiver
from imu_fusion.sources.phyphox import PhyphoxExport
from imu_fusion.sources.sensor_logger import SensorLoggerExport
from imu_fusion.sources.table import TableSource
from imu_fusion.sources.ximu3 import Ximu3
from test.sources.exports import (
    TIME,
    Server,
    batches,
    export,
    sensor_logger,
)
from test.sources.logs import read, read_parts, together
from test.sources.test_splitting import escaped, nmea, solution

TABLE = {"header": False, "time": {"column": "1", "unit": "us"},
         "gyroscope": {"columns": ["2", "3", "4"], "unit": "deg/s"},
         "accelerometer": {"columns": ["5", "6", "7"], "unit": "g"}}
COUNT = 400
TEN_MINUTES = 600 * 400    # samples at 400 Hz


def lines(count=COUNT):
    """Lines of a table at 200 Hz."""
    return [b"%d,%d,0.5,-%d,0.01,0.02,1\n" % (5000 * k, k % 90, k % 7) for k in range(count)]


def receiver():
    """UBX with NMEA between, and a corrupted frame."""
    broken = bytearray(solution(7))
    broken[30] ^= 0x55
    return b"".join(solution(k % 60) + nmea(f"GPGLL,4717.1,N,00833.9,E,0817{k % 60:02d}.00,A")
                    for k in range(50)) + bytes(broken) + solution(59)


def inertial(count=3 * COUNT, start=0):
    """Binary messages of an x-IMU3 at 400 Hz."""
    return b"".join(escaped(struct.pack("<BQ6f", 0xC9, start + 2500 * k, k % 100, 2, 3, 0, 0, 1))
                    for k in range(count))


def halves():
    """What a device tells before and after a break in the middle of a message."""
    data = inertial()
    return data[:len(data) // 2], data[len(data) // 2:]


def truth(kind):
    """What the device's export of the same session holds: {topic: log}."""
    if kind == "phyphox":
        return read_parts(PhyphoxExport(), export(clock="\n".join(TIME.splitlines()[:2])))
    if kind == "sensor_logger":
        return read_parts(SensorLoggerExport(), sensor_logger("android", without=("Location",)))
    if kind == "table":
        return read(TableSource(Description.from_mapping(TABLE, "t")), b"".join(
            line for k, line in enumerate(lines()) if k % 50 != 49))
    if kind == "vanishing":
        source, (first, second) = Ximu3(), halves()
        blocks = source.feed(first)
        source.restart()    # the message in which it broke is lost
        return together(blocks + source.feed(second))
    return read(Receiver(), receiver()) if kind == "ubx" else read(Ximu3(), inertial())


def say(address):
    """Where the driver finds this device."""
    print(address, flush=True)


def _phyphox():
    server = Server()

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self):
            if self.path.startswith("/get"):
                server.now += 0.05
            data = json.dumps(server.answer(self.path)).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_):
            pass

    listener = http.server.HTTPServer(("127.0.0.1", 0), Handler)
    say(f"http://127.0.0.1:{listener.server_port}?interval=0.01")
    listener.serve_forever()


def _sensor_logger(port):
    say(f"http-push://127.0.0.1:{port}")
    pushed = batches()
    for k in [0, 2, 1, *range(3, len(pushed))]:
        while True:
            try:
                connection = http.client.HTTPConnection("127.0.0.1", int(port), timeout=5)
                connection.request("POST", "/data", pushed[k])
                if connection.getresponse().status == 200:
                    break
            except OSError:
                time.sleep(0.02)    # nobody listens yet


def _serial():
    """A receiver on a pseudo terminal; what is written before somebody reads stays away."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    say(f"serial://{os.ttyname(theirs)}?baud=9600")
    sys.stdin.readline()
    data = receiver()
    for start in range(0, len(data), 37):
        os.write(ours, data[start:start + 37])
        time.sleep(0.0005)
    sys.stdin.readline()


def _tcp(*vanish):
    """An x-IMU3; with ``vanish`` the connection breaks in the middle, and the device comes back."""
    listener = socket.create_server(("127.0.0.1", 0))
    say(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
    for half in halves() if vanish else [inertial()]:
        connection, _ = listener.accept()
        for start in range(0, len(half), 61):
            connection.sendall(half[start:start + 61])
            time.sleep(0.001)
        if not vanish:
            sys.stdin.readline()
        time.sleep(0.05)
        connection.close()
    sys.stdin.readline()


def _long():
    """An x-IMU3 that tells ten minutes, each second of them when it is asked to: a live topic does
    not wait for its subscribers."""
    listener = socket.create_server(("127.0.0.1", 0))
    say(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
    connection, _ = listener.accept()
    rest = b""
    for second in range(600):
        data = rest + inertial(400, 1_000_000 * second)
        connection.sendall(data[:-10])    # its last message ends with the next one
        rest = data[-10:]
        sys.stdin.readline()
    connection.sendall(rest)
    sys.stdin.readline()


def _clock(rate, drift, jump):
    """An x-IMU3 in real time whose clock drifts (ppm), and jumps by so many s in the middle."""
    listener = socket.create_server(("127.0.0.1", 0))
    say(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
    connection, _ = listener.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    began, k, step = time.time(), 0, 1.0 / float(rate)
    while True:
        since = k * step
        time.sleep(max(began + since - time.time(), 0.0))
        us = 1e6 * (100.0 + since * (1.0 + 1e-6 * float(drift))
                    + (float(jump) if since > 1.5 else 0.0))
        # Where it looks (deg/s) tells the time at which it was measured.
        since = time.time() - began
        try:
            connection.sendall(b"I,%d,%.9f,0,0,0,0,1\r\n" % (round(us), since))
        except OSError:
            return
        k += 1


def _udp(port):
    """Lines over UDP, every fiftieth of which is lost on the way."""
    say(f"udp://127.0.0.1:{port}")
    sys.stdin.readline()
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for k, line in enumerate(lines()):
        if k % 50 != 49:
            sender.sendto(line, ("127.0.0.1", int(port)))
        time.sleep(0.0005)
    sys.stdin.readline()


KINDS = {"phyphox": _phyphox, "sensor_logger": _sensor_logger, "ubx": _serial, "ximu3": _tcp,
         "table": _udp, "vanishing": functools.partial(_tcp, "vanish"), "long": _long,
         "clock": _clock}


if __name__ == "__main__":
    KINDS[sys.argv[1]](*sys.argv[2:])
