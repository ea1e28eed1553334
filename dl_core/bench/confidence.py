"""`lightprobe bench confidence`: whether an estimate knows how wrong it is.

Photographs are taken inside each panorama from several cameras, their light is estimated, and the error that the
estimate expects of itself is compared with the one it has: over photographs by rank correlation, and over the
directions of each map by what share of the worst tenth lies in the fifth that is trusted least.

With `--calibrate FILE` the weights of the evidence are fitted to the errors by least squares, none below 0, and written
to the file. Figures of a run that calibrates are on its own maps; run it again on others, with `--calibration FILE`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..backends.loading import ModelFiles
from ..confidence import EVIDENCE, FLOOR, Calibration, bracket_spread, evidence, shipped_calibration
from ..errors import OptionError
from ..estimate import Settings, estimate
from ..geometry import latlong_solid_angles
from ..imageio import atomic, read_envmap, require_writable
from ..presets import preset
from ..resize import resize_latlong
from .cameras import random_camera, take
from .journal import Journal
from .map_distance import ROWS, log_error
from .painters import PAINTERS, Studio, add_files, identity, open_studio, studio_for_workers
from .paintings import VARIANTS
from .report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish, say
from .workers import check_workers, results_of

__all__ = ["add_arguments", "fit_weights", "held_by_least_trusted", "rank_correlation", "run"]

EVIDENCE_KEY: Final = "evidence"
ERROR_KEY: Final = "error"
STEERED: Final = VARIANTS["both"]
LEAST_TRUSTED: Final = 0.2
WORST: Final = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    add("--painter", default="mini", help=f"{', '.join(PAINTERS)} (default: mini)")
    add("--preset", default="fast", help="schedule and bracket (default: fast)")
    add("--cameras", type=int, default=4, help="photographs of each panorama, drawn at random (default: 4)")
    add("--split", help="only maps of this split of the folder's manifest.json")
    add("--calibrate", type=Path, metavar="FILE", help="fit the weights to these maps and write them")
    add("--calibration", type=Path, metavar="FILE", help="weights to judge (default: those that come along)")
    add("--seed", type=int, default=0, help="of cameras and balls (default: 0)")
    add("--workers", type=int, default=1, help="processes, each with a panorama at a time (default: 1)")
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure what the folder of `--out` does not hold yet; write and print.

    Raises:
        OptionError: no such painter or preset, fewer than one camera, or both a calibration to make and one to judge.
        ProbeError: maps or files that do not serve, or a file that cannot be written.
    """
    started = time.perf_counter()
    if args.cameras < 1:
        raise OptionError("--cameras", args.cameras, "1 or more")
    if args.calibrate is not None and args.calibration is not None:
        raise OptionError("--calibration", str(args.calibration), "nothing beside --calibrate: it makes one")
    check_workers(args.workers)
    chosen = preset(args.preset)
    files = panorama_files(args.panoramas, args.split)
    if args.calibrate is not None:
        require_writable(args.calibrate)
    calibration = None
    if args.calibrate is None:
        calibration = shipped_calibration() if args.calibration is None else Calibration.read(args.calibration)
    prepare_output(args)
    models = ModelFiles.of(args)
    studio = open_studio(args.painter, models)
    run_identity = {
        "bench": "confidence",
        "panoramas": [path.stem for path in files],
        "painter": identity(args.painter, models),
        "preset": args.preset,
        "cameras": args.cameras,
        "seed": args.seed,
    }
    journal = Journal(args.out, run_identity, args.cameras)
    settings = Settings(
        rounds=chosen.rounds,
        evs=chosen.evs,
        seed=args.seed,
        canvas=studio.canvas,
        diameter=studio.diameter,
        height=4 * ROWS,
    )
    studio_of = studio_for_workers(args.workers, studio, args.painter, models)
    task = partial(_measure_panorama, studio_of=studio_of, settings=settings, cameras=args.cameras)
    wanted = [path for path in files if not journal.has(path.stem)]
    for rows in results_of(task, wanted, args.workers):
        journal.add(rows)
        say(f"{rows[0]['panorama']}: {len(rows)} photographs")
    measured = sorted(journal.rows, key=lambda row: (row["panorama"], row["camera"]))
    if calibration is None:
        calibration = _calibrate(measured, args)
    rows = [_judged(row, calibration) for row in measured]
    summary = _summary(rows)
    protocol = {
        "painter": args.painter,
        "preset": args.preset,
        "cameras": "drawn for each panorama: fov 30 to 150, elevation -45 to 45, any azimuth",
        "error": f"mean over RGB of |log2| of estimate to truth, each plus {FLOOR:g}; maps of {ROWS} rows",
        "weights": dict(zip(EVIDENCE, calibration.weights, strict=True)),
        "calibrated": "on these maps" if args.calibrate else f"on {calibration.measured_on}",
    }
    seconds = time.perf_counter() - started
    evaluations = sum(row["evaluations"] for row in rows)
    report = Report("confidence", protocol, rows, summary, seconds, (args.seed,), evaluations, headline=summary[0])
    publish(report, args, rows=_ROWS, summary=_SUMMARY)


