"""`lightprobe bench mend`: what each option around an estimate gains, error without and with it.

Photographs are taken inside panoramas, and maps estimated from them:

- `front`: the map's front filled with the photograph (`front_fill`), the field of view known;
- `level`: cameras that look up or down, their maps levelled by the pitch, against the level truth;
- `white-balance`: panoramas given casts, photographs balanced before painting; the case names cast and method.

Errors: `visible_rmse`, of display values at EV 0 over the directions that the photograph shows; of the whole map,
`map_rmse`, of linear radiance, which its lights rule, and `map_stops`, in which shades count as much; and what that
does to a render, the errors of the paper's three spheres in linear radiance, each the mean over the spheres.

A map that comes nearer the truth in every direction has a smaller `map_rmse`, `map_stops` and, but for light that
errors of both signs balance, `rmse` of spheres. It need not have a smaller `si_rmse` or `normalized_rmse`: they undo a
scale, and the latter an offset, that an estimate which is off everywhere alike has as a whole, and a mended one no
longer has.

A second opinion, painted at 0.75 or 0.5 of the ball's diameter and joined at the mean of the logarithms, was tried
against twice as many balls of one size, which cost as much, and dropped: on six photographs and the mini model's draft
the angle between colours rose in five and in six of them, and normalized RMSE in three each, by up to 63%. The better
one of the two by normalized RMSE, had one known it, had the larger angle in all six.

Sources: DiffusionLight, Sec. 5.1 (three spheres, cameras).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Final

import torch
from jaxtyping import Bool
from torch import Tensor

from ..backends.loading import ModelFiles
from ..confidence import FLOOR
from ..estimate import Probe, Settings
from ..exposure import expose, quantize
from ..front_fill import frame_distance, front_fill
from ..geometry import camera_rotation, latlong_solid_angles, rotate_latlong
from ..imageio import read_envmap
from ..mending import Mending, estimate_mended
from ..misplaced import ROWS
from ..presets import preset
from ..shapes import Latlong
from ..white_balance import WHITE_BALANCES
from .cameras import Camera, Shot, take
from .journal import Journal
from .map_distance import map_distance
from .painters import PAINTERS, Studio, add_files, identity, open_studio
from .paintings import VARIANTS
from .report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish
from .scoring import score_maps

__all__ = ["ERRORS", "OPTIONS", "Option", "add_arguments", "bench_mend", "run", "summarize"]

CONVENTION: Final = "radiance"
ON_SPHERES: Final = ("rmse", "si_rmse", "angular_error_deg", "normalized_rmse")
ERRORS: Final = ("visible_rmse", "map_rmse", "map_stops", *ON_SPHERES)
STEERED: Final = "both"
"""The row of the ablation whose exposures are steered."""
SAME: Final = 1e-3
"""Share of an error that counts as no change."""
CASTS: Final[dict[str, tuple[float, float, float]]] = {
    "none": (1.0, 1.0, 1.0),
    "warm": (1.3, 1.0, 0.75),
    "tungsten": (1.9, 1.0, 0.45),
    "blue": (0.55, 1.0, 1.8),
    "green": (0.7, 1.2, 0.7),
}
"""Factors in linear light of red, green and blue."""


@dataclass(frozen=True)
class _Setting:
    """A photograph and what to estimate it with."""

    shot: Shot
    camera: Camera
    studio: Studio
    settings: Settings

    def probe(self, mending: Mending | None = None) -> Probe:
        settings = replace(self.settings, height=self.shot.truth_hdr.shape[1])
        painter = self.studio.painter_of(VARIANTS[STEERED], self.shot)
        return estimate_mended(self.shot.photo_ldr, painter, settings, mending or Mending())

    def errors(self, latlong_hdr: Latlong, pitch: float = 0.0) -> dict[str, float]:
        """Errors of a map, in the camera's own axes or in level ones."""
        truth, rotation = self.shot.truth_hdr, camera_rotation(0.0, pitch)
        truth = rotate_latlong(truth, rotation) if pitch else truth
        rows, columns = self.shot.photo_ldr.shape[1:3]
        shown = frame_distance(truth.shape[1], rows, columns, self.camera.longer_fov, rotation) >= 0
        everywhere = torch.ones_like(shown)
        spheres = score_maps(latlong_hdr, truth, "three-spheres", CONVENTION)
        return {
            "visible_rmse": _rmse(expose(latlong_hdr, 0.0), expose(truth, 0.0), shown),
            "map_rmse": _rmse(latlong_hdr, truth, everywhere),
            "map_stops": map_distance(latlong_hdr, truth),
            **{key: fmean(row[key] for row in spheres) for key in ON_SPHERES},
        }


