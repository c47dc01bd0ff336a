"""The remote interface of phyphox, by which a running experiment is read over the network.

Protocol: https://phyphox.org/wiki/index.php/Remote_interface_communication.
"""

import json
from urllib.parse import quote

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.sources.phone import LONGEST, UNIX, Phone, locations
from imu_fusion.sources.source import EPOCH, Block, Source
from imu_fusion.sources.times import NANOSECONDS

_TIME_ASKED = 3    # times; versions of phyphox that do not tell count from EPOCH


class PhyphoxLive(Source):
    """The remote interface of a running experiment: feed it what was asked for, under the path
    that :meth:`request` gave."""

    def __init__(self, strict: bool = False) -> None:
        super().__init__(strict)
        self.restart()

    def restart(self) -> None:
        """Ask anew which buffers there are."""
        self._phone = Phone()
        self._buffers: dict[str, dict[str, str]] = {}    # sensor -> {output: buffer}
        self._last: dict[str, float] = {}                # sensor -> time of its last reading
        self._session = ""
        self._measures = False
        self._asked_time = 0     # how often since it was started
        self._zero: int | None = None

    def request(self) -> str | None:
        if not self._buffers:
            return "/config"
        if self._zero is None and self._measures and self._asked_time < _TIME_ASKED:
            return "/time"
        parts = []
        for sensor, outputs in self._buffers.items():
            time = outputs["t"]
            last = self._last.get(sensor)
            after = "full" if last is None else repr(last)
            parts.append(f"{quote(time)}={after}")
            parts += [f"{quote(name)}={after}" + (f"%7C{quote(time)}" if last is not None else "")
                      for output, name in outputs.items() if output != "t"]
        return "/get?" + "&".join(parts)

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        self._asked_time += part.startswith("/time")
        try:
            answer = json.loads(data)
            if part.startswith("/config"):
                self._learn(answer)
            elif part.startswith("/time"):
                self._set_clock(answer)
            elif part.startswith("/get"):
                return self._readings(answer)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError,
                OverflowError) as error:
            if isinstance(error, SampleError):
                raise
            if part.startswith("/config"):
                raise SampleError("the answer to /config is not phyphox's; is it the phone that "
                                  "has this address?") from None
            self.lose("answers that are not phyphox's", part[:20])
        return []

    def finish(self) -> list[Block]:
        return self._phone.finish()

    def _learn(self, config):
        known = {"accelerometer": "xyzt", "gyroscope": "xyzt", "magnetic_field": "xyzt"}
        for entry in config["inputs"]:
            outputs = {output: str(name) for pair in entry["outputs"]
                       for output, name in pair.items() if output != "abs"}
            source = str(entry["source"])
            if source in known and set(known[source]) <= outputs.keys():
                self._buffers[source] = {axis: outputs[axis] for axis in known[source]}
            elif source == "location" and {"lat", "lon", "t"} <= outputs.keys():
                self._buffers[source] = outputs
        if not self._buffers:
            raise SampleError("the running experiment of phyphox has none of accelerometer, "
                              "gyroscope, magnetometer and location with times: open one that has, "
                              "such as config/imu_fusion.phyphox")
        self.device = f"phyphox: {config.get('title', '')}"[:80]

    def _set_clock(self, events):
        starts = [e for e in events if e.get("event") == "START"]
        if starts:
            last = starts[-1]
            since, unix = float(last["experimentTime"]), float(last["systemTime"])
            if not (abs(since) < LONGEST and UNIX[0] < unix < UNIX[1]):
                raise ValueError
            self._zero = round(unix * 1000) * 1_000_000 - round(since * NANOSECONDS)

    def _readings(self, answer):
        status = answer.get("status", {})
        session = str(status.get("session", ""))
        if self._session and session != self._session:
            self._begin_anew("sessions of phyphox that were left: the experiment began anew")
        self._session = session
        measures = bool(status.get("measuring"))
        if measures and not self._measures:
            self._zero, self._asked_time = None, 0    # started, or gone on with after a pause
        self._measures = measures
        if self._zero is None and (not measures or self._asked_time < _TIME_ASKED):
            return []    # the readings are asked for again when their zero is known
        blocks: list[Block] = []
        arrays = {name: np.array([np.nan if not isinstance(v, (int, float)) else v
                                  for v in entry["buffer"]], dtype=np.float64)
                  for name, entry in answer["buffer"].items()}
        for sensor, outputs in self._buffers.items():
            time = arrays.get(outputs["t"])
            if time is None or not len(time):
                continue
            last = self._last.get(sensor)
            if last is not None and time[-1] < last:
                self._begin_anew("stretches of phyphox that were left: it was cleared")
                last = None
            columns = {o: arrays.get(name, np.empty(0)) for o, name in outputs.items()}
            # A reading may have reached some of its buffers when the phone answers.
            n = min(len(c) for o, c in columns.items() if len(c) or o in "xyzt")
            new = np.flatnonzero((time[:n] >= 0) & (time[:n] < LONGEST) & (time[:n] > (
                -np.inf if last is None else last)))
            if len(new):
                self._last[sensor] = float(time[new[-1]])
                blocks += self._samples(sensor, time[new], {
                    o: c[new] for o, c in columns.items() if len(c) >= n})
        return blocks

    def _samples(self, sensor, time, columns):
        stamp = (EPOCH if self._zero is None else self._zero) + np.round(
            time * NANOSECONDS).astype(np.int64)
        if sensor == "location":
            none = np.full(len(time), np.nan)
            height = "zwgs84" if "zwgs84" in columns else "z"
            return locations(stamp, np.column_stack([columns.get(name, none) for name in (
                "lat", "lon", height, "v", "dir", "accuracy", "zAccuracy")]))
        values = np.column_stack([columns[axis] for axis in "xyz"])
        if sensor == "magnetic_field":
            return self._phone.vectors("magnetometer", stamp, values * 1e-6)
        return self._phone.vectors(sensor, stamp, values)

    def _begin_anew(self, why):
        self.lost[why] += 1
        self._phone, self._last, self._zero, self._asked_time = Phone(), {}, None, 0