def _measure_panorama(
    path: Path, studio_of: Callable[[], Studio], settings: Settings, cameras: int
) -> Iterator[list[Row]]:
    """Rows of all photographs of a panorama, with the evidence and the error of every direction."""
    studio, panorama, rows = studio_of(), read_envmap(path), list[Row]()
    for number in range(cameras):
        camera = random_camera(f"{path.stem}/{number}", settings.seed)
        shot = take(panorama, camera)
        probe = estimate(shot.photo_ldr, studio.painter_of(STEERED, shot), settings)
        spread = bracket_spread([exposure.balls for exposure in probe.exposures], probe.evs)
        small = resize_latlong(probe.latlong_hdr, ROWS)
        error = log_error(small, resize_latlong(shot.truth_hdr, ROWS))
        head = {"panorama": path.stem, "camera": camera.name, "evaluations": probe.evaluations}
        rows.append(
            {**head, EVIDENCE_KEY: _rounded(evidence(spread, small).flatten(1)), ERROR_KEY: _rounded(error.flatten())}
        )
    yield rows


def _rounded(values: Tensor) -> Any:
    return np.round(values.double().numpy(), 4).tolist()


# --- statistics --------------------------------------------------------------------------------------------------


def _angles() -> NDArray[np.float64]:
    """Solid angles of the directions, as shares of the sphere."""
    angles = latlong_solid_angles(ROWS).double().expand(ROWS, 2 * ROWS).flatten().numpy()
    return np.asarray(angles / angles.sum())


