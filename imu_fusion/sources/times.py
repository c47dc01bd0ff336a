"""Times that are written as dates or hours."""

import re
from datetime import UTC, datetime
from decimal import Decimal

NANOSECONDS = 1_000_000_000
_DATE = re.compile(r"[0-9]{4}[-/][0-9]{2}[-/][0-9]{2}[T ][0-9]")
_CLOCK = re.compile(r"([0-9]{1,2}):([0-9]{2}):([0-9]{2})(?:[.,:]([0-9]+))?")
_FRACTION = re.compile(r"([.,][0-9]+)")


def is_calendar(text: str) -> bool:
    """Whether a text begins as a date with an hour, or is an hour of the day."""
    return bool(_DATE.match(text) or _CLOCK.fullmatch(text))


def calendar(text: str) -> int:
    """Nanoseconds of a time of ISO 8601, also with a blank for the T: since 1970, UTC without a
    zone; of an hour without a date since midnight.

    Raises:
        ValueError: it is none.
    """
    clock = _CLOCK.fullmatch(text)
    if clock:
        hour, minute, second = (int(part) for part in clock.groups()[:3])
        return ((hour * 60 + minute) * 60 + second) * NANOSECONDS + _part(clock[4] or "0")
    fraction = _FRACTION.search(text)
    whole = datetime.fromisoformat(_FRACTION.sub("", text).replace("/", "-"))
    if whole.tzinfo is None:
        whole = whole.replace(tzinfo=UTC)
    return int(whole.timestamp()) * NANOSECONDS + _part(fraction[1][1:] if fraction else "0")


def _part(digits: str) -> int:
    """Nanoseconds of the digits behind a second."""
    return round(Decimal("0." + digits) * NANOSECONDS)
