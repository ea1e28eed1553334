"""`lightprobe bench quality`: how well good balls are told from bad ones, and how long it takes.

Photographs are taken inside each panorama; a good ball and one of each fault are drawn into every one (`faulty_balls`).
Told apart is measured by the area under the ROC curve: how often a good ball scores above a bad one. With `--painter`
balls that a model paints are judged as well.

With `--calibrate FILE` the checks are fitted to these balls and written to the file. Figures of such a run are on its
own balls; run it again on other maps, with `--judge FILE`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..backends.loading import ModelFiles
from ..errors import OptionError
from ..estimate import Settings, estimate
from ..imageio import atomic, read_envmap, require_writable
from ..presets import preset
from ..quality.features import BallFeatures, ball_features
from ..quality.judge import CHECKS, DOUBT, Judge, Logistic, Range, shipped_judge, worst_of
from ..quality.surroundings import contrast_of, exposures_check, rim_difference
from .cameras import Camera, Shot, random_camera, take
from .faulty_balls import FAULTS, examples
from .painters import PAINTERS, add_files, open_studio
from .paintings import VARIANTS
from .report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish

__all__ = ["add_arguments", "auc", "fit_logistic", "run"]

GOOD: Final = "good"
STEERED: Final = VARIANTS["both"]
SCENE_FAULTS: Final = ("tinted",)
"""Faults that a ball by itself may share with a scene of coloured light: counted apart."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    add("--split", help="only maps of this split of the folder's manifest.json")
    add("--cameras", type=int, default=6, help="photographs of each panorama, drawn at random (default: 6)")
    add("--calibrate", type=Path, metavar="FILE", help="fit the checks to these balls and write them")
    add("--judge", type=Path, metavar="FILE", help="checks to try (default: those that come along)")
    add("--painter", help=f"also judge balls painted by {', '.join(PAINTERS)} (default: none)")
    add("--preset", default="draft", help="of the painter (default: draft)")
    add("--seed", type=int, default=0, help="of cameras and balls (default: 0)")
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        OptionError: fewer than one camera, no such painter or preset, or both checks to make and to try.
        ProbeError: maps or files that do not serve, or a file that cannot be written.
    """
    started = time.perf_counter()
    if args.cameras < 1:
        raise OptionError("--cameras", args.cameras, "1 or more")
    if args.calibrate is not None and args.judge is not None:
        raise OptionError("--judge", str(args.judge), "nothing beside --calibrate: it makes one")
    files = panorama_files(args.panoramas, args.split)
    if args.calibrate is not None:
        require_writable(args.calibrate)
    prepare_output(args)
    judge = None
    if args.calibrate is None:
        judge = shipped_judge() if args.judge is None else Judge.read(args.judge)
    chosen = preset(args.preset)
    shots = [(path.stem, camera, shot) for path in files for camera, shot in _shots(path, args.cameras, args.seed)]
    rows = [row for index, (stem, camera, shot) in enumerate(shots) for row in _measured(stem, camera, shot, index)]
    if judge is None:
        panoramas = f"{len(shots)} photographs in {len(files)} panoramas"
        judge = _fitted(rows, [shot for _, _, shot in shots], f"balls rendered into {panoramas}")
        with atomic(args.calibrate) as temporary:
            temporary.write_text(json.dumps(judge.document(), indent=1) + "\n", encoding="utf-8")
    if args.painter is not None:
        models = ModelFiles.of(args)
        studio = open_studio(args.painter, models)
        settings = Settings(chosen.rounds, chosen.evs, args.seed, canvas=studio.canvas, diameter=studio.diameter)
        for stem, camera, shot in shots:
            probe = estimate(shot.photo_ldr, studio.painter_of(STEERED, shot), settings)
            balls = [exposure.ball for exposure in probe.exposures]
            agreed = exposures_check(balls, probe.evs).score
            rows.append(_row(stem, camera, args.painter, ball_features(balls[0]), agreed=agreed))
    rows = [_judged(row, judge) for row in rows]
    summary = _summary(rows, args.painter)
    protocol = {
        "cameras": "level, any azimuth, field of view 40 to 80",
        "balls": "64 pixels on a canvas of 256, EV 0, noise 0.01, half of them softened",
        "measured_on": judge.measured_on,
        "preset": args.preset if args.painter else None,
    }
    report = Report("quality", protocol, rows, summary, time.perf_counter() - started, (args.seed,))
    publish(report, args, rows=_ROWS, summary=_SUMMARY)


def _shots(path: Path, cameras: int, seed: int) -> Iterator[tuple[Camera, Shot]]:
    """Photographs of level cameras: the horizon is one of the things that are measured."""
    panorama = read_envmap(path)
    for number in range(cameras):
        drawn = random_camera(f"{path.stem}/{number}", seed)
        camera = replace(drawn, pitch=0.0, fov=round(40 + (drawn.fov - 30) / 3, 1))
        yield camera, take(panorama, camera)


def _measured(stem: str, camera: Camera, shot: Shot, seed: int) -> Iterator[Row]:
    for example in examples(shot, seed):
        started = time.process_time()  # of this process: others do not count
        features = ball_features(example.crop)
        seconds = time.process_time() - started
        rim = rim_difference(example.canvas_ldr, example.ball)
        yield _row(stem, camera, example.fault, features, seconds=seconds, rim=rim)


def _row(stem: str, camera: Camera, kind: str, features: BallFeatures, **more: float) -> Row:
    return {"panorama": stem, "camera": camera.name, "ball": kind, **features.values(), **more}


def _judged(row: Row, judge: Judge) -> Row:
    scores = judge.scores(row)
    return {**row, "score": worst_of(scores), **{f"{name}_score": score for name, score in scores.items()}}


# --- fitting -----------------------------------------------------------------------------------------------------


def auc(good: Sequence[float], bad: Sequence[float]) -> float:
    """Area under the ROC curve: how often a good one has the higher value, ties by half.

    Source: Hanley and McNeil, The meaning and use of the area under a ROC curve (Radiology 143, 1982).
    """
    a, b = np.asarray(good)[:, None], np.asarray(bad)[None, :]
    return float(((a > b) + 0.5 * (a == b)).mean())


def fit_logistic(
    good: NDArray[np.float64], bad: NDArray[np.float64], *, ridge: float = 3.0, rounds: int = 100
) -> tuple[NDArray[np.float64], float]:
    """Weights and offset of the logistic that tells good from bad, both counting alike however many there are.

    Args:
        good: (n, k) values.
        bad: (m, k) values.
        ridge: penalty on squared weights of values of unit variance.
        rounds: of Newton's method, at most.

    Source: Hastie, Tibshirani and Friedman, The Elements of Statistical Learning (2009), Sec. 4.4.1 (Newton steps).
    """
    values = np.concatenate((good, bad))
    mean, scale = values.mean(axis=0), values.std(axis=0) + 1e-9
    design = np.column_stack(((values - mean) / scale, np.ones(len(values))))
    target = np.concatenate((np.ones(len(good)), np.zeros(len(bad))))
    weight = np.concatenate((np.full(len(good), 0.5 / len(good)), np.full(len(bad), 0.5 / len(bad)))) * len(values)
    penalty = ridge * np.diag([*np.ones(design.shape[1] - 1), 0.0])
    found = np.zeros(design.shape[1])
    for _ in range(rounds):
        chance = 1 / (1 + np.exp(-design @ found))
        slope = design.T @ (weight * (target - chance)) - penalty @ found
        curvature = (design * (weight * chance * (1 - chance))[:, None]).T @ design + penalty
        step = np.linalg.solve(curvature, slope)
        found += step
        if np.abs(step).max() < 1e-9:
            break
    weights = found[:-1] / scale
    return weights, float(found[-1] - weights @ mean)


def _fitted(rows: Sequence[Row], shots: Sequence[Shot], said: str) -> Judge:
    def logistic(names: Sequence[str], faults: Sequence[str]) -> Logistic:
        good, bad = (
            np.array([[row[name] for name in names] for row in rows if row["ball"] in kinds])
            for kinds in ((GOOD,), faults)
        )
        weights, offset = fit_logistic(good, bad)
        return Logistic({n: round(float(w), 4) for n, w in zip(names, weights, strict=True)}, round(offset, 4))

    good = [row for row in rows if row["ball"] == GOOD]
    return Judge(
        checks={name: logistic(kind.features, kind.faults) for name, kind in CHECKS.items()},
        ranges={
            "contrast": _range([contrast_of(shot.photo_ldr) for shot in shots], 0.05),
            "upright": _range([row["upright"] for row in good], 0.05),
            "rim": _range([row["rim"] for row in good], 0.95),
        },
        measured_on=said,
    )


def _range(values: Sequence[float], limit: float) -> Range:
    return Range(round(float(np.median(values)), 3), round(float(np.quantile(values, limit)), 3))


# --- summary -----------------------------------------------------------------------------------------------------


def _summary(rows: Sequence[Row], painter: str | None) -> list[Row]:
    good = [row for row in rows if row["ball"] == GOOD]
    summary: list[Row] = []
    kinds: dict[str, tuple[str, ...]] = {fault: (fault,) for fault in FAULTS}
    kinds |= {"all but tinted": tuple(fault for fault in FAULTS if fault not in SCENE_FAULTS), "all": tuple(FAULTS)}
    for name, faults in kinds.items():
        bad = [row for row in rows if row["ball"] in faults]
        check = next((key for key, kind in CHECKS.items() if name in kind.faults), None)
        summary.append(
            {
                "balls": name,
                "count": len(bad),
                "auc": auc([row["score"] for row in good], [row["score"] for row in bad]),
                "check": check,
                "check_auc": None
                if check is None
                else auc([row[f"{check}_score"] for row in good], [row[f"{check}_score"] for row in bad]),
                "score_mean": fmean(row["score"] for row in bad),
                "milliseconds_median": 1000 * median(row["seconds"] for row in bad),
            }
        )
    for kind in (GOOD, *([painter] if painter else [])):
        own = [row for row in rows if row["ball"] == kind]
        summary.append(
            {
                "balls": kind,
                "count": len(own),
                "score_mean": fmean(row["score"] for row in own),
                "passed": sum(row["score"] >= DOUBT for row in own) / len(own),
                **{f"{name}_passed": sum(row[f"{name}_score"] >= DOUBT for row in own) / len(own) for name in CHECKS},
            }
        )
    return [{key: row.get(key) for key in dict.fromkeys(k for r in summary for k in r)} for row in summary]


_ROWS: Final[tuple[Column, ...]] = (
    Column("panorama", "panorama"),
    Column("camera", "camera"),
    Column("ball", "ball"),
    Column("score", "score", ".2f"),
    *(Column(name, f"{name}_score", ".2f") for name in CHECKS),
)
_SUMMARY: Final[tuple[Column, ...]] = (
    Column("balls", "balls"),
    Column("count", "count"),
    Column("AUC", "auc", ".3f"),
    Column("check", "check"),
    Column("its AUC", "check_auc", ".3f"),
    Column("mean score", "score_mean", ".2f"),
    Column("passed", "passed", ".0%"),
    *(Column(name, f"{name}_passed", ".0%") for name in CHECKS),
    Column("CPU ms a ball", "milliseconds_median", ".1f"),
)