def fit_weights(
    found: NDArray[np.float64], errors: NDArray[np.float64], shares: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weights, none below 0, whose sum over the evidence is nearest the errors in the mean square.

    Args:
        found: (k, n) the evidence.
        errors: (n,) stops.
        shares: (n,) how much each counts.

    Returns:
        (k,). Exact: the least squares without bounds on some of the evidence is the least squares with bounds if no
        weight is below 0 there, and of all subsets with that the best is taken.
    """
    root = np.sqrt(shares)
    design, target = (found * root).T, errors * root
    best, least = np.zeros(len(found)), float(target @ target)
    for count in range(1, len(found) + 1):
        for chosen in combinations(range(len(found)), count):
            weights, *_ = np.linalg.lstsq(design[:, chosen], target, rcond=None)
            rest = target - design[:, chosen] @ weights
            if (weights >= 0).all() and rest @ rest < least:
                least, best = float(rest @ rest), np.zeros(len(found))
                best[list(chosen)] = weights
    return best


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float:
    """Spearman's rank correlation; NaN where one of the two is all alike or there are fewer than two values.

    Source: Spearman, The proof and measurement of association between two things (American Journal of Psychology 15,
    1904); ties get their mean rank.
    """
    ranks = [_ranks(np.asarray(values)) for values in (first, second)]
    if len(first) < 2 or any(np.ptp(rank) == 0 for rank in ranks):
        return math.nan
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def _ranks(values: NDArray[Any]) -> NDArray[np.float64]:
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return np.asarray((last - (counts - 1) / 2)[places], dtype=np.float64)


def held_by_least_trusted(
    expected: NDArray[np.float64], errors: NDArray[np.float64], shares: NDArray[np.float64]
) -> float:
    """Share of the worst tenth of directions that lies in the fifth that is trusted least; 0.2 by chance.

    Args:
        expected: (n,) errors expected.
        errors: (n,) errors there are.
        shares: (n,) of the sphere, that sum to 1.
    """
    doubted, worst = _top(expected, shares, LEAST_TRUSTED), _top(errors, shares, WORST)
    return float((doubted * worst * shares).sum() / (worst * shares).sum())


def _top(values: NDArray[np.float64], shares: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """1 on the highest values that make up so much of the sphere; the one at the edge counts in part."""
    order = np.argsort(-values, kind="stable")
    before = np.cumsum(shares[order]) - shares[order]
    inside = np.empty(len(values))
    inside[order] = np.clip((share - before) / shares[order], 0, 1)
    return inside


# --- judging -----------------------------------------------------------------------------------------------------


def _calibrate(measured: Sequence[Row], args: argparse.Namespace) -> Calibration:
    """Weights fitted to what was measured, written to the file asked for."""
    found = np.concatenate([np.asarray(row[EVIDENCE_KEY]) for row in measured], axis=1)
    errors = np.concatenate([np.asarray(row[ERROR_KEY]) for row in measured])
    weights = fit_weights(found, errors, np.tile(_angles(), len(measured)))
    panoramas = len({row["panorama"] for row in measured})
    said = f"{len(measured)} photographs in {panoramas} panoramas, painter {args.painter}, preset {args.preset}"
    calibration = Calibration(tuple(round(float(weight), 4) for weight in weights), said)
    with atomic(args.calibrate) as temporary:
        temporary.write_text(json.dumps(calibration.document(), indent=1) + "\n", encoding="utf-8")
    return calibration


def _judged(row: Row, calibration: Calibration) -> Row:
    """A photograph's row: its error, what was expected, and how well that is placed."""
    shares, errors = _angles(), np.asarray(row[ERROR_KEY])
    expected = np.asarray(calibration.weights) @ np.asarray(row[EVIDENCE_KEY])
    return {
        **{key: row[key] for key in ("panorama", "camera", "evaluations")},
        "error_stops": float(shares @ errors),
        "expected_error_stops": float(shares @ expected),
        "correlation_of_directions": rank_correlation(expected.tolist(), errors.tolist()),
        "worst_tenth_in_least_trusted_fifth": held_by_least_trusted(expected, errors, shares),
    }


def _summary(rows: Sequence[Row]) -> list[Row]:
    actual, expected = ([row[key] for row in rows] for key in ("error_stops", "expected_error_stops"))
    held = [row["worst_tenth_in_least_trusted_fifth"] for row in rows]
    correlations = [row["correlation_of_directions"] for row in rows]
    return [
        {
            "photographs": len(rows),
            "rank_correlation": rank_correlation(expected, actual),
            "error_stops_mean": fmean(actual),
            "expected_error_stops_mean": fmean(expected),
            "worst_tenth_in_least_trusted_fifth": fmean(held),
            "correlation_of_directions": fmean(correlations),
        }
    ]


_ROWS: Final = (
    Column("panorama", "panorama"),
    Column("camera", "camera"),
    Column("error (stops)", "error_stops", ".2f"),
    Column("expected", "expected_error_stops", ".2f"),
    Column("correlation", "correlation_of_directions", ".2f"),
    Column("worst tenth held", "worst_tenth_in_least_trusted_fifth", ".0%"),
)
_SUMMARY: Final = (
    Column("photographs", "photographs"),
    Column("rank correlation", "rank_correlation", ".2f"),
    Column("error (stops)", "error_stops_mean", ".2f"),
    Column("expected", "expected_error_stops_mean", ".2f"),
    Column("worst tenth held by the least trusted fifth", "worst_tenth_in_least_trusted_fifth", ".0%"),
    Column("correlation of directions", "correlation_of_directions", ".2f"),
)
