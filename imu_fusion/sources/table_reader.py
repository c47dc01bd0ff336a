"""The rows of a table of text, and their cells as numbers, texts and times."""

import csv
from collections import Counter
from collections.abc import Callable, Collection
from decimal import Decimal
from typing import NamedTuple, TypeVar

import numpy as np

from imu_fusion.errors import ParameterError, SampleError
from imu_fusion.sources import units
from imu_fusion.sources.description import DELIMITERS, TableParams, TimeParams
from imu_fusion.sources.source import BROKEN, Lines, is_number, numbers
from imu_fusion.sources.times import NANOSECONDS, calendar

GPS_EPOCH = 315_964_800    # 1980-01-06 in Unix time
_WEEK = 7 * 86400
_DIGITS = 22           # of nanoseconds, with room
_MANY = 1000           # broken rows, after which the share is looked at before the end
_NO_TEXT = ("not a table of text: zeros, carriage returns that end no line, or quotes without end "
            "are in it")
Result = TypeVar("Result")


class Rows(NamedTuple):
    """Rows of a table: numbers of their lines, and their cells."""

    lines: list[int]
    cells: list[list[str]]

    def part(self, first: int, end: int) -> "Rows":
        """Some of them."""
        return Rows(self.lines[first:end], self.cells[first:end])


