"""Rows of a bench kept on the disk as they are measured, so that a stopped run goes on where it was."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from ..errors import OutputError
from ..json_text import parse_json
from .report import Row

__all__ = ["Journal", "fingerprint"]


def fingerprint(*places: Path | None) -> str:
    """What tells files and folders from others without saying where they lie, which is nobody else's affair."""
    text = "\n".join("" if place is None else str(place.resolve()) for place in places)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Journal:
    """`rows.jsonl`: a line that says what the run is, then a line for each row; a stopped run goes on from it.

    Args:
        folder: of the run, which can be written to; None keeps rows in memory only.
        identity: what has to be the same for a run to be gone on with, as JSON keeps it.
        each: rows of a unit of work.
        unit: labels in a row that say which unit it is of; a unit is measured whole or not at all.

    Raises:
        OutputError: the folder holds rows of a run with another identity; they stay as they are.
    """

    def __init__(
        self, folder: Path | None, identity: Row, each: int = 1, *, unit: tuple[str, ...] = ("panorama",)
    ) -> None:
        self._unit = unit
        self.path = None if folder is None else folder / "rows.jsonl"
        self.rows: list[Row] = []
        if self.path is not None:
            self.rows = self._whole(_resume(self.path, identity), each)
            lines = [identity, *self.rows]
            # Lines of a unit that was being written when the run was stopped go.
            self.path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")

    def has(self, *labels: str) -> bool:
        """Whether the rows of a unit are there."""
        return any(self._labels(row) == labels for row in self.rows)

    def add(self, rows: list[Row]) -> None:
        """Keep the rows of a unit; they are on the disk when this returns."""
        self.rows += rows
        if self.path is None:
            return
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(row) + "\n" for row in rows))
            file.flush()
            os.fsync(file.fileno())

    def _labels(self, row: Row) -> tuple[str, ...]:
        return tuple(row[name] for name in self._unit)

    def _whole(self, rows: list[Row], each: int) -> list[Row]:
        """Rows of the units that have all of theirs."""
        counts = Counter(map(self._labels, rows))
        return [row for row in rows if counts[self._labels(row)] == each]


def _resume(path: Path, identity: Row) -> list[Row]:
    """Rows of an earlier run of the same command; none if there was none."""
    lines = list(_json_lines(path)) if path.exists() else []
    if lines and lines[0] != identity:
        begun = ", ".join(f"{key} {lines[0].get(key)!r}" for key in identity if lines[0].get(key) != identity[key])
        raise OutputError(path, f"was begun with other options ({begun}); give another --out or remove it")
    return lines[1:]


def _json_lines(path: Path) -> Iterator[Row]:
    """The lines of a file up to the first that is cut short."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            yield dict(parse_json(line))
        except (ValueError, TypeError):
            return
