"""What unwrap and merge lose when the painter makes no mistake, or only a known one.

A true orthographic mirror ball of a known panorama, exposed at the bracket's EVs and rounded to 8 bits, goes through
each combination of merge and unwrap; the map that comes out is compared with the panorama. With `--misaligned` the
exposures disagree as `misalign` describes.

A run with `--out` keeps its rows in `rows.jsonl` panorama by panorama, and goes on from them when it is run again.
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby, islice
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from ..errors import OptionError
from ..exposure import MERGES, auto_exposure, expose, merge_bracket, parse_evs
from ..geometry import ball_to_latlong, latlong_to_ball, latlong_to_perspective
from ..imageio import read_envmap
from ..metrics import angular_error, energy_kept, irradiance, si_rmse, spread_directions
from ..presets import PAPER_EVS
from ..shapes import BallImage, Latlong
from .charts import bar_chart
from .journal import Journal, fingerprint
from .misalign import MISALIGNMENTS, misaligned_bracket
from .reference import reference_merge, reference_unwrap
from .report import (
    Column,
    Report,
    Row,
    add_output,
    add_panoramas,
    panorama_files,
    prepare_output,
    publish,
    summarize_groups,
)

__all__ = ["EXPOSURES", "UNWRAPS", "WAYS", "Case", "add_arguments", "bench_oracle", "recover", "run", "summarize"]

NORMALS: Final = 400
BATCH_VALUES: Final = 1 << 26
"""Values of maps that are compared at once: 256 MB."""
LONG_EVS: Final = (*PAPER_EVS, -7.5, -10.0)
ALIGNED: Final = next(iter(MISALIGNMENTS))

UNWRAPS: Final[dict[str, Callable[[BallImage, int], Latlong]]] = {
    # As `estimate` unwraps: what a painter leaves beside the ball is not looked at.
    "footprint": lambda ball, height: ball_to_latlong(ball, height, painted=True),
    "reference": reference_unwrap,
}
"""Ways from a ball to a map, the package's own first."""

WAYS: Final = (*MERGES, "reference", "ceiling", "hdr")
"""Merges of `MERGES`; the authors' order, which merges maps that are unwrapped and rounded; the true ball, clipped at
the bracket's ceiling, which no merge can pass; the true ball."""

EXPOSURES: Final[dict[str, Callable[[Latlong], Tensor]]] = {
    "map": lambda latlong: latlong,
    # The paper's own input: 256 x 192 pixels, 60 degrees high, that is 75.2 degrees wide.
    "crop": lambda latlong: latlong_to_perspective(latlong, 192, 256, fov=75.18),
}
"""What the exposure is set on: the picture whose 99th percentile of intensity becomes 0.9 on display."""

PROTOCOL: Final[Row] = {
    "normals": NORMALS,
    "bits": 8,
    "gamma": 2.4,
    "exposure": "99th percentile of all channel values to 0.9 on display",
    "energy_kept": "radiance integrated over the sphere, channels summed, as a share of the truth's",
    "irradiance_si_rmse": "one scale for all normals and channels, mean over both, relative to the mean irradiance",
    "irradiance_angular_error_deg": "mean over normals of the angle between RGB irradiances",
    "ldr_rmse": "of the map, display-encoded with gamma 2.4 and clipped at EV 0, over pixels and channels",
    "worst": "the panorama furthest from the ideal: 1 for energy kept, 0 for the others",
}

IDEALS: Final = {
    "energy_kept": 1.0,
    "irradiance_si_rmse": 0.0,
    "irradiance_angular_error_deg": 0.0,
    "ldr_rmse": 0.0,
}

FIGURES: Final = (
    Column("misaligned", "misaligned"),
    Column("EVs", "evs"),
    Column("merge", "merge"),
    Column("unwrap", "unwrap"),
    Column("energy kept", "energy_kept", ".3f"),
    Column("irradiance si-RMSE", "irradiance_si_rmse", ".4f"),
    Column("irradiance angle (deg)", "irradiance_angular_error_deg", ".2f"),
    Column("LDR RMSE", "ldr_rmse", ".4f"),
)


