"""`lightprobe bench stability`: where the method fails, and what its light must not depend on.

A photograph is taken inside each panorama and its light estimated, as it is and under every change: mirrored, cropped,
coded, resized, exposed and coloured otherwise, with a ball of another size elsewhere; from overhead, through a macro
lens, drawn or empty; from other seeds, by other schedules and samplers, in other precisions. Distances between maps are
stops, the mean over directions and channels, and are told beside the distance between two estimates that differ in
their seeds alone: below 1 a change does less than chance does.

For changes that the light must follow or ignore, the distance is to the map of the unchanged photograph; for hard
photographs it is to the truth. What is measured is kept line by line, so a killed run loses one variant of each of its
processes at most.

Source: DiffusionLight, the appendices on failure cases and on stochastic sampling.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Final

from ...backends.loading import ModelFiles
from ...confidence import FLOOR
from ...errors import OptionError
from ...estimate import Settings
from ...misplaced import ROWS
from ...presets import preset
from ...progress_lines import say
from ..journal import Journal
from ..painters import PAINTERS, Studio, add_files, identity, open_studio, studio_for_workers
from ..report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish
from ..workers import check_workers, results_of
from .measure import SECTIONS, Grid, Panorama
from .page import write_page
from .precision import precision_rows

__all__ = ["GRIDS", "Plan", "add_arguments", "bench_stability", "run", "summarize"]

GRIDS: Final = {
    "small": Grid(scale_seeds=3, seeds=6, schedules=((1, 0), (5, 1), (15, 1), (5, 2)), steps=(10, 30), starts=4),
    "full": Grid(
        scale_seeds=6,
        seeds=30,
        schedules=((1, 0), (5, 1), (15, 1), (30, 1), (5, 2), (15, 2), (30, 2)),
        steps=(10, 30, 100),
        starts=10,
    ),
}
"""How much to measure, by name: `small` for half an hour on two processors."""

PICTURES: Final = "pictures"
FIGURES: Final = ("distance", "seed_distance", "error", "expected_error", "ball_score")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    add("--grid", default="small", help=f"how much: {', '.join(GRIDS)} (default: small)")
    add("--only", metavar="NAME,...", help=f"parts: {', '.join(SECTIONS)} (default: all)")
    add("--painter", default="mini", help=f"{', '.join(PAINTERS)} (default: mini)")
    add("--preset", default="draft", help="schedule and bracket (default: draft)")
    add("--seed", type=int, default=0, help="of the first ball (default: 0)")
    add("--workers", type=int, default=1, help="processes, each with a panorama at a time (default: 1)")
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure what the folder of `--out` does not hold yet; write and print.

    Raises:
        OptionError: no such grid, part, painter or preset.
        ProbeError: maps or files that do not serve, or a folder that cannot be written.
    """
    started = time.perf_counter()
    if args.grid not in GRIDS:
        raise OptionError("--grid", args.grid, ", ".join(GRIDS))
    sections = _sections(args.only)
    chosen = preset(args.preset)
    check_workers(args.workers)
    files = panorama_files(args.panoramas)
    prepare_output(args)
    models = ModelFiles.of(args)
    studio = open_studio(args.painter, models)
    run_identity = {
        "bench": "stability",
        "panoramas": [path.stem for path in files],
        "painter": identity(args.painter, models),
        "grid": args.grid,
        "preset": args.preset,
        "seed": args.seed,
    }
    journal = Journal(args.out, run_identity, unit=("panorama", "family", "variant"))
    settings = Settings(
        rounds=chosen.rounds,
        evs=chosen.evs,
        seed=args.seed,
        canvas=studio.canvas,
        diameter=studio.diameter,
        height=4 * ROWS,
    )
    plan = Plan(settings, args.grid, sections, None if args.out is None else args.out / PICTURES)
    bench_stability(
        files,
        studio_for_workers(args.workers, studio, args.painter, models),
        plan,
        journal,
        workers=args.workers,
        report=say,
    )
    rows = [_with_ratio(row) for row in journal.rows if row["section"] in sections]
    rows += [{"panorama": None, "seed_distance": None, "ratio": None, **row} for row in precision_rows()]
    summary = summarize(rows)
    protocol = {
        "painter": args.painter,
        "grid": args.grid,
        "preset": args.preset,
        "distance": f"mean over directions and RGB of |log2| of two maps' ratio, each plus {FLOOR:g}; {ROWS} rows",
        "seed_distance": "the same between estimates from other seeds",
        "ratio": "of the two; in the summary, of their means over the panoramas",
    }
    seconds = time.perf_counter() - started
    evaluations = sum(row.get("evaluations", 0) for row in rows)
    report = Report("stability", protocol, rows, summary, seconds, (args.seed,), evaluations)
    if args.out is not None:
        write_page(args.out, summary, rows, protocol, args.out / PICTURES)
    publish(report, args, summary=_SUMMARY)


