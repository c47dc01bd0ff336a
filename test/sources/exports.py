"""What phones give, made for tests: exports of phyphox and Sensor Logger, and their servers."""

import io
import json
import zipfile

import numpy as np

from imu_fusion.sources.source import STANDARD_GRAVITY

PHONE = {"Accelerometer": ("Acceleration", "m/s^2", 0.01, 0.0, (0.1, -2.5, 9.75)),
         "Gyroscope": ("Gyroscope", "rad/s", 0.012, 0.004, (0.25, 0.5, -1.5)),
         "Magnetometer": ("Magnetic field", "µT", 0.02, 0.0, (20.0, -3.5, -40.0))}
TIME = ('"event","experiment time","system time","system time text"\n'
        '"START",0.0E0,1770000000.250,"2026-02-02"\n"PAUSE",.5E0,1770000000.750,""\n'
        '"START",.5E0,1770000100.750,""\n')


def readings(step, start, first):
    """(times, rows) of one sensor of a phone for a second; values of 9 digits."""
    times = np.round(start + step * np.arange(int(1 / step)), 9)
    return times, np.round(np.array(first) + np.outer(np.sin(7 * times), [0.3, 0.2, 0.1]), 7)


def export(delimiter=",", decimal=".", clock=TIME, long_names=True):
    """{part: bytes} of a phyphox export."""
    def cell(v):
        return f"{v:.9E}".replace(".", decimal)

    files = {}
    for name, (label, unit, step, start, first) in PHONE.items():
        times, rows = readings(step, start, first)
        prefix = f"{label} " if long_names else ""
        axes = "xyz" if long_names else "XYZ"
        lines = [delimiter.join(['"Time (s)"', *(f'"{prefix}{a} ({unit})"' for a in axes)])]
        lines += [delimiter.join(map(cell, (t, *row))) for t, row in zip(times, rows)]
        files[f"walk/{name}.csv"] = "\n".join(lines).encode() + b"\n"
    if clock:
        files["walk/meta/time.csv"] = clock.encode()
    return files


class Server:
    """phyphox's remote interface, as its documentation words it: answers to paths."""

    def __init__(self, clock=1770000000.25):
        self.buffers, self.outputs = {}, {}
        for source, name in (("accelerometer", "Accelerometer"), ("gyroscope", "Gyroscope"),
                             ("magnetic_field", "Magnetometer")):
            times, rows = readings(*PHONE[name][2:])
            for axis, values in zip("xyzt", (*rows.T, times)):
                self.buffers[f"{source[:3]}{axis}"] = values
            self.outputs[source] = [{axis: f"{source[:3]}{axis}"} for axis in "xyzt"]
        self.clock, self.session, self.now, self.measuring = clock, "aa11", 0.0, True

    def answer(self, path):
        if path == "/config":
            return {"title": "All", "inputs": [{"source": s, "outputs": o}
                                               for s, o in self.outputs.items()]}
        if path == "/time":
            return [{"event": "START", "experimentTime": 0.0, "systemTime": self.clock}]
        buffers = {}
        for item in path.partition("?")[2].split("&"):
            name, _, wanted = item.partition("=")
            threshold, _, reference = wanted.partition("%7C")
            times = self.buffers[(reference or name)[:3] + "t"]
            shown = times <= self.now
            if threshold != "full":
                shown &= times > float(threshold)
            buffers[name] = {"size": 0, "updateMode": "full" if threshold == "full" else "partial",
                             "buffer": [float(v) for v in self.buffers[name][shown]]}
        return {"buffer": buffers, "status": {"session": self.session,
                                              "measuring": self.measuring}}


def poll(source, server):
    path = source.request()
    return source.feed(json.dumps(server.answer(path)).encode(), path)


def sensor_logger(platform="ios", standardised=False, **without):
    """{part: bytes} of a Sensor Logger export; the phone lies flat, its top is pushed."""
    times = 1_698_501_144_401_773_000 + 10_000_000 * np.arange(60)
    sign = -1.0 if platform == "ios" and not standardised else 1.0
    head = "time,seconds_elapsed,z,y,x\n"

    def rows(value, shift=0):
        return head + "".join(f"{t + shift},{1e-2 * k},{value[2]},{value[1]},{value[0]}\n"
                              for k, t in enumerate(times))

    meta = ("version,device name,recording epoch time,platform,appVersion,standardisation\n"
            f"3,Phone,1698501144400,{platform},1.64,{str(standardised).lower()}\n")
    files = {
        "Metadata": meta, "Accelerometer": rows([0.0, sign * 0.5, 0.0]),
        "Gravity": rows([0.0, 0.0, sign * STANDARD_GRAVITY]),
        "Gyroscope": rows([0.1, 0.2, 0.3], 3_000_000),
        "Magnetometer": rows([20.0, 0.0, -40.0]),
        "Location": "time,seconds_elapsed,bearingAccuracy,speedAccuracy,verticalAccuracy,"
                    "horizontalAccuracy,speed,bearing,altitude,longitude,latitude\n"
                    f"{times[0] - 90_000_000_000},-90,1,1,1,1,0,0,1,1,1\n"
                    f"{times[5]},.05,1,.5,3,2,4,90,500.5,8.5,47.5\n"
                    f"{times[9]},.09,-1,-1,-1,-1,-1,-1,500.5,8.5,47.5\n"}
    return {f"log/{name}.csv": text.encode() for name, text in files.items()
            if name not in without.get("without", ())}


def batches(size=7):
    """What Sensor Logger pushes of the same session: standardised, of any order within it."""
    files, payload = sensor_logger("android"), []
    for name in ("Accelerometer", "Gravity", "Gyroscope", "Magnetometer"):
        for line in files[f"log/{name}.csv"].decode().splitlines()[1:]:
            stamp, since, z, y, x = line.split(",")
            payload.append((float(since), {"name": name.lower(), "time": int(stamp), "values": {
                "z": float(z), "y": float(y), "x": float(x)}}))
    entries = [entry for _, entry in sorted(payload, key=lambda pair: pair[0])]
    return [json.dumps({"messageId": k, "sessionId": "s", "deviceId": "d",
                        "payload": entries[size * k:size * (k + 1)]}).encode()
            for k in range(-(-len(entries) // size))]


def zipped(files):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, data in files.items():
            archive.writestr(part, data)
    return stream.getvalue()
