"""The driver: samples of a device, under the clock of this computer, on the standard topics."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus

from imu_fusion.errors import DeviceError, ParameterError, SampleError
from imu_fusion.nodes.base import IDLE, Node
from imu_fusion.nodes.device_file import DeviceFile, Lot
from imu_fusion.nodes.device_topics import DeviceTopic, DriverSensor
from imu_fusion.nodes.flow import live_qos, steady_timer
from imu_fusion.parameters.bounded_yaml import read_yaml
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.recordings.source_storage import in_range
from imu_fusion.sources.clock import DeviceClock
from imu_fusion.sources.registry import FORMATS, HEAD, check_transport, live_source, recognise
from imu_fusion.sources.source import (
    ARRAY_TOPIC,
    FIX_TOPIC,
    IMU_TOPIC,
    MAG_TOPIC,
    Block,
    Source,
)
from imu_fusion.sources.transports.connection import Chunk, Connection
from imu_fusion.sources.transports.live import open_transport

_FILE = "file://"
_FOREIGN = 4096      # bytes without a sample, after which the format is doubted


@dataclass(frozen=True)
class DriverParams(Parameters):
    """Parameters of the driver node."""

    source: str = param("", doc="format: " + ", ".join(
        name for name, known in FORMATS.items() if known.live or name == "table")
        + "; with file:// it is recognised")
    transport: str = param("", doc="address: serial:///dev/ttyACM0?baud=115200, tcp://HOST:PORT, "
                           "udp://0.0.0.0:PORT, http://HOST:PORT, http-push://0.0.0.0:PORT, or "
                           "file:///PATH, played at its own pace")
    description: str | None = param(None, path=True, doc="YAML file: columns, units and axes of a "
                                    "table, or what the device does not tell")
    stamp_source: str = param(
        "device", choices=("device", "arrival", "device_raw"),
        doc="device: the device's clock brought to that of this computer by the least delay; "
            "arrival: when the samples came; device_raw: the device's stamps as they are")
    qos: str = param("sensor_data", choices=("sensor_data", "reliable"),
                     doc="sensor_data: best effort; reliable: repeats what was lost")
    imu_frame: str = param("imu_link", doc="frame_id of imu/data_raw and imu/mag")
    gnss_frame: str = param("gnss", doc="frame_id of fix")
    world_frame: str = param("world", doc="frame_id of fix_velocity and reference/pose")
    reconnect: bool = param(True, doc="wait for a device that is lost or not there; else end")
    longest_pause: float = param(5.0, unit="s", low=0.1, high=3600.0,
                                 doc="between two attempts, which begin at 0.2 s")
    silence: float | None = param(5.0, unit="s", low=0.1, doc="connect anew if nothing comes for "
                                  "so long; unset: never")
    wait_for_subscribers: int = param(
        0, low=0, doc="number of subscriptions that must be there before the device is asked")
    sensor: DriverSensor = DriverSensor()


class Driver(Node):
    """Samples of a device, live or from its file, on the standard topics."""

    NAME = "driver"
    PARAMETERS = (DriverParams,)

    def _set_up(self):
        p = self._p = self.params(DriverParams)
        if not p.transport:
            raise ParameterError("parameter 'transport' of node driver: no address given; add -p "
                                 "transport:=serial:///dev/ttyACM0, tcp://HOST:PORT or others")
        self._description = None if p.description is None else read_yaml(p.description)
        self._connection: Connection | None = None
        self._file: DeviceFile | None = None
        if p.transport.startswith(_FILE):
            self._file = DeviceFile(Path(p.transport.removeprefix(_FILE)), self._description,
                               str(p.description))
            self._source: Source = self._file.source
        else:
            self._source = live_source(p.source, self._description, str(p.description))
            check_transport(p.source, p.transport)
            wake = self.create_guard_condition(lambda: None)
            self._connection = Connection(
                open_transport(p.transport, self._source.request), wake.trigger, p.silence,
                p.longest_pause, p.reconnect)
        topics = self._file.topics if self._file else self._source.topics
        self._outputs = {topic: DeviceTopic(self, topic, self._frame(topic), p.sensor,
                                            live_qos(p.qos))
                         for topic in topics}
        self._clocks: dict[str, DeviceClock] = {}
        self._held: list[Lot] = []    # until the clocks are known
        self._doubted = b""           # the first bytes, while no sample has come of them
        self._known = False           # that the format is right
        self._said = ""
        self._problem, self._connections, self._started = "", 0, False
        steady_timer(self, 1.0, self._tell)
        self.start_diagnostics("device", self._status, lambda: self._source.device or p.transport)

    def work(self) -> float:
        """Take what has come; publish it. See :meth:`Node.work`."""
        if not self._started:
            if sum(output.subscribers() for output in self._outputs.values()) < (
                    self._p.wait_for_subscribers):
                return 0.05
            self._started = True
            if self._connection is not None:
                self._connection.start()
        if self._file is not None:
            return self._play(self._file)
        assert self._connection is not None
        ended = self._connection.ended
        self._watch(self._connection)
        for chunk in self._connection.take():
            self._feed(chunk)
        if ended and not self.finished:
            self._end(self._connection.problem)
        return IDLE

    def _frame(self, topic: str) -> str | None:
        """frame_id of a topic; None: that of the samples."""
        if topic in (IMU_TOPIC, MAG_TOPIC):
            return self._p.imu_frame
        if topic.startswith(ARRAY_TOPIC):
            return None
        return self._p.gnss_frame if topic == FIX_TOPIC else self._p.world_frame

    def stop(self) -> None:
        """Let go of the device."""
        self._publish_held()
        self.finished = True

    def close(self) -> None:
        """End the thread, and say what was published and what was lost."""
        if self._connection is not None:
            self._connection.stop()
        for topic, output in self._outputs.items():
            if output.count:
                self.get_logger().info(f"{topic}: {output.count} messages")
        for what, count in self._source.lost.items():
            self.get_logger().warning(f"{count} {what}")

    def _end(self, problem: str) -> None:
        self._publish(Lot(self._source.finish(), time.time_ns()))
        self._publish_held()
        self.finished = True
        if problem and not self._connections:
            raise DeviceError(problem)
        if problem:
            self.problems.append(problem)

    def _watch(self, connection: Connection) -> None:
        """Say what has changed about the device."""
        problem, connections = connection.problem, connection.connections
        is_new = connections != self._connections
        if connections and (is_new or self._problem) and (not problem or not self._connections):
            self.get_logger().info(f"{self._p.transport}: connected")
        if problem and problem != self._problem:
            if self._p.reconnect:
                self.get_logger().warning(f"{problem}; waiting for it")
            elif connections:
                self.get_logger().warning(problem)
        self._problem, self._connections = problem, connections

    def _feed(self, chunk: Chunk) -> None:
        if chunk.begins:
            self._source.restart()
            self._doubted, self._known = b"", False
        try:
            blocks = self._source.feed(chunk.data, chunk.part)
        except SampleError as error:
            if not self._p.reconnect:
                raise
            self._warn(str(error))
            return
        if blocks:
            self._known = True
            self._publish(Lot(blocks, chunk.arrival))
        elif not self._known and not chunk.part:
            self._doubt(chunk.data)

    def _doubt(self, data: bytes) -> None:
        """Of a stream of another format, or at a wrong rate, no sample comes."""
        before = len(self._doubted)
        self._doubted = (self._doubted + data)[:HEAD]
        if before < _FOREIGN <= len(self._doubted):
            looks = recognise({"": self._doubted})
            baud = ", and the baud rate" if self._p.transport.startswith("serial") else ""
            self._warn(f"{len(self._doubted)} bytes have come, and no sample of "
                       f"'{self._p.source}' is in them; "
                       + (f"they look like {looks.about} ({looks.name})" if looks else
                          f"is the source right{baud}?"))

    def _warn(self, text: str) -> None:
        """Say something, once in a row."""
        if text != self._said:
            self._said = text
            self.get_logger().warning(text)

    def _publish(self, lot: Lot) -> None:
        """Publish samples, or keep them until their clocks are known."""
        if self._p.stamp_source != "device":
            self._send(lot)
            return
        for name in {block.clock for block in lot.blocks}:
            clock = self._clocks.setdefault(name, DeviceClock())
            latest = max(int(b.log.stamp.max()) for b in lot.blocks if b.clock == name)
            if clock.has_stepped(latest, lot.arrival):
                self.get_logger().warning("the clock of the device was set; its offset begins anew")
                self._publish_held()
                clock.restart()
            clock.observe(latest, lot.arrival)
        self._held.append(lot)
        if all(clock.is_settled for clock in self._clocks.values()):
            self._publish_held()

    def _publish_held(self) -> None:
        held, self._held = self._held, []
        for lot in held:
            self._send(lot)

    def _send(self, lot: Lot) -> None:
        for topic, log, clock in lot.blocks:
            if self._p.stamp_source == "device":
                stamp = self._clocks[clock].map(log.stamp)
            elif self._p.stamp_source == "arrival":
                stamp = log.stamp + (lot.arrival - int(log.stamp.max()))
            else:
                stamp = log.stamp
            block = in_range(Block(topic, replace(log, stamp=stamp)), self._source)
            if len(block.log):
                self._outputs[topic].publish(block.log)

    def _play(self, file: DeviceFile) -> float:
        """Publish what is due of a file."""
        lot, pause = file.due()
        if lot.blocks:
            self._publish(lot)
        if pause is None:
            self._publish_held()
            self.finished = True
            return 0.0
        return pause

    def _tell(self) -> None:
        for remark in self._source.remarks:
            self.get_logger().info(remark)
        self._source.remarks.clear()

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        values: dict[str, object] = {"transport": self._p.transport, "source": self._p.source,
                                     "connections": self._connections,
                                     "last error": self._problem or self._said}
        worries = bool(self._problem)
        for topic, output in self._outputs.items():
            if output.count:
                values |= {f"{topic} messages": output.count, f"{topic} gaps": output.gaps,
                           f"{topic} rate Hz": f"{output.rate():.1f}",
                           f"{topic} stamps not rising": output.backwards}
                worries |= bool(output.backwards)
        for name, clock in self._clocks.items():
            label = f"clock {name}".strip()
            values |= {f"{label} offset s": f"{(clock.offset or 0) * 1e-9:.6f}",
                       f"{label} drift ppm": f"{clock.drift * 1e6:.1f}",
                       f"{label} was set": clock.steps}
        values |= dict(self._source.lost)
        if not any(output.count for output in self._outputs.values()):
            return DiagnosticStatus.WARN, self._problem or "no samples yet", values
        if worries:
            return DiagnosticStatus.WARN, self._problem or "stamps do not rise", values
        return DiagnosticStatus.OK, "running", values
