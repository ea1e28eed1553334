"""Pictures painted during training, for people to see what a LoRA has come to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ...backends.diffusers_lora import EXPOSURE
from ...backends.diffusers_painter import DiffusersPainter
from ...ball import Ball, fit_canvas, paint_depth, place_ball
from ...imageio import read_photograph, write_png
from ...painter import PaintRequest, SilentObserver
from ...shapes import Image

__all__ = ["PHOTOGRAPH", "VALIDATION_EVS", "Validation", "ValidationPictures"]

PHOTOGRAPH: Final = Path(__file__).resolve().parents[2] / "data" / "photos" / "coffee.jpg"
VALIDATION_EVS: Final = (0.0, -2.5, -5.0)
STEPS: Final = 10
SEED: Final = 1


@dataclass(frozen=True)
class Validation:
    """One ball of the same noise at each exposure, in the same photograph.

    Attributes:
        painter: with the adapter that is trained; its text embeddings are known already.
        canvas: (1, S, S, 3) display-encoded photograph.
        ball: where the ball goes.
        evs: exposures.
    """

    painter: DiffusersPainter
    canvas: Image
    ball: Ball
    evs: tuple[float, ...]

    @staticmethod
    def of(painter: DiffusersPainter, canvas: int, evs: tuple[float, ...]) -> Validation:
        """On the package's own photograph, the ball as large on the canvas as the painter's defaults have it."""
        defaults = painter.defaults
        ball = place_ball(canvas, 2 * max(8, round(canvas * defaults.diameter / defaults.canvas / 2)))
        return Validation(painter, fit_canvas(read_photograph(PHOTOGRAPH), canvas), ball, evs)

    @torch.no_grad()
    def sheet(self) -> Float[Tensor, "1 d w 3"]:
        """The balls side by side, in the order of the exposures, painted at the scale at which the LoRA is used."""
        pipeline = self.painter.pipeline
        unet, vae = pipeline.unet, pipeline.vae
        training, place = unet.training, vae.device
        unet.eval()
        unet.set_adapters(EXPOSURE, self.painter.defaults.lora_scale)
        vae.to(unet.device)
        depth = paint_depth(None, self.ball)
        try:
            balls = [
                self.painter.paint(
                    PaintRequest(self.canvas, depth, self.ball, ev, (SEED,), steps=STEPS), SilentObserver()
                ).balls
                for ev in self.evs
            ]
        finally:
            vae.to(place)
            unet.set_adapters(EXPOSURE, 1.0)
            unet.train(training)
        return torch.cat(balls, dim=2)


@dataclass(frozen=True)
class ValidationPictures:
    """Sheets as files.

    Attributes:
        validation: paints them.
        folder: for them; made when it is needed.
    """

    validation: Validation
    folder: Path

    @property
    def title(self) -> str:
        """What a sheet shows."""
        return "balls at EV " + ", ".join(f"{ev:g}" for ev in self.validation.evs)

    def paint(self, step: int) -> Float[Tensor, "1 d w 3"]:
        """Paint a sheet, write it as `step-000500.png`, and give it back.

        Raises:
            OutputError: it cannot be written.
        """
        self.folder.mkdir(exist_ok=True)
        sheet = self.validation.sheet()
        write_png(self.folder / f"step-{step:06d}.png", sheet[0])
        return sheet
