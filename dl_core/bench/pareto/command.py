"""`lightprobe bench pareto`: error against cost over schedules, as a chart.

Every schedule estimates the light of a photograph taken inside each panorama. Cost is denoiser evaluations (NFE),
counted; seconds are this machine's, and those of any other by seconds a guided step. Errors are those of the
three-spheres protocol and the direction of the strongest light, with intervals over the scenes.

Balls that schedules share are painted once (`shared_balls`), and what is measured is kept line by line, so a run that
is killed goes on and loses one estimate of each of its processes at most. A process takes those schedules of a panorama
that may share balls.

Source: DiffusionLight, Sec. 5.1 (errors) and the appendix on running time (the schedules it compares).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Final

from ...backends.loading import ModelFiles
from ...bracket import darkest_of
from ...errors import ImageError, OptionError
from ...estimate import Settings, estimate
from ...imageio import read_envmap
from ...metrics import light_direction_error
from ...progress_lines import say
from ...resize import resize_latlong
from ...shapes import Latlong
from ..bootstrap import LEVEL, Interval, mean_interval
from ..cameras import Camera, Shot, take
from ..front import on_front
from ..journal import Journal
from ..painters import PAINTERS, Studio, add_files, identity, open_studio, studio_for_workers
from ..paintings import VARIANTS
from ..report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish
from ..scoring import MAP_ROWS, PROTOCOLS, SPHERES, score_maps
from ..shared_balls import SharedBalls
from ..workers import check_workers, results_of
from .files import FIGURES, write_files
from .schedules import GRIDS, Schedule

__all__ = ["ERRORS", "add_arguments", "bench_pareto", "run", "summarize"]

PROTOCOL: Final = "three-spheres"
STEERED: Final = VARIANTS["both"]

ERRORS: Final = tuple(key for key, _ in FIGURES)
"""Figures of a schedule, each with its interval; those of spheres are means over the three."""
RANKED: Final = "angular_error_deg"
"""The figure that the front is of."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    add("--grid", default="small", help=f"schedules: {', '.join(GRIDS)} (default: small)")
    add("--painter", default="mini", help=f"{', '.join(PAINTERS)} (default: mini)")
    add("--only", metavar="NAME,...", help="schedules of the grid, by name (default: all of it)")
    add("--convention", choices=PROTOCOLS[PROTOCOL].conventions, default="published", help="how errors are counted")
    add("--seconds-per-step", type=float, help="of a guided step on the machine to plan for, for a column of its own")
    add("--seed", type=int, default=0, help="of the first ball (default: 0)")
    add(
        "--workers",
        type=int,
        default=1,
        help="processes, each with a part of a panorama at a time (default: 1)",
    )
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure what the folder of `--out` does not hold yet; write and print.

    Raises:
        OptionError: no such grid, painter or schedule, or seconds that are none.
        ProbeError: maps or files that do not serve, or a folder that cannot be written.
    """
    started = time.perf_counter()
    schedules = _schedules(args.grid, args.only)
    if args.seconds_per_step is not None and not args.seconds_per_step > 0:
        raise OptionError("--seconds-per-step", args.seconds_per_step, "above 0")
    check_workers(args.workers)
    files = panorama_files(args.panoramas)
    prepare_output(args)
    models = ModelFiles.of(args)
    studio = open_studio(args.painter, models)
    run_identity = {
        "bench": "pareto",
        "panoramas": [path.stem for path in files],
        "painter": identity(args.painter, models),
        "convention": args.convention,
        "seed": args.seed,
    }
    journal = Journal(args.out, run_identity, unit=("panorama", "schedule"))
    bench_pareto(
        files,
        studio_for_workers(args.workers, studio, args.painter, models),
        schedules,
        journal,
        convention=args.convention,
        seed=args.seed,
        workers=args.workers,
        report=say,
    )
    rows = summarize(journal.rows, schedules, args.painter, args.seconds_per_step)
    summary = [row for row in rows if row["on_front"]]
    protocol = {
        "painter": args.painter,
        "grid": args.grid,
        "convention": args.convention,
        "camera": Camera().name,
        "scenes": len(files),
        "interval": _interval_of(len(files)),
        "ranked_by": RANKED,
        "seconds": "of painting, as if no ball was shared; of the first painting of each",
        **PROTOCOLS[PROTOCOL].conditions,
    }
    report = Report(
        "pareto",
        protocol,
        rows,
        summary,
        time.perf_counter() - started,
        seeds=(args.seed,),
        evaluations=sum(row["nfe"] for row in journal.rows),
    )
    if args.out is not None:
        write_files(args.out, rows, f"{args.painter}, panoramas: {len(files)}")
    publish(report, args, rows=_columns(args.seconds_per_step))


def _schedules(grid: str, only: str | None) -> list[Schedule]:
    if grid not in GRIDS:
        raise OptionError("--grid", grid, ", ".join(GRIDS))
    schedules = GRIDS[grid]()
    if only is None:
        return schedules
    by_name = {schedule.name: schedule for schedule in schedules}
    for name in only.split(","):
        if name not in by_name:
            raise OptionError("--only", name, "; ".join(by_name))
    return [by_name[name] for name in only.split(",")]


def _interval_of(scenes: int) -> str:
    if scenes == 1:
        return "none: one panorama says nothing of others"
    return f"{LEVEL:.0%} of the mean over scenes, by resampling them"


def bench_pareto(
    panoramas: Sequence[Path],
    studio_of: Callable[[], Studio],
    schedules: Sequence[Schedule],
    journal: Journal,
    *,
    convention: str,
    seed: int = 0,
    workers: int = 1,
    report: Callable[[str], None] = lambda line: None,
) -> None:
    """Measure every schedule on every panorama.

    Args:
        panoramas: maps.
        studio_of: gives painter, canvas and ball; asked once a panorama and number of steps.
        schedules: to compare.
        journal: holds what is measured already, and keeps the rest.
        convention: of `PROTOCOLS`' three spheres.
        seed: of the first ball.
        workers: processes; what `studio_of` has to be for more than one, `workers.results_of` says.
        report: told of each estimate.

    Raises:
        OptionError: the journal holds a schedule of the same name that was something else.
    """
    _require_same(journal, schedules)
    units = [
        _Unit(path, [s for s in alike if not journal.has(path.stem, s.name)])
        for alike in _alike(schedules)
        for path in panoramas
    ]
    task = partial(_measure_unit, studio_of=studio_of, convention=convention, seed=seed)
    for name, row in results_of(task, [unit for unit in units if unit.schedules], workers):
        if row is None:
            report(f"{name}: left out, this painter has no sampler or guidance to change")
            continue
        journal.add([row])
        report(f"{name}: {row['nfe']} evaluations")


def _alike(schedules: Sequence[Schedule]) -> list[list[Schedule]]:
    """Schedules that may share balls, which those of other numbers of steps do not; the dearest first, so that workers
    end at nearly the same time."""
    groups: dict[int, list[Schedule]] = {}
    for schedule in schedules:
        groups.setdefault(schedule.preset.rounds.steps, []).append(schedule)
    return sorted(groups.values(), key=lambda group: -max(schedule.preset.guided_steps for schedule in group))


@dataclass(frozen=True)
class _Unit:
    """A map and schedules that are not measured on it yet: a worker's piece of work."""

    path: Path
    schedules: list[Schedule]


