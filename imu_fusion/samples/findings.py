"""What checks of samples find."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One thing worth knowing: ``kind`` (stamp, gap, nan, unit, axes, saturation, held, fix, frame,
    lacking), ``text`` for people, and whether it makes what is estimated from the samples
    ``unusable``."""

    kind: str
    text: str
    unusable: bool = False