class TableReader:
    """Cuts bytes into the rows of a table.

    Args:
        table: how it is written.
        where: what is named in errors.
        wanted: columns that tell the header of a stream that may begin in the middle; lines before
            it are ``skipped``.

    ``names`` are those of the columns once the header has come, ``broken`` counts rows that cannot
    be read.
    """

    def __init__(self, table: TableParams, where: str, wanted: Collection[str] = ()) -> None:
        self.names: list[str] | None = None
        self.skipped = 0
        self.broken = 0                     # rows that cannot be read
        self._count = 0                     # rows
        self._width = 0                     # most cells that a row may have
        self._why = ""                      # the first one cannot be read
        self._last_broken, self._cut = 0, -1    # lines: the latest of them, and one without an end
        self._wanted = set(wanted)
        self._table, self._where = table, where
        self._lines = Lines()
        self._delimiter = DELIMITERS.get(table.delimiter, table.delimiter)

    def feed(self, data: bytes) -> Rows:
        """The rows that are complete now."""
        return self._rows(self._lines.feed(data))

    def finish(self) -> Rows:
        """The last row, if no line end followed."""
        lines = self._lines.finish()
        self._cut = lines[-1][0] if lines else -1
        return self._rows(lines)

    def whole(self, data: bytes) -> Rows:
        """All rows of a table that is at hand as a whole."""
        rows, last = self.feed(data), self.finish()
        return Rows(rows.lines + last.lines, rows.cells + last.cells)

    def sound(self, rows: Rows, read: Callable[[Rows], Result]) -> list[Result]:
        """What ``read`` makes of rows, in parts around those of which it raises a SampleError:
        they are broken, and :meth:`account` tells of them.

        Raises:
            SampleError: so many are that something else is wrong.
        """
        if not rows.lines:
            return []
        try:
            self._check_widths(rows)
            return [read(rows)]
        except SampleError as error:
            if len(rows.lines) == 1:
                self._break(rows.lines[0], str(error) if rows.cells[0] else _NO_TEXT)
                return []
        half = len(rows.lines) // 2
        return [*self.sound(rows.part(0, half), read),
                *self.sound(rows.part(half, len(rows.lines)), read)]

    def account(self, lost: Counter[str], strict: bool = True) -> None:
        """Count the broken rows under words.

        Raises:
            SampleError: ``strict``, and so many are broken that something else is wrong: the first
                reason. A last line without an end was cut off, and tells nothing of the others.
        """
        if strict and self.broken - (self._cut == self._last_broken) > BROKEN * self._count:
            raise SampleError(self._why)
        if self.broken:
            lost[f"lines that cannot be read, the first: {self._why}"] = self.broken

    def _check_widths(self, rows: Rows) -> None:
        """Refuse a row that is wider than the names and the first one: two that ran together."""
        self._width = self._width or max(len(self.names or ()), len(rows.cells[0]))
        if max(map(len, rows.cells)) > self._width:
            line, cells = next((line, cells) for line, cells in zip(*rows)
                               if len(cells) > self._width)
            raise SampleError(f"{self._where}, line {line}: {len(cells)} cells, more than the "
                              f"{self._width} of the others")

    def _break(self, line: int, why: str) -> None:
        self._why = self._why or (f"{self._where}, line {line}: {why}" if why is _NO_TEXT else why)
        self.broken += 1
        self._last_broken = line
        if self.broken > max(_MANY, BROKEN * self._count) and not self._wanted:
            raise SampleError(self._why)

    def place(self, name: str) -> int:
        """The index of a column, or a ParameterError."""
        assert self.names is not None
        if self.names.count(name) != 1:
            raise ParameterError(
                f"{self._where}: {'no' if name not in self.names else 'more than one'} column "
                f"'{name}'; there are: {', '.join(self.names)}")
        return self.names.index(name)

    def texts(self, rows: Rows, name: str, label: str = "") -> list[str]:
        """The cells of a column, which errors call ``label``."""
        place = self.place(name)
        try:
            found = [cells[place] for cells in rows.cells]
        except IndexError:
            line, cells = next((line, cells) for line, cells in zip(rows.lines, rows.cells)
                               if len(cells) <= place)
            raise SampleError(f"{self._where}, line {line}: {len(cells)} cells, column "
                              f"'{label or name}' is missing") from None
        return found

    def column(self, rows: Rows, name: str) -> np.ndarray:
        """(n,) float64, NaN for empty cells."""
        return self.numbers(rows, name, self.pointed(self.texts(rows, name)))

    def numbers(self, rows: Rows, label: str, texts: list[str]) -> np.ndarray:
        """(n,) float64 of cells of those rows, NaN for empty ones."""
        return numbers(self._where, label, rows.lines, texts)

    def pointed(self, texts: list[str]) -> list[str]:
        """Cells with a decimal point."""
        if self._table.decimal == ",":
            return [text.replace(",", ".") for text in texts]
        return texts

    def stamps(self, rows: Rows, time: TimeParams) -> list[int]:
        """Times of the rows in ns since 1970, without what follows from those before."""
        assert time.column is not None
        texts = self.texts(rows, time.column)
        if time.unit != "iso8601":
            texts = self.pointed(texts)
        weeks = self.column(rows, time.week).tolist() if time.week else [0.0] * len(texts)
        return [_stamp(self._where, line, text, week, time)
                for line, text, week in zip(rows.lines, texts, weeks)]

    def _rows(self, lines: list[tuple[int, str]]) -> Rows:
        table, rows = self._table, Rows([], [])
        for line, text in lines:
            if line <= table.skip_lines or (table.comment and text.startswith(table.comment)):
                continue
            cells = self._cells(text)
            no_text = cells is None
            cells = cells or []
            if not any(cells) and not no_text:
                continue
            if no_text and self.names is None:
                self._count += 1
                self._break(line, _NO_TEXT)
                continue
            if self.names is None and not table.header:
                self.names = [str(i + 1) for i in range(len(cells))]
            elif self.names is None and not self._wanted <= set(cells):
                self.skipped += 1
                continue
            elif self.names is None or (table.header and cells == self.names):
                self.names = cells    # again, where a device began anew
                continue
            rows.lines.append(line)
            rows.cells.append(cells)
        self._count += len(rows.lines)
        return rows

    def _cells(self, text: str) -> list[str] | None:
        """Those of a line; None if it is none of a table."""
        if "\0" in text or "\r" in text:
            return None
        if self._delimiter is None:
            return text.split()
        if '"' not in text:
            return [cell.strip() for cell in text.split(self._delimiter)]
        try:
            found = next(csv.reader([text], delimiter=self._delimiter), [])
        except csv.Error:    # of a cell that is too long
            return None
        return [cell.strip() for cell in found]


def _stamp(where: str, line: int, text: str, week: float, time: TimeParams) -> int:
    text = text.strip()
    try:
        if time.unit == "iso8601":
            since = calendar(text)
        else:
            # Seconds since 1970 exceed what a float tells apart in nanoseconds.
            value = Decimal(text if is_number(text) else "")
            value = (value * Decimal(repr(time.tick)) * NANOSECONDS if time.tick is not None
                     else value.scaleb(units.TIME[time.unit]))
            if value.adjusted() >= _DIGITS:    # before digits are made of an exponent
                raise ValueError
            since = int(value.to_integral_value())
        if time.week:
            since += round((GPS_EPOCH + int(week) * _WEEK - time.leap_seconds) * 1000) * 1_000_000
        return since + round(time.start * NANOSECONDS)
    except (ArithmeticError, ValueError):
        raise SampleError(f"{where}, line {line}, column '{time.column}': '{text[:40]}' is not a "
                          "time") from None