@dataclass(frozen=True)
class Case:
    """One way from a ball to a map.

    Attributes:
        misaligned: level of `MISALIGNMENTS`.
        evs: of the bracket.
        merge: of `WAYS`.
        unwrap: of `UNWRAPS`.
    """

    misaligned: str
    evs: tuple[float, ...]
    merge: str
    unwrap: str

    def labels(self) -> Row:
        """The case as it stands in a row."""
        evs = ",".join(f"{ev:g}" for ev in self.evs)
        return {"misaligned": self.misaligned, "evs": evs, "merge": self.merge, "unwrap": self.unwrap}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add_output(parser)
    add = parser.add_argument
    add("--evs", nargs="+", metavar="0,-2.5,-5", help="brackets (default: 0,-2.5,-5 and the same to -10)")
    add("--merge", nargs="+", choices=WAYS, default=list(WAYS), help="merges; hdr is the true ball (default: all)")
    add("--unwrap", nargs="+", choices=tuple(UNWRAPS), default=list(UNWRAPS), help="unwraps (default: all)")
    add("--ball", type=int, default=256, metavar="PX", help="diameter of the ball (default: 256)")
    add(
        "--exposure",
        choices=tuple(EXPOSURES),
        default="map",
        help="what EV 0 is set on: the whole map, or the paper's 60 degree crop straight ahead (default: map)",
    )
    add("--misaligned", nargs="*", choices=tuple(MISALIGNMENTS), help="levels; all without one (default: aligned)")
    add("--seed", type=int, default=0, help="of misalignments (default: 0)")


def run(args: argparse.Namespace) -> None:
    """Measure, write, draw and print.

    Raises:
        ProbeError: options, maps or folders that cannot be used.
    """
    started = time.perf_counter()
    brackets = [PAPER_EVS, LONG_EVS] if args.evs is None else [parse_evs(text) for text in args.evs]
    levels = [ALIGNED] if args.misaligned is None else args.misaligned or list(MISALIGNMENTS)
    if not 16 <= args.ball <= 4096:
        raise OptionError("--ball", args.ball, "16 to 4096 pixels")
    files = panorama_files(args.panoramas)
    if len({path.stem for path in files}) < len(files):
        raise OptionError("--panoramas", str(args.panoramas), "one map of a name; rows are told apart by it")
    prepare_output(args)
    cases = list(_cases(levels, brackets, args.merge, args.unwrap))
    journal = Journal(args.out, _identity(args, files, cases), len(cases))
    rows = bench_oracle(files, cases, ball=args.ball, exposure=args.exposure, seed=args.seed, journal=journal)
    summary = summarize(rows)
    report = Report("oracle", PROTOCOL, rows, summary, time.perf_counter() - started, seeds=(args.seed,))
    if args.out is not None:
        bars = [(" ".join(str(line[key]) for key in Case(ALIGNED, (), "", "").labels()), line) for line in summary]
        bar_chart(args.out / "oracle", bars, "irradiance_si_rmse", "si-RMSE of irradiance, median and worst")
    publish(report, args, rows=(Column("panorama", "panorama"), *FIGURES), summary=FIGURES)


def _identity(args: argparse.Namespace, files: Sequence[Path], cases: Sequence[Case]) -> Row:
    """What has to be the same for a run to be gone on with; files only as a fingerprint.

    All of them count: each is the other scene of the next one's misalignments.
    """
    return {
        "ball": args.ball,
        "exposure": args.exposure,
        "seed": args.seed,
        "cases": [" ".join(map(str, case.labels().values())) for case in cases],
        "panoramas": fingerprint(*files),
    }


def _cases(
    levels: Sequence[str], brackets: Sequence[tuple[float, ...]], merges: Sequence[str], unwraps: Sequence[str]
) -> Iterator[Case]:
    """Every combination that differs: the authors' order has its own unwrap, true balls are of no level or bracket."""
    for level in levels:
        for evs in brackets:
            for merge in merges:
                if (merge == "hdr" and (level, evs) != (levels[0], brackets[0])) or (
                    merge == "ceiling" and level != levels[0]
                ):
                    continue
                chosen = ["reference"] if merge == "reference" else unwraps
                yield from (Case(level, evs, merge, unwrap) for unwrap in chosen)