def _sections(only: str | None) -> tuple[str, ...]:
    names = tuple(SECTIONS) if only is None else tuple(only.split(","))
    for name in names:
        if name not in SECTIONS:
            raise OptionError("--only", name, ", ".join(SECTIONS))
    return names


@dataclass(frozen=True)
class Plan:
    """What is measured of every panorama.

    Attributes:
        settings: of an ordinary estimate.
        grid: of `GRIDS`.
        sections: of `SECTIONS`.
        pictures: folder for strips of pictures; None draws none.
    """

    settings: Settings
    grid: str
    sections: tuple[str, ...]
    pictures: Path | None


def bench_stability(
    panoramas: Sequence[Path],
    studio_of: Callable[[], Studio],
    plan: Plan,
    journal: Journal,
    *,
    workers: int = 1,
    report: Callable[[str], None] = lambda line: None,
) -> None:
    """Measure every variant on every panorama.

    Args:
        panoramas: maps.
        studio_of: gives painter, canvas and ball; asked once a panorama.
        plan: what to measure.
        journal: holds what is measured already, and keeps the rest.
        workers: processes; what `studio_of` has to be for more than one, `workers.results_of` says.
        report: told of each variant.
    """
    done = {path: frozenset(_labels(row) for row in journal.rows if row["panorama"] == path.stem) for path in panoramas}
    task = partial(_measure_panorama, studio_of=studio_of, plan=plan)
    for row in results_of(task, list(done.items()), workers):
        journal.add([row])
        report(f"{row['panorama']} {row['family']}, {row['variant']}: {row['distance']:.3f} stops")


def _labels(row: Row) -> tuple[str, str]:
    return row["family"], row["variant"]


def _measure_panorama(
    item: tuple[Path, frozenset[tuple[str, str]]], studio_of: Callable[[], Studio], plan: Plan
) -> Iterator[Row]:
    path, done = item
    panorama = Panorama(path, studio_of(), plan.settings, GRIDS[plan.grid], plan.pictures)
    for section in plan.sections:
        for family, variant, measured in SECTIONS[section](panorama):
            if (family, variant) not in done:
                yield {"section": section, **measured()}


def _with_ratio(row: Row) -> Row:
    return {**row, "ratio": _ratio(row["distance"], row["seed_distance"])}


def _ratio(distance: float, seed_distance: float | None) -> float | None:
    return distance / seed_distance if seed_distance else None


def summarize(rows: Sequence[Row]) -> list[Row]:
    """A record for each family and variant: means over the panoramas, and the ratio of the two distances."""
    summary = []
    for family, variant in dict.fromkeys(map(_labels, rows)):
        own = [row for row in rows if _labels(row) == (family, variant)]
        known = {key: [row[key] for row in own if row.get(key) is not None] for key in FIGURES}
        means = {key: fmean(values) if values else None for key, values in known.items()}
        head = {"family": family, "variant": variant, "panoramas": len(own), "unit": own[0]["unit"]}
        summary.append({**head, **means, "ratio": _ratio(fmean(known["distance"]), means["seed_distance"])})
    return summary


_SUMMARY: Final = (
    Column("family", "family"),
    Column("variant", "variant"),
    Column("distance", "distance", ".3g"),
    Column("of seeds", "seed_distance", ".3f"),
    Column("ratio", "ratio", ".2f"),
    Column("error", "error", ".2f"),
    Column("expected", "expected_error", ".2f"),
    Column("ball", "ball_score", ".2f"),
)
