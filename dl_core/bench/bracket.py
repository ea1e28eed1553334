"""`lightprobe bench bracket`: what a scene-sized bracket keeps and costs, beside the fixed one and darker starts.

Photographs are taken inside panoramas as in the paper's three spheres (Sec. 5.1), and maps estimated in several ways:

- `fixed`: every exposure of the preset;
- `scene`: EV 0, and darker ones while the last one clips, down to what the painter was made for;
- `median G`: every exposure of the preset, the darker ones not from noise but by SDEdit with strength G from the next
  brighter median, darkened in linear light.

The last was tried for cost: it spares the share 1 - G of a darker exposure's steps. It is not on offer outside this
bench; see `DarkenedPainter` for what was measured.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from jaxtyping import Float
from torch import Tensor

from ..backends.loading import ModelFiles
from ..ball import crop_disc, paste_ball
from ..estimate import Probe, Settings, estimate
from ..exposure import decode_display, encode_display, expose, luminance
from ..geometry import latlong_to_ball
from ..imageio import read_envmap
from ..median import pixelwise_median
from ..metrics import angular_error, energy_kept, irradiance, light_direction_error, si_rmse, spread_directions
from ..painter import Observer, Painter, PaintRequest, PaintResult
from ..presets import preset
from ..shapes import BallImage, Latlong
from .cameras import cameras_of, take
from .journal import Journal
from .painters import PAINTERS, Studio, add_files, identity, open_studio
from .paintings import VARIANTS
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

__all__ = ["WAYS", "DarkenedPainter", "Way", "add_arguments", "bench_bracket", "run"]

NORMALS: Final = 400
STEERED: Final = "both"
"""The row of the ablation whose exposures are steered."""


@dataclass
class DarkenedPainter:
    """Paints darker exposures from the next brighter median instead of from noise.

    That median times 2^(step in EV) in linear light, pasted in the photograph, is the canvas of SDEdit. What clips in
    the brighter exposure is too dark in it, and left for the painter to brighten.

    Measured with the mini model of 100,000 pictures on the six validation panoramas (`lightprobe bench bracket
    --painter mini --ways fixed "median 0.8" "median 0.6" --panoramas DIR`, seed 0, draft): evaluations fall from 108 to
    84 and 72, and the RMSE of darker exposures from 0.123 to 0.084 and 0.098 at the median; but in every scene the
    darkest one's lights are dimmer: nearer the truth in the three where they were too bright, further in the others, at
    worst -3.1 and -2.8 stops off in place of 1.9. The merged light is the same (si-RMSE of irradiance 0.736 each time,
    as the model's EV 0 hardly clips). Lights are what darker exposures are painted for, so the start is not on offer.

    Attributes:
        painter: paints.
        strength: of SDEdit, above 0, below 1.
    """

    painter: Painter
    strength: float
    _medians: dict[float, BallImage] = field(default_factory=dict)

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """See `painter.Painter`; of EV 0, the most."""
        return self.painter.evaluations(balls, steps, strength, until)

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """See `painter.Painter`; exposures are asked for from the brightest on."""
        if request.ev == 0 and request.strength == 1:
            self._medians.clear()
        brighter = [ev for ev in self._medians if ev > request.ev]
        if brighter and request.strength == 1:
            nearest = min(brighter)
            darkened = encode_display(decode_display(self._medians[nearest]) * 2.0 ** (request.ev - nearest))
            canvas = paste_ball(request.canvas, darkened, request.ball)
            request = replace(request, canvas=canvas, strength=self.strength)
        result = self.painter.paint(request, observer)
        self._medians[request.ev] = pixelwise_median(result.balls)
        return result


@dataclass(frozen=True)
class Way:
    """A way to estimate.

    Attributes:
        bracket: of `bracket.BRACKETS`.
        around: what is put around the painter.
    """

    bracket: str = "fixed"
    around: Callable[[Painter], Painter] = lambda painter: painter


def _darkened(strength: float) -> Way:
    return Way(around=lambda painter: DarkenedPainter(painter, strength))


WAYS: Final[dict[str, Way]] = {
    "fixed": Way(),
    "scene": Way(bracket="scene"),
    "median 0.9": _darkened(0.9),
    "median 0.8": _darkened(0.8),
    "median 0.6": _darkened(0.6),
}

_IDEALS: Final = {
    "energy_kept": 1.0,
    "irradiance_si_rmse": 0.0,
    "irradiance_angular_error_deg": 0.0,
    "light_direction_error_deg": 0.0,
    "darker_rmse": 0.0,
    "highlight_stops": 0.0,
    "evaluations": 0.0,
}
_FIGURES: Final = (
    Column("way", "way"),
    Column("energy kept", "energy_kept", ".3f"),
    Column("irradiance si-RMSE", "irradiance_si_rmse", ".3f"),
    Column("irradiance angle (deg)", "irradiance_angular_error_deg", ".2f"),
    Column("light (deg)", "light_direction_error_deg", ".1f"),
    Column("darker RMSE", "darker_rmse", ".4f"),
    Column("highlights (stops)", "highlight_stops", ".2f"),
    Column("evaluations", "evaluations", "g"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    add("--painter", default="perfect", help=f"{', '.join(PAINTERS)} (default: perfect)")
    add("--ways", nargs="+", choices=tuple(WAYS), default=["fixed", "scene"], help="ways (default: fixed scene)")
    add("--preset", default="draft", help="schedule and bracket (default: draft)")
    add("--seed", type=int, default=0, help="of the first ball (default: 0)")
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: a folder without maps, files of the painter that do not serve, or a report that cannot be written.
    """
    started = time.perf_counter()
    files, chosen = panorama_files(args.panoramas), preset(args.preset)
    prepare_output(args)
    models = ModelFiles.of(args)
    same = {
        "bench": "bracket",
        "panoramas": [path.stem for path in files],
        "ways": args.ways,
        "preset": args.preset,
        "seed": args.seed,
        "painter": identity(args.painter, models),
    }
    studio = open_studio(args.painter, models)
    settings = Settings(chosen.rounds, chosen.evs, args.seed, canvas=studio.canvas, diameter=studio.diameter)
    rows = bench_bracket(files, studio, settings, args.ways, journal=Journal(args.out, same, len(args.ways)))
    report = Report(
        "bracket",
        {
            "painter": args.painter,
            "preset": args.preset,
            "camera": "three-spheres",
            "normals": NORMALS,
            "darker_rmse": "of display values on the disc against the true ball, over exposures below EV 0",
            "highlight_stops": "log2 of the darkest exposure's brightest hundredth over the truth's, in luminance",
        },
        rows,
        summarize_groups(rows, ("way",), _IDEALS),
        time.perf_counter() - started,
        seeds=(args.seed,),
        evaluations=sum(row["evaluations"] for row in rows),
    )
    publish(report, args, rows=(Column("panorama", "panorama"), Column("EVs", "evs"), *_FIGURES), summary=_FIGURES)


def bench_bracket(
    panoramas: Sequence[Path],
    studio: Studio,
    settings: Settings,
    ways: Sequence[str],
    *,
    journal: Journal | None = None,
) -> list[Row]:
    """Estimate every panorama's light in every way.

    Args:
        panoramas: files of linear radiance.
        studio: gives the painters.
        settings: schedule, bracket, seed and sizes.
        ways: keys of `WAYS`.
        journal: holds the panoramas that are measured already, and keeps the others.

    Returns:
        One row a panorama and way.
    """
    journal = journal or Journal(None, {}, len(ways))
    for path in panoramas:
        if not journal.has(path.stem):
            journal.add([{"panorama": path.stem, **_measured(path, studio, settings, way)} for way in ways])
    order = [path.stem for path in panoramas]
    return sorted(journal.rows, key=lambda row: order.index(row["panorama"]))


def _measured(path: Path, studio: Studio, settings: Settings, way: str) -> Row:
    (camera,) = cameras_of("three-spheres", path.stem, settings.seed)
    shot = take(read_envmap(path), camera)
    painter = WAYS[way].around(studio.painter_of(VARIANTS[STEERED], shot))
    sized = replace(settings, bracket=WAYS[way].bracket, height=shot.truth_hdr.shape[1])
    probe = estimate(shot.photo_ldr, painter, sized)
    normals = spread_directions(NORMALS)
    lit, truth = irradiance(probe.latlong_hdr, normals), irradiance(shot.truth_hdr, normals)
    return {
        "way": way,
        "evs": ",".join(f"{ev:g}" for ev in probe.evs),
        "energy_kept": energy_kept(probe.latlong_hdr, shot.truth_hdr),
        "irradiance_si_rmse": si_rmse(lit, truth),
        "irradiance_angular_error_deg": angular_error(lit, truth),
        "light_direction_error_deg": float(light_direction_error(probe.latlong_hdr, shot.truth_hdr)),
        **_darker_figures(probe, shot.truth_hdr),
        "evaluations": probe.evaluations,
    }


def _darker_figures(probe: Probe, truth_hdr: Latlong) -> Row:
    """How near exposures below EV 0 are to the true ball's, and how bright the darkest one's lights are.

    Returns:
        `darker_rmse`, of display values on the disc, over those exposures; `highlight_stops`, log2 of the radiance of
        the darkest one's brightest hundredth over the truth's. None where EV 0 is all there is.
    """
    disc = crop_disc(probe.ball) > 0
    true = latlong_to_ball(truth_hdr, probe.ball.diameter)
    darker = [
        (exposure.ball[0][disc], expose(true, ev)[0][disc])
        for ev, exposure in zip(probe.evs[1:], probe.exposures[1:], strict=True)
    ]
    if not darker:
        return {"darker_rmse": None, "highlight_stops": None}
    squares = [float((found - wanted).square().mean()) for found, wanted in darker]
    found, wanted = (_highlight(picture) for picture in darker[-1])
    return {
        "darker_rmse": math.sqrt(sum(squares) / len(squares)),
        "highlight_stops": math.log2(found / wanted),
    }


def _highlight(shown: Float[Tensor, "n 3"]) -> float:
    """Mean luminance of the brightest hundredth of display values; at least a thousandth of a code of 8 bits."""
    light = luminance(decode_display(shown))[:, 0]
    return max(float(light.topk(max(1, len(light) // 100)).values.mean()), 1e-3 / 255)