def _rmse(one: Latlong, other: Latlong, where: Bool[Tensor, "h w"]) -> float:
    """Root mean square difference of two maps over directions and channels."""
    weights = latlong_solid_angles(one.shape[1]) * where
    squares = (one - other).double().square().mean(dim=-1)[0]
    return math.sqrt(float((squares * weights).sum() / weights.sum()))


Case = tuple[str, dict[str, float], dict[str, float], int]
"""Name of a case, errors without the option and with it, and denoiser evaluations of both."""


def _front(at: _Setting) -> Iterator[Case]:
    probe = at.probe()
    photo_ldr = quantize(at.shot.photo_ldr)  # as its file holds it
    filled = front_fill(probe.latlong_hdr, photo_ldr, at.camera.longer_fov).latlong_hdr
    yield "filled", at.errors(probe.latlong_hdr), at.errors(filled), probe.evaluations


def _level(at: _Setting) -> Iterator[Case]:
    probe, pitch = at.probe(), at.camera.pitch
    levelled = rotate_latlong(probe.latlong_hdr, camera_rotation(0.0, pitch))
    yield "levelled", at.errors(probe.latlong_hdr, pitch), at.errors(levelled, pitch), probe.evaluations


def _white_balance(at: _Setting) -> Iterator[Case]:
    for cast, factors in CASTS.items():
        tinted = replace(at, shot=_tinted(at, factors))
        plain = tinted.probe()
        without = tinted.errors(plain.latlong_hdr)
        for method in WHITE_BALANCES:
            if method != "none":
                probe = tinted.probe(Mending(white_balance=method))
                spent = plain.evaluations + probe.evaluations
                yield f"{cast}, {method}", without, tinted.errors(probe.latlong_hdr), spent


def _tinted(at: _Setting, factors: tuple[float, float, float]) -> Shot:
    """The photograph that the same camera takes of the same light, tinted: exposed anew."""
    if factors == (1.0, 1.0, 1.0):
        return at.shot
    light = at.shot.truth_hdr * torch.tensor(factors)
    camera = replace(at.camera, yaw=0.0, pitch=0.0)  # the truth stands as the camera does already
    return take(light, camera)


@dataclass(frozen=True)
class Option:
    """An option and how it is measured.

    Attributes:
        cameras: that take the photographs.
        measure: (photograph and what to estimate it with) -> cases.
        cases: how many each photograph has.
    """

    cameras: tuple[Camera, ...]
    measure: Callable[[_Setting], Iterator[Case]]
    cases: int


_AROUND: Final = tuple(Camera(yaw=yaw) for yaw in (0.0, 120.0, -120.0))

OPTIONS: Final[dict[str, Option]] = {
    "front": Option(_AROUND, _front, 1),
    "level": Option(tuple(Camera(yaw=60.0, pitch=pitch) for pitch in (25.0, -25.0)), _level, 1),
    "white-balance": Option(_AROUND[:1], _white_balance, len(CASTS) * (len(WHITE_BALANCES) - 1)),
}
"""Options by name."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    add("--painter", default="mini", help=f"{', '.join(PAINTERS)} (default: mini)")
    add("--options", nargs="+", choices=tuple(OPTIONS), default=list(OPTIONS), help="to measure (default: all)")
    add("--preset", default="draft", help="schedule and bracket (default: draft)")
    add("--seed", type=int, default=0, help="of the first ball (default: 0)")
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure what the folder of `--out` does not hold yet, write and print.

    Raises:
        ProbeError: a folder without maps, files of the painter that do not serve, a folder of another run, or a report
            that cannot be written.
    """
    started = time.perf_counter()
    files, chosen, models = panorama_files(args.panoramas), preset(args.preset), ModelFiles.of(args)
    prepare_output(args)
    same = {
        "bench": "mend",
        "panoramas": [path.stem for path in files],
        "preset": args.preset,
        "seed": args.seed,
        "painter": identity(args.painter, models),
    }
    studio = open_studio(args.painter, models)
    settings = Settings(chosen.rounds, chosen.evs, args.seed, canvas=studio.canvas, diameter=studio.diameter)
    rows: list[Row] = []
    for name in args.options:
        folder = None if args.out is None else args.out / name
        if folder is not None:
            folder.mkdir(exist_ok=True)
        journal = Journal(folder, {**same, "option": name}, OPTIONS[name].cases, unit=("panorama", "camera"))
        rows += bench_mend(files, studio, settings, name, journal=journal)
    report = Report(
        "mend",
        {
            "painter": args.painter,
            "preset": args.preset,
            "convention": CONVENTION,
            "visible_rmse": "of display values at EV 0 over the directions that the photograph shows",
            "map_rmse": "of linear radiance, white at EV 0 being 1, over all directions",
            "map_stops": f"mean over directions and RGB of |log2| of the maps' ratio, each plus {FLOOR:g}; {ROWS} rows",
            "spheres": f"{', '.join(ON_SPHERES)}: each the mean over the three",
            "cameras": {name: [camera.name for camera in OPTIONS[name].cameras] for name in args.options},
            "casts": CASTS,
        },
        rows,
        summarize(rows),
        time.perf_counter() - started,
        seeds=(args.seed,),
        evaluations=sum(row["evaluations"] for row in rows),
    )
    publish(report, args, rows=_ROWS, summary=_SUMMARY)


