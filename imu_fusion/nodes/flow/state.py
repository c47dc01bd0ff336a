"""What a node says of its sessions, and the message that carries it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy

from imu_fusion.nodes.flow.qos import reliable_qos

MARK = "/_flow/"  # between node and instance; `ros2 topic list` hides names with an underscore
STATE_QOS = reliable_qos(1, DurabilityPolicy.TRANSIENT_LOCAL)

# Events of a session. NEXT: this one ended, another follows (loop).
BEGIN, NEXT, END = "begin", "next", "end"

_TOPIC = "topic "  # before the names of topics among the other keys


class Sent(NamedTuple):
    """One topic of a session: type, gid of the writer, messages sent before it and until now."""

    msgtype: str
    writer: str
    before: int
    sent: int


class Taken(NamedTuple):
    """One topic that is taken: gid of the reader, how far of what its writer sent, what is lost."""

    reader: str
    taken: int
    lost: int


@dataclass(frozen=True)
class Sending:
    """A session that a node sends; ``session`` is empty if none.

    ``company``: the instances that must have joined, ``version`` of this list; ``lost``: messages
    that its sender itself lacks of what it makes these from.
    """

    session: str = ""
    event: str = ""
    topics: Mapping[str, Sent] = field(default_factory=dict)
    company: frozenset[str] = frozenset()
    version: int = 0
    lost: int = 0


@dataclass(frozen=True)
class Joined:
    """A session that a node has joined; ``version`` of the company with which it is ready."""

    session: str
    version: int
    finished: bool
    topics: Mapping[str, Taken]


@dataclass(frozen=True)
class State:
    """All that a node says: ``listens``, whether it joins sessions; the one that it sends; those
    that it has joined, by instance of the sender."""

    listens: bool
    sending: Sending
    joined: Mapping[str, Joined]

    def message(self) -> DiagnosticArray:
        """As a ROS message."""
        s = self.sending
        own = {"listens": str(int(self.listens)), "lost": str(s.lost),
               "company": " ".join(sorted(s.company)), "version": str(s.version)}
        own |= {_TOPIC + topic: " ".join(map(str, sent)) for topic, sent in s.topics.items()}
        return DiagnosticArray(status=[_status("sends", s.event, s.session, own)] + [
            _status(sender, "finished" if j.finished else "joined", j.session,
                    {"version": str(j.version)} | {
                        _TOPIC + topic: " ".join(map(str, taken))
                        for topic, taken in j.topics.items()})
            for sender, j in self.joined.items()])

    @classmethod
    def of(cls, message: DiagnosticArray) -> "State":
        """The state in a message.

        Raises:
            ValueError: it is malformed.
        """
        try:
            own, *others = message.status
            values = {v.key: v.value for v in own.values}
            if own.name != "sends" or own.message not in ("", BEGIN, NEXT, END):
                raise ValueError(f"event '{own.message}' of '{own.name}'")
            sending = Sending(own.hardware_id, own.message, _topics(values, _sent),
                              frozenset(values["company"].split()), _count(values["version"]),
                              _count(values["lost"]))
            joined = {}
            for status in others:
                said = {v.key: v.value for v in status.values}
                joined[status.name] = Joined(status.hardware_id, _count(said["version"]),
                                             status.message == "finished", _topics(said, _taken))
            return cls(values["listens"] == "1", sending, joined)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"malformed: {error!r}") from None


def _status(name, event, session, values):
    return DiagnosticStatus(
        name=name, message=event, hardware_id=session,
        values=[KeyValue(key=key, value=value) for key, value in values.items()])


def _topics(values, read):
    return {key.removeprefix(_TOPIC): read(*value.split())
            for key, value in values.items() if key.startswith(_TOPIC)}


def _count(text):
    if not text.isdecimal():
        raise ValueError(f"'{text}' is not a count")
    return int(text)


def _sent(msgtype, writer, before, sent):
    return Sent(msgtype, writer, _count(before), _count(sent))


def _taken(reader, taken, lost):
    return Taken(reader, _count(taken), _count(lost))
