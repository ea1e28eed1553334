"""`lightprobe bench confidence`: whether an estimate knows how wrong it is.

Photographs are taken inside each panorama from several cameras, their light is estimated, and the error that the
estimate expects of itself is compared with the one it has: by rank correlations over photographs and over all
directions of all of them, and by what share of the worst tenth of directions lies in the fifth that is trusted least,
for each map and over all of them. Errors are compared in radiance, the photograph's white being 1, for that is what
lights a render; in stops, in which a dark corner counts as much as a lamp; and as the share of the scene's light that
is misplaced, which a scene's brightness does not enter.

With `--calibrate FILE` the weights of the evidence are fitted to the errors and written to the file. Figures of a run
that calibrates are on its own maps; run it again on others, with `--calibration FILE`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
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
from ..exposure import luminance
from ..imageio import atomic, read_envmap, require_writable
from ..misplaced import OVERALL, ROWS, light_misplaced, overall_evidence
from ..presets import preset
from ..progress_lines import say
from ..resize import resize_latlong
from .cameras import random_camera, take
from .confidence_fit import direction_shares, fit_shares, fit_weights, held_by_least_trusted, rank_correlation
from .journal import Journal
from .map_distance import log_error
from .painters import PAINTERS, Studio, add_files, identity, open_studio, studio_for_workers
from .paintings import VARIANTS
from .report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish
from .workers import check_workers, results_of

__all__ = ["add_arguments", "run"]

EVIDENCE_KEY: Final = "evidence"
ERROR_KEY: Final = "error"
OVERALL_KEY: Final = "overall"
LEVEL_KEY: Final = "luminance"
DIFFERENCE_KEY: Final = "difference"
STEERED: Final = VARIANTS["both"]


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
    summary = _summary(rows, _over_directions(measured, calibration))
    protocol = {
        "painter": args.painter,
        "preset": args.preset,
        "cameras": "drawn for each panorama: fov 30 to 150, elevation -45 to 45, any azimuth",
        "misplaced": "∫ |estimate - truth| dω / ∫ truth dω, of luminances",
        "error in radiance": "|estimate - truth| of luminances, the photograph's white at EV 0 being 1",
        "error in stops": f"mean over RGB of |log2| of estimate to truth, each plus {FLOOR:g}; maps of {ROWS} rows",
        "weights": dict(zip(EVIDENCE, calibration.weights, strict=True)),
        "overall": None if calibration.overall is None else dict(zip(OVERALL, calibration.overall, strict=True)),
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
        level, truth = (luminance(resize_latlong(light, ROWS))[0, ..., 0] for light in (small, shot.truth_hdr))
        seen = overall_evidence(probe.latlong_hdr, spread.stops, spread.clipped)
        rows.append(
            {
                "panorama": path.stem,
                "camera": camera.name,
                "evaluations": probe.evaluations,
                "misplaced": light_misplaced(probe.latlong_hdr, shot.truth_hdr),
                OVERALL_KEY: _rounded(seen),
                EVIDENCE_KEY: _rounded(evidence(spread, small).flatten(1)),
                ERROR_KEY: _rounded(error.flatten()),
                LEVEL_KEY: _rounded(level.flatten()),
                DIFFERENCE_KEY: _rounded((level - truth).abs().flatten()),
            }
        )
    yield rows


def _rounded(values: Tensor) -> Any:
    return np.round(values.double().numpy(), 4).tolist()


def _calibrate(measured: Sequence[Row], args: argparse.Namespace) -> Calibration:
    """Weights fitted to what was measured, written to the file asked for."""
    found = np.concatenate([np.asarray(row[EVIDENCE_KEY]) for row in measured], axis=1)
    errors = np.concatenate([np.asarray(row[ERROR_KEY]) for row in measured])
    weights = fit_weights(found, errors, np.tile(direction_shares(), len(measured)))
    shares = np.log2([row["misplaced"] for row in measured])
    names = [row["panorama"] for row in measured]
    overall = fit_shares(np.asarray([row[OVERALL_KEY] for row in measured]), shares, names)
    panoramas = len(set(names))
    said = f"{len(measured)} photographs in {panoramas} panoramas, painter {args.painter}, preset {args.preset}"
    calibration = Calibration(_weights(weights), said, _weights(overall))
    with atomic(args.calibrate) as temporary:
        temporary.write_text(json.dumps(calibration.document(), indent=1) + "\n", encoding="utf-8")
    return calibration


def _weights(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(round(float(value), 4) for value in values)


def _expected(row: Row, calibration: Calibration) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors to expect by direction, in stops and of luminance."""
    stops = np.asarray(calibration.weights) @ np.asarray(row[EVIDENCE_KEY])
    return stops, (np.asarray(row[LEVEL_KEY]) + FLOOR) * (np.exp2(stops) - 1)