def bench_mend(
    panoramas: Sequence[Path], studio: Studio, settings: Settings, option: str, *, journal: Journal | None = None
) -> list[Row]:
    """Measure an option on every panorama.

    Args:
        panoramas: files of linear radiance.
        studio: gives the painters.
        settings: schedule, bracket, seed and sizes.
        option: key of `OPTIONS`.
        journal: holds the photographs that are measured already, and keeps the others.

    Returns:
        One row a panorama, camera and case.
    """
    journal = journal or Journal(None, {}, OPTIONS[option].cases, unit=("panorama", "camera"))
    for path in panoramas:
        for camera in OPTIONS[option].cameras:
            if not journal.has(path.stem, camera.name):
                at = _Setting(take(read_envmap(path), camera), camera, studio, settings)
                head = {"panorama": path.stem, "camera": camera.name, "option": option}
                journal.add([{**head, **_row(case)} for case in OPTIONS[option].measure(at)])
    order = [path.stem for path in panoramas]
    return sorted(journal.rows, key=lambda row: order.index(row["panorama"]))


def _row(case: Case) -> Row:
    name, without, with_it, evaluations = case
    errors = {
        f"{key}_{which}": found[key] for key in ERRORS for which, found in (("without", without), ("with", with_it))
    }
    return {"case": name, **errors, "evaluations": evaluations}


def summarize(rows: Sequence[Row]) -> list[Row]:
    """For each case over the photographs: medians, the median and the worst ratio of with to without, and how many
    photographs' error rose by more than a thousandth."""
    summary = []
    for option, case in dict.fromkeys((row["option"], row["case"]) for row in rows):
        own = [row for row in rows if (row["option"], row["case"]) == (option, case)]
        line: Row = {"option": option, "case": case, "photographs": len(own)}
        for key in ERRORS:
            ratios = [row[f"{key}_with"] / max(row[f"{key}_without"], 1e-12) for row in own]
            line |= {f"{key}_{which}": median(row[f"{key}_{which}"] for row in own) for which in ("without", "with")}
            line[f"{key}_ratio_median"], line[f"{key}_ratio_worst"] = median(ratios), max(ratios)
            line[f"{key}_raised"] = sum(ratio > 1 + SAME for ratio in ratios)
        summary.append(line)
    return summary


_TITLES: Final = dict(
    zip(ERRORS, ("visible", "map RMSE", "map stops", "RMSE", "si-RMSE", "angle", "n. RMSE"), strict=True)
)
_ROWS: Final = (
    Column("panorama", "panorama"),
    Column("camera", "camera"),
    Column("case", "case"),
    *(
        Column(f"{title} {which}", f"{key}_{which}", ".3f")
        for key, title in _TITLES.items()
        for which in ("without", "with")
    ),
)
_SUMMARY: Final = (
    Column("option", "option"),
    Column("case", "case"),
    Column("photographs", "photographs"),
    *(
        column
        for key, title in _TITLES.items()
        for column in (Column(f"{title} ratio", f"{key}_ratio", ".3f"), Column("raised", f"{key}_raised"))
    ),
)
