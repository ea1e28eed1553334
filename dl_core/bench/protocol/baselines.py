"""Answers that no diffusion model gives: what a method has to be better than, and the floor it cannot get under."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F

from ...errors import OptionError
from ...estimate import Settings, estimate
from ...exposure import decode_display
from ...imageio import read_envmap, write_exr
from ...iterative import Rounds
from ...painter import Painter
from ...resize import resize_latlong
from ...shapes import Image, Latlong
from ...training.mini.mean_light import MEAN_FILE
from ..cameras import Shot
from ..paintings import Painting, photographed
from ..perfect import PerfectPainter, RoundTripPainter

__all__ = ["BASELINES", "Answer", "answer_maps", "open_baselines"]


@dataclass(frozen=True)
class Answer:
    """A map, and the evaluations of a network that it took."""

    latlong_hdr: Latlong
    evaluations: int = 0


Baseline = Callable[[Shot], Answer]

BASELINES: Final[dict[str, str]] = {
    "vae-floor": "true balls through the mini model's autoencoder",
    "mean": "mean of all training light",
    "stretched": "photograph stretched over the sphere",
    "regressor": "regressor, as many parameters",
}
"""Labels of the baselines by name."""


def open_baselines(names: Sequence[str], regressor: Path | None, settings: Settings) -> dict[str, Baseline]:
    """Baselines by name.

    Args:
        names: of `BASELINES`.
        regressor: folder of the regressor's files.
        settings: canvas, ball, bracket and rows of the map.

    Raises:
        OptionError: a regressor without its folder.
        ModelError: files of the regressor that do not serve.
        ImageError: the mean light cannot be read.
    """
    make = {
        "vae-floor": lambda: _floor(settings),
        "mean": lambda: _mean(settings),
        "stretched": lambda: lambda shot: Answer(_stretched(shot, settings)),
        "regressor": lambda: _regressor(regressor, settings),
    }
    return {name: make[name]() for name in names}


# Networks take seconds to import, so only the baseline that wants them does.


def _mean(settings: Settings) -> Baseline:
    from ...backends.mini import MINI_FOLDER

    light = resize_latlong(read_envmap(MINI_FOLDER / MEAN_FILE), settings.height)
    return lambda shot: Answer(light)


def _floor(settings: Settings) -> Baseline:
    from ...backends.mini import load_mini

    vae: Any = load_mini(without=("unet", "controlnet", "text_encoder", "text_encoder_2")).vae

    @torch.no_grad()
    def code(canvas: Image) -> Image:
        latents = vae.encode(canvas.permute(0, 3, 1, 2) * 2 - 1).latents
        return (vae.decode(latents).sample / 2 + 0.5).permute(0, 2, 3, 1)

    return lambda shot: _one_pass(shot, RoundTripPainter(PerfectPainter(shot.truth_hdr), code), settings)


def _one_pass(shot: Shot, painter: Painter, settings: Settings) -> Answer:
    """What a painter that needs no second ball makes of a photograph."""
    probe = estimate(shot.photo_ldr, painter, replace(settings, rounds=Rounds(balls=1, rounds=0, steps=1, final=False)))
    return Answer(probe.latlong_hdr, probe.evaluations)


def _stretched(shot: Shot, settings: Settings) -> Latlong:
    """The photograph's radiance as if it were a map; what it clipped stays clipped."""
    rows = settings.height
    planes = decode_display(shot.photo_ldr).permute(0, 3, 1, 2)
    size = (rows, 2 * rows)
    return F.interpolate(planes, size=size, mode="bilinear", antialias=True).permute(0, 2, 3, 1)


def _regressor(folder: Path | None, settings: Settings) -> Baseline:
    if folder is None:
        raise OptionError("--regressor", None, "the folder that `lightprobe train mini regressor` wrote")
    from ...training.mini.regressor_painter import RegressorPainter

    painter = RegressorPainter(folder)
    return lambda shot: _one_pass(shot, painter, settings)


def answer_maps(
    paintings: Sequence[Painting], baselines: dict[str, Baseline], folder: Path, *, report: Callable[[str], None]
) -> None:
    """Answer to every photograph of a run that the folder holds no answer to yet.

    Args:
        paintings: what to answer to; a painting's variant names the baseline.
        baselines: of `open_baselines`.
        folder: of the run.
        report: told of each map, once it is written.

    Raises:
        OutputError: the folder cannot be written.
    """
    wanted = [painting for painting in paintings if not painting.map_in(folder).is_file()]
    for shot, of_shot in photographed(wanted, folder):
        for painting in of_shot:
            answer, path = baselines[painting.variant](shot), painting.map_in(folder)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_exr(path, answer.latlong_hdr[0], metadata={"lightprobe:nfe": str(answer.evaluations)})
            report(f"{painting.shot} {BASELINES[painting.variant]}")