def _measure_unit(
    unit: _Unit, studio_of: Callable[[], Studio], convention: str, seed: int
) -> Iterator[tuple[str, Row | None]]:
    """What is measured, by name, and its row; None for a schedule that the painter cannot run."""
    studio, stem = studio_of(), unit.path.stem
    shot = take(read_envmap(unit.path), Camera())
    own = studio.painter_of(STEERED, shot)
    painters: dict[tuple[str | None, float | None], SharedBalls] = {}
    base = Settings(seed=seed, canvas=studio.canvas, diameter=studio.diameter, darkest=darkest_of(own))
    for schedule in unit.schedules:
        name, varied = f"{stem} {schedule.name}", schedule.painter(own)
        if varied is None:
            yield name, None
            continue
        painter = painters.setdefault((schedule.sampler, schedule.guidance), SharedBalls(varied))
        settings = replace(STEERED.settings(schedule.preset, base), bracket=schedule.bracket)
        head = {"panorama": stem, "schedule": schedule.name, "settings": _told(schedule)}
        yield name, {**head, **_measure(shot, painter, settings, convention)}


def _told(schedule: Schedule) -> str:
    return json.dumps(schedule.settings, sort_keys=True)


def _require_same(journal: Journal, schedules: Sequence[Schedule]) -> None:
    """Keep a preset that was changed since from standing beside its old figures."""
    told = {schedule.name: _told(schedule) for schedule in schedules}
    for row in journal.rows:
        if row["settings"] != told.get(row["schedule"], row["settings"]):
            accepted = f"a new folder: {row['schedule']} was {row['settings']} there"
            raise OptionError("--out", str(journal.path), accepted)


