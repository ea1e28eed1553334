"""Which panoramas of a folder are fit to train on: HDR, large enough, whole, and each only once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from torch import Tensor

from ...errors import ImageError
from ...imageio import read_envmap
from ...shapes import Latlong
from .duplicates import find_duplicates, signature

__all__ = ["LEAST_ROWS", "Screening", "screen", "unfit"]

LEAST_ROWS: Final = 64
"""Rows under which a crop of a map is a handful of pixels."""


@dataclass(frozen=True)
class Screening:
    """What became of the panoramas.

    Attributes:
        used: names of those to train on, sorted, and their rows.
        skipped: why others are not fit, by name.
        duplicates: names of those left out, and what each shows again.
    """

    used: Mapping[str, int]
    skipped: Mapping[str, str]
    duplicates: Mapping[str, str]


def unfit(latlong: Latlong) -> str | None:
    """Why a map is not fit to train on; None where it is.

    Args:
        latlong: (1, H, 2H, 3) as read, finite and 0 or above.
    """
    rows, highest = latlong.shape[1], float(latlong.max())
    if rows < LEAST_ROWS:
        return f"has {rows} rows; {LEAST_ROWS} or more are needed"
    if highest <= 1:
        return f"is not HDR: its values end at {highest:g}, display white; lights above 1 are needed"
    if highest <= 255 and bool((latlong == latlong.round()).all()):
        return f"is not HDR: it holds 8-bit codes, whole numbers up to {highest:g}"
    return None


def screen(files: Mapping[str, Path], report: Callable[[str], None]) -> Screening:
    """Read maps and sort out what is not fit and what is there already; of the same maps the largest is kept.

    Args:
        files: of the maps, by name.
        report: told of every map that is left out, and why.
    """
    skipped: dict[str, str] = {}
    signatures: dict[str, Tensor] = {}
    rows: dict[str, int] = {}
    for name, path in sorted(files.items()):
        try:
            latlong = read_envmap(path)
        except ImageError as error:
            reason: str | None = error.reason
        else:
            reason = unfit(latlong)
        if reason is None:
            signatures[name], rows[name] = signature(latlong), latlong.shape[1]
        else:
            skipped[name] = reason
            report(f"skipped {name}: {reason}")
    largest_first = sorted(signatures, key=lambda name: (-rows[name], name))
    duplicates = find_duplicates({name: signatures[name] for name in largest_first})
    for name, of in sorted(duplicates.items()):
        report(f"left out {name}: shows what {of} shows")
    return Screening({name: rows[name] for name in sorted(rows.keys() - duplicates.keys())}, skipped, duplicates)
