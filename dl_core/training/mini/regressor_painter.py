"""The trained regressor as a painter: one evaluation a ball, the same ball whatever the seed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from ...backends.diffusers_painter import DiffusersPainter
from ...backends.mini import NETWORK_FILES, load_mini, load_network
from ...painter import PaintRequest
from .denoiser import latent_disc, time_ids
from .regressor import visible

__all__ = ["RegressorPainter"]

TRAINED: Final = ("unet", "text_encoder", "text_encoder_2")


class RegressorPainter(DiffusersPainter):
    """Gives balls by regression. See `regressor`.

    Args:
        folder: holds the regressor's files, as its training wrote them; the autoencoder is the mini model's.

    Raises:
        ModelError: a file is missing, unreadable, or of another architecture.
    """

    def __init__(self, folder: Path) -> None:
        model = load_mini(without=(*TRAINED, "controlnet"))
        for name in TRAINED:
            load_network(getattr(model, name), folder / NETWORK_FILES[name], name)
        like = DiffusersPainter.from_mini(model)
        super().__init__(like.pipeline, like.defaults)

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """One a ball, whatever the schedule: what it gives is a clean image already."""
        return balls

    def _inpaint(
        self, request: PaintRequest, encoded: Any, hint: Tensor, seeds: tuple[int, ...], counted: Callable[[int], None]
    ) -> Tensor:
        """One evaluation of the regressor for each ball, whatever the schedule."""
        clean, _, _ = self._start(encoded, seeds)
        disc = latent_disc(request.ball, clean.shape[-1], grow=request.ball.dilation)
        guidance, count = self.guidance_at(request.ev), len(seeds)
        found = self.pipeline.unet(
            visible(clean, disc.expand(count, -1, -1, -1)),
            torch.zeros(count, dtype=torch.long),
            guidance.tokens.expand(count, -1, -1),
            added_cond_kwargs={
                "text_embeds": guidance.pooled.expand(count, -1),
                "time_ids": time_ids(count, request.ball.canvas),
            },
        ).sample
        counted(count)
        return torch.lerp(clean, found, disc)