def _measure(shot: Shot, painter: SharedBalls, settings: Settings, convention: str) -> Row:
    before = painter.seconds
    probe = estimate(shot.photo_ldr, painter, settings)
    scores = score_maps(probe.latlong_hdr, shot.truth_hdr, PROTOCOL, convention)
    maps = [resize_latlong(light, MAP_ROWS) for light in (probe.latlong_hdr, shot.truth_hdr)]
    spheres = {f"{key}_{row['sphere']}": row[key] for row in scores for key in ERRORS if key in row}
    return {
        "nfe": probe.evaluations,
        "guided_step_nfe": painter.evaluations(1, 1, 1.0),
        "seconds": painter.seconds - before,
        **{key: fmean(row[key] for row in scores) for key in ERRORS if key in scores[0]},
        **spheres,
        "light_direction_error_deg": _direction_error(*maps),
    }


def _direction_error(estimate_hdr: Latlong, truth_hdr: Latlong) -> float | None:
    try:
        return float(light_direction_error(estimate_hdr, truth_hdr))
    except ImageError:  # one of the maps is black
        return None


def summarize(
    measured: Sequence[Row], schedules: Sequence[Schedule], painter: str, seconds_per_step: float | None
) -> list[Row]:
    """A row for each schedule, dearest last: what it is, cost, errors with intervals, and whether it is on the front.

    Args:
        measured: rows of `bench_pareto`.
        schedules: to report; those without a row are left out.
        painter: its name.
        seconds_per_step: of a guided step elsewhere, for the column `seconds_there`; None for no such column.
    """
    rows = []
    for schedule in schedules:
        # By panorama, since workers end in any order and an interval's draws go by it.
        own = sorted((row for row in measured if row["schedule"] == schedule.name), key=lambda row: row["panorama"])
        if not own:
            continue
        nfe = fmean(row["nfe"] for row in own)
        row: Row = {
            "schedule": schedule.name,
            "kind": schedule.kind,
            "preset": schedule.name if schedule.kind == "preset" else None,
            **schedule.settings,
            "painter": painter,
            "scenes": len(own),
            "nfe": nfe,
            "seconds": fmean(line["seconds"] for line in own),
        }
        if seconds_per_step is not None:
            row["seconds_there"] = nfe / own[0]["guided_step_nfe"] * seconds_per_step
        for key in ERRORS:
            known = [line[key] for line in own if line[key] is not None]
            row |= _with_ends(key, mean_interval(known) if known else None)
        for key in own[0]:
            if key.rpartition("_")[2] in SPHERES:
                row[key] = fmean(line[key] for line in own)
        rows.append(row)
    rows.sort(key=lambda row: row["nfe"])
    marks = on_front([(row["nfe"], row[RANKED]) for row in rows])
    return [row | {"on_front": mark} for row, mark in zip(rows, marks, strict=True)]


def _with_ends(key: str, interval: Interval | None) -> Row:
    # The contract's names leave the unit out of an interval's ends.
    names = (key, *(f"{key.removesuffix('_deg')}_{end}" for end in ("low", "high")))
    values = (None, None, None) if interval is None else (interval.mean, interval.low, interval.high)
    return dict(zip(names, values, strict=True))


def _columns(seconds_per_step: float | None) -> tuple[Column, ...]:
    there = () if seconds_per_step is None else (Column("s there", "seconds_there", ".0f"),)
    return (
        Column("schedule", "schedule"),
        Column("NFE", "nfe", ".0f"),
        Column("s here", "seconds", ".1f"),
        *there,
        Column("angle (deg)", "angular_error_deg", ".2f"),
        Column("from", "angular_error_low", ".2f"),
        Column("to", "angular_error_high", ".2f"),
        Column("normalized RMSE", "normalized_rmse", ".3f"),
        Column("si-RMSE", "si_rmse", ".3f"),
        Column("light (deg)", "light_direction_error_deg", ".1f"),
        Column("front", "on_front"),
    )
