"""How small a light stands for a map: what each material needs at each tolerance, and how long it takes to find.

Every map is decided for each material alone and for all of them together. A run with `--out` keeps its rows in
`rows.jsonl` panorama by panorama, and goes on from them when it is run again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Final

import torch

from ..imageio import read_envmap
from ..lights.choose import LEVELS, MOST_LIGHTS, choose_light
from ..lights.search import FULL_MAP, Candidate
from ..lights.shading import ROWS
from ..shapes import Latlong
from ..spheres import MATERIALS
from .journal import Journal, fingerprint
from .report import (
    Column,
    Report,
    Row,
    add_output,
    add_panoramas,
    median_and_worst,
    panorama_files,
    prepare_output,
    publish,
)

__all__ = ["CLASSES", "add_arguments", "bench_lights", "run", "summarize"]

SETS: Final[dict[str, tuple[str, ...]]] = {**{name: (name,) for name in MATERIALS}, "all": tuple(MATERIALS)}
"""What has to come out alike, by the name of a row."""

CLASSES: Final = ("ambient", "sh1", "sh2", "one_light", "more_lights", "full_map")
"""Kinds of light, cheapest first."""

PROTOCOL: Final = {
    "error": "RMS of the sphere's difference over pixels and channels, relative to the RMS of the full map's sphere; "
    "of several materials the worst",
    "map_rows": ROWS,
    "most_lights": MOST_LIGHTS,
    "sh2_and_one_light": "maps that do with nine harmonics and at most one light",
    "seconds": "wall time of one decision, file read already and what all maps share prepared",
    "cpu_seconds": "the same in processor time, which other programs on the machine do not stretch",
    "prepare_seconds": "wall time of what is made once for all maps, which the first decision of a process waits for",
    "prepare_cpu_seconds": "the same in processor time",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Decide, write and print.

    Raises:
        ProbeError: a folder without maps, a map that cannot be read, or a report that cannot be written.
    """
    started = time.perf_counter()
    files = panorama_files(args.panoramas)
    prepare_output(args)
    identity = {"bench": "lights", "panoramas": fingerprint(*files), "sets": list(SETS), "levels": list(LEVELS)}
    journal = Journal(args.out, identity, len(SETS) * len(LEVELS))
    prepared = _prepare()
    rows = bench_lights(files, journal=journal)
    report = Report("lights", PROTOCOL, rows, summarize(rows), time.perf_counter() - started, headline=prepared)
    publish(report, args, rows=_ROWS, summary=_SUMMARY)


def _prepare() -> Row:
    """Make what all maps share; how long that takes."""
    wall, cpu = time.perf_counter(), time.process_time()
    choose_light(torch.ones(1, 8, 16, 3))
    return {"prepare_seconds": time.perf_counter() - wall, "prepare_cpu_seconds": time.process_time() - cpu}


def bench_lights(panoramas: Sequence[Path], *, journal: Journal | None = None) -> list[Row]:
    """Decide every map for every set of materials.

    Args:
        panoramas: maps.
        journal: holds the panoramas that are decided already, and keeps the others.

    Returns:
        A row for each map, set and level: what is chosen, its price and error, and how long the decision took, which
        is the same for all levels.
    """
    journal = journal or Journal(None, {}, len(SETS) * len(LEVELS))
    for path in panoramas:
        if not journal.has(path.stem):
            latlong = read_envmap(path)
            journal.add([row for name in SETS for row in _decide(path.stem, latlong, name)])
    return journal.rows


def _decide(panorama: str, latlong: Latlong, name: str) -> list[Row]:
    wall, cpu = time.perf_counter(), time.process_time()
    decision = choose_light(latlong, max(LEVELS), SETS[name])
    spent = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    rows = []
    for level in LEVELS:
        chosen = decision.cheapest(level)
        facts = {"model": chosen.name, "class": _class(chosen), "parameters": chosen.parameters}
        error = {"relative_error": chosen.relative_error}
        rows.append({"panorama": panorama, "materials": name, "level": level, **facts, **error, **spent})
    return rows


def _class(candidate: Candidate) -> str:
    if candidate.name == FULL_MAP or candidate.model is None:
        return "full_map"
    lights = len(candidate.model.lights)
    return candidate.name if lights == 0 else "one_light" if lights == 1 else "more_lights"


def summarize(rows: Sequence[Row]) -> list[Row]:
    """A record for each set of materials and level: how many maps need which kind of light."""
    summary = []
    for name, level in dict.fromkeys((row["materials"], row["level"]) for row in rows):
        own = [row for row in rows if (row["materials"], row["level"]) == (name, level)]
        kinds = [row["class"] for row in own]
        counts = {kind: kinds.count(kind) for kind in CLASSES}
        summary.append(
            {
                "materials": name,
                "level": level,
                "panoramas": len(own),
                **counts,
                "sh2_and_one_light": sum(counts[kind] for kind in ("ambient", "sh1", "sh2", "one_light")),
                "parameters_median": median(row["parameters"] for row in own),
                **median_and_worst(own, "seconds"),
                **median_and_worst(own, "cpu_seconds"),
            }
        )
    return summary


_ROWS: Final = (
    Column("panorama", "panorama"),
    Column("spheres", "materials"),
    Column("level", "level", ".0%"),
    Column("light", "model"),
    Column("numbers", "parameters"),
    Column("error", "relative_error", ".2%"),
    Column("s", "seconds", ".2f"),
)
_SUMMARY: Final = (
    Column("spheres", "materials"),
    Column("level", "level", ".0%"),
    Column("maps", "panoramas"),
    Column("full map", "full_map"),
    Column("9 SH + 1 light", "sh2_and_one_light"),
    Column("ambient", "ambient"),
    Column("SH 1", "sh1"),
    Column("SH 2", "sh2"),
    Column("+ 1 light", "one_light"),
    Column("+ more", "more_lights"),
    Column("numbers (median)", "parameters_median", "g"),
    Column("s a map", "seconds", ".2f"),
    Column("CPU s a map", "cpu_seconds", ".2f"),
)