def _judged(row: Row, calibration: Calibration) -> Row:
    """A photograph's row: its error, what was expected, and how well that is placed."""
    shares, errors, missed = direction_shares(), np.asarray(row[ERROR_KEY]), np.asarray(row[DIFFERENCE_KEY])
    expected, doubt = _expected(row, calibration)
    predicted = None
    if calibration.overall is not None:
        predicted = float(np.exp2(np.asarray(calibration.overall) @ np.asarray(row[OVERALL_KEY])))
    return {
        **{key: row[key] for key in ("panorama", "camera", "evaluations", "misplaced")},
        "expected_misplaced": predicted,
        "error_radiance": float(shares @ missed),
        "expected_error_radiance": float(shares @ doubt),
        "error_stops": float(shares @ errors),
        "expected_error_stops": float(shares @ expected),
        "worst_tenth_in_least_trusted_fifth": held_by_least_trusted(doubt, missed, shares),
        "worst_tenth_in_least_trusted_fifth_stops": held_by_least_trusted(expected, errors, shares),
    }


def _over_directions(measured: Sequence[Row], calibration: Calibration) -> Row:
    """How expected and actual errors of luminance go together over all directions of all photographs."""
    doubts = np.concatenate([_expected(row, calibration)[1] for row in measured])
    missed = np.concatenate([np.asarray(row[DIFFERENCE_KEY]) for row in measured])
    shares = np.tile(direction_shares(), len(measured)) / len(measured)
    return {
        "rank_correlation_directions": _number(rank_correlation(doubts.tolist(), missed.tolist())),
        f"{_HELD[0]}_directions": held_by_least_trusted(doubts, missed, shares),
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


def _summary(rows: Sequence[Row], over_directions: Row) -> list[Row]:
    def over(key: str) -> list[float]:
        return [row[key] for row in rows if row[key] is not None]

    errors = ("misplaced", "error_radiance", "error_stops")
    means = (*errors, *(f"expected_{key}" for key in errors), *_HELD)
    names = ("rank_correlation", "rank_correlation_radiance", "rank_correlation_stops")
    correlations = {
        name: _number(rank_correlation(over(f"expected_{key}"), over(key))) if over(f"expected_{key}") else None
        for name, key in zip(names, errors, strict=True)
    }
    return [
        {
            "photographs": len(rows),
            **correlations,
            **over_directions,
            **{f"{key}_mean" if key not in _HELD else key: fmean(over(key)) if over(key) else None for key in means},
        }
    ]


_HELD: Final = ("worst_tenth_in_least_trusted_fifth", "worst_tenth_in_least_trusted_fifth_stops")
_ROWS: Final = (
    Column("panorama", "panorama"),
    Column("camera", "camera"),
    Column("misplaced", "misplaced", ".2f"),
    Column("expected", "expected_misplaced", ".2f"),
    Column("error (radiance)", "error_radiance", ".3f"),
    Column("expected", "expected_error_radiance", ".3f"),
    Column("error (stops)", "error_stops", ".2f"),
    Column("expected", "expected_error_stops", ".2f"),
    Column("worst tenth held", _HELD[0], ".0%"),
    Column("in stops", _HELD[1], ".0%"),
)
_SUMMARY: Final = (
    Column("photographs", "photographs"),
    Column("misplaced", "misplaced_mean", ".2f"),
    Column("expected", "expected_misplaced_mean", ".2f"),
    Column("rank correlation", "rank_correlation", ".2f"),
    Column("error (radiance)", "error_radiance_mean", ".3f"),
    Column("expected", "expected_error_radiance_mean", ".3f"),
    Column("rank correlation", "rank_correlation_radiance", ".2f"),
    Column("over directions", "rank_correlation_directions", ".2f"),
    Column("error (stops)", "error_stops_mean", ".2f"),
    Column("expected", "expected_error_stops_mean", ".2f"),
    Column("rank correlation", "rank_correlation_stops", ".2f"),
    Column("worst tenth held by the least trusted fifth", _HELD[0], ".0%"),
    Column("over directions", f"{_HELD[0]}_directions", ".0%"),
    Column("in stops", _HELD[1], ".0%"),
)
