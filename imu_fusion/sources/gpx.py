"""GPX (https://www.topografix.com/GPX/1/1/): tracks, read as they come.

Elevations are above sea level, as GPX has them; accuracies are not told.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import FixLog
from imu_fusion.sources.source import FIX_TOPIC, FIXED, Block, Source, named


class Gpx(Source):
    """Track points that have a time and an elevation; others are counted."""

    def __init__(self, strict: bool = True) -> None:
        super().__init__(strict)
        self._parser: Any = ElementTree.XMLPullParser(["end"])
        self._part, self._seen = "", 0
        self._broken = ""    # why the rest of the file cannot be read
        self._bad = ""       # why the first of the points that cannot be read cannot

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        self._part = part
        if self._broken:
            return []
        if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
            raise SampleError(f"{part}: declares entities, which no track needs")
        self._parser.feed(data)
        return self._points()

    def finish(self) -> list[Block]:
        if not self._broken:
            try:
                self._parser.close()
            except ElementTree.ParseError as error:
                self._broken = f"ends in the middle ({error})"
        blocks = self._points()
        if not self._seen:
            why = self._broken or "no track points with time and elevation"
            raise SampleError(self._bad or f"{self._part}: {why}")
        if self._bad:
            self.remark(f"the first that cannot be read: {self._bad}")
        if self._broken:
            self.lost[f"part of the track, as {self._part} {self._broken}"] += 1
        return blocks

    def _elements(self) -> Iterator[ElementTree.Element]:
        """Those that are complete, up to where the file is none any more."""
        try:
            for _, element in self._parser.read_events():
                yield element
        except ElementTree.ParseError as error:
            self._broken = self._broken or f"is no GPX from some place on ({error})"

    def _points(self) -> list[Block]:
        rows = []
        for element in self._elements():
            tag = element.tag.rpartition("}")[2]
            if tag == "trkpt":
                texts = {child.tag.rpartition("}")[2]: child.text for child in element}
                try:
                    if texts.get("time") and texts.get("ele"):
                        rows.append(self._row(element, texts))
                    else:
                        self.lost["track points without time or elevation"] += 1
                except SampleError as error:
                    self.lost["track points that cannot be read"] += 1
                    self._bad = self._bad or str(error)
            if tag in ("trkpt", "trkseg"):
                element.clear()
        if not rows:
            return []
        self._seen += len(rows)
        self.remark("GPX tells no accuracies, and heights above sea level")
        lat, lon, height = np.array([row[1] for row in rows]).T
        return named({FIX_TOPIC: FixLog(
            np.array([row[0] for row in rows], dtype=np.int64), lat, lon, height,
            np.zeros((len(rows), 3, 3)), np.full(len(rows), float(FIXED)))})

    def _row(self, element: ElementTree.Element, texts: dict[str, str | None]
             ) -> tuple[int, tuple[float, float, float]]:
        text = str(texts["time"])
        try:
            at = datetime.fromisoformat(text.strip())
            at = at if at.tzinfo else at.replace(tzinfo=UTC)
            stamp = int(at.replace(microsecond=0).timestamp()) * 10**9 + at.microsecond * 1000
            place = (float(element.attrib["lat"]), float(element.attrib["lon"]),
                     float(str(texts["ele"])))
            if stamp >= 2**63:
                raise ValueError
        except (ValueError, KeyError, OverflowError):
            raise SampleError(f"{self._part}: a track point at {text[:40]} has no latitude, "
                              "longitude, elevation or time that can be read") from None
        if not (abs(place[0]) <= 90 and abs(place[1]) <= 180 and math.isfinite(place[2])):
            raise SampleError(f"{self._part}: track point at {text[:40]}: {place} is no place")
        return stamp, place