def recover(ball_hdr: BallImage, other_hdr: BallImage, cases: Sequence[Case], height: int, seed: int) -> list[Latlong]:
    """The maps that cases of one level and one bracket make of a ball.

    Args:
        ball_hdr: the true ball, linear radiance.
        other_hdr: that of another scene, for misalignments that mix scenes.
        cases: ways, which share the pictures that are painted of the ball.
        height: rows of the maps.
        seed: of the misalignment.
    """
    level, evs = cases[0].misaligned, cases[0].evs
    painted = misaligned_bracket(ball_hdr, evs, level, seed=seed, other=other_hdr)
    merged: dict[str, BallImage] = {"hdr": ball_hdr, "ceiling": ball_hdr.clamp(max=2.0 ** -evs[-1])}
    merged |= {case.merge: merge_bracket(painted, evs, case.merge) for case in cases if case.merge in MERGES}
    found: dict[Case, Latlong] = {}
    for unwrap in dict.fromkeys(case.unwrap for case in cases):
        ways = [case for case in cases if case.unwrap == unwrap and case.merge in merged]
        if ways:
            maps = UNWRAPS[unwrap](torch.cat([merged[case.merge] for case in ways]), height)
            found |= zip(ways, maps.split(1), strict=True)
    return [found[case] if case in found else reference_merge(painted, evs, height) for case in cases]


def bench_oracle(
    panoramas: Sequence[Path],
    cases: Sequence[Case],
    *,
    ball: int = 256,
    exposure: str = "map",
    seed: int = 0,
    journal: Journal | None = None,
) -> list[Row]:
    """Measure every case on every panorama.

    Args:
        panoramas: files of linear radiance.
        cases: ways from a ball to a map.
        ball: its diameter in pixels.
        exposure: key of `EXPOSURES`.
        seed: of misalignments; each panorama has its own, by name.
        journal: holds the panoramas that are measured already, and keeps the others.

    Returns:
        One row a panorama and case: their names, and the figures of `PROTOCOL`. The other scene of a misalignment is
        the panorama before it, for the first one the last.
    """
    journal = journal or Journal(None, {}, len(cases))

    @lru_cache(maxsize=2)
    def scene(path: Path) -> tuple[Latlong, BallImage]:
        latlong = _exposed(path, exposure)
        return latlong, latlong_to_ball(latlong, ball)

    for before, path in zip([panoramas[-1], *panoramas], panoramas, strict=False):
        if not journal.has(path.stem):
            other, (latlong, true_ball) = scene(before)[1], scene(path)
            own = seed + zlib.crc32(path.stem.encode())
            found = _recovered(true_ball, other, cases, latlong.shape[1], own)
            journal.add([{"panorama": path.stem, "ball_px": ball, **row} for row in _compared(found, latlong)])
    order = [path.stem for path in panoramas]
    return sorted(journal.rows, key=lambda row: order.index(row["panorama"]))


def _recovered(
    ball: BallImage, other: BallImage, cases: Sequence[Case], height: int, seed: int
) -> Iterator[tuple[Case, Latlong]]:
    for _, same in groupby(cases, key=lambda case: (case.misaligned, case.evs)):
        group = list(same)
        yield from zip(group, recover(ball, other, group, height, seed), strict=True)


def _compared(found: Iterator[tuple[Case, Latlong]], truth: Latlong) -> Iterator[Row]:
    """Figures of maps; so many of them at a time that irradiance is cheap and memory bounded."""
    normals = spread_directions(NORMALS)
    lit_truth, shown = irradiance(truth, normals), expose(truth, 0.0)
    while batch := list(islice(found, max(1, BATCH_VALUES // truth.numel()))):
        lit = irradiance(torch.cat([latlong for _, latlong in batch]), normals).split(1)
        for (case, latlong), light in zip(batch, lit, strict=True):
            yield {
                **case.labels(),
                "energy_kept": energy_kept(latlong, truth),
                "irradiance_si_rmse": si_rmse(light, lit_truth),
                "irradiance_angular_error_deg": angular_error(light, lit_truth),
                "ldr_rmse": float((expose(latlong, 0.0) - shown).square().mean().sqrt()),
            }


def _exposed(path: Path, exposure: str) -> Latlong:
    latlong = read_envmap(path)
    return latlong * auto_exposure(EXPOSURES[exposure](latlong))


def summarize(rows: Sequence[Row]) -> list[Row]:
    """Median and worst over the panoramas, a row for each case, in the order of the cases."""
    return summarize_groups(rows, ("misaligned", "evs", "merge", "unwrap"), IDEALS)
