"""What a recorder could not record, as a message of its own in the recording."""

from collections.abc import Mapping, Sequence

from imu_fusion.errors import MessageError
from imu_fusion.messages.diagnostics import (
    DIAGNOSTICS_TYPE,
    diagnostics_message,
    diagnostics_value,
)
from imu_fusion.recordings.bag_reader import Reader
from imu_fusion.recordings.bag_writer import BagWriter

SUMMARY_TOPIC = "/recorder/summary"

_NAME = "recorder"
_PROBLEMS = "problems"


def write_losses(writer: BagWriter, stamp: int, problems: Sequence[str],
                 counts: Mapping[str, str]) -> None:
    """Write the message; only where something is amiss.

    Args:
        stamp: int ns. problems: what happened, in words. counts: of each topic, in words.
    """
    values = {**counts, _PROBLEMS: "\n".join(problems)}
    writer.write(SUMMARY_TOPIC, DIAGNOSTICS_TYPE, diagnostics_message(
        stamp, "", _NAME, "the recording is not complete", values, worries=True), stamp)


def read_losses(reader: Reader) -> list[str]:
    """Lines of text on what a recording lacks; empty if its recorder missed nothing."""
    if SUMMARY_TOPIC not in reader.topics:
        return []
    lines: list[str] = []
    for _, _, _, cdr in reader.messages([SUMMARY_TOPIC]):
        try:
            values = diagnostics_value(cdr, _NAME)[1]
        except MessageError as error:
            lines.append(f"{SUMMARY_TOPIC}: {error}")
            continue
        lines += values.pop(_PROBLEMS, "").splitlines()
        lines += [f"{topic}: {words}" for topic, words in values.items()]
    return lines
