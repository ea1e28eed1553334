"""Train the decoder of the mini model's autoencoder; its encoder is a closed form (see `autoencoder`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from ...backends.mini import MiniModel
from .autoencoder import block_latents, decoder_loss, write_closed_form_encoder, write_thumbnail_decoder
from .loop import Budget, train
from .scene_sampler import SceneSampler

__all__ = ["train_decoder"]

LATENT_NOISE = 0.06
"""Noise on the latents, since those a denoiser paints are never exact."""


def train_decoder(
    model: MiniModel, sampler: SceneSampler, budget: Budget, folder: Path, *, batch: int, report: Callable[[str], None]
) -> dict[str, dict[str, Tensor]]:
    """Write the closed-form encoder, and train the decoder on crops around balls at EVs of the whole bracket.

    Args, Returns: as `base.train_base`; `sampler` draws at full size (`bracket=True`).
    """
    write_closed_form_encoder(model.vae)
    write_thumbnail_decoder(model.vae)
    model.vae.encoder.requires_grad_(False)

    def loss_of_step(step: int) -> Tensor:
        pictures = [sampler.draw(step * batch + i) for i in range(batch)]
        generator = torch.Generator().manual_seed(sampler.seed * 15_485_863 + step)
        crops = torch.cat([_crop(picture.canvas_ldr, picture.ball.centre, generator) for picture in pictures])
        latents = block_latents(crops)
        latents = latents + LATENT_NOISE * torch.randn(latents.shape, generator=generator)
        # The pipeline's range is [-1, 1].
        painted = model.vae.decoder(latents) / 2 + 0.5
        return decoder_loss(painted, crops.permute(0, 3, 1, 2))

    return train({"vae": model.vae.train()}, loss_of_step, budget, folder, report=report)


def _crop(canvas: Tensor, centre: tuple[float, float], generator: torch.Generator, side: int = 96) -> Tensor:
    """A crop near the ball, on the grid of latents: mostly ball, always some rim or surroundings."""
    limit = canvas.shape[1] - side
    offsets = (torch.rand(2, generator=generator) * 80 - 40).tolist()
    left, top = (
        max(0, min(limit, round((middle - side / 2 + offset) / 8) * 8))
        for middle, offset in zip(centre, offsets, strict=True)
    )
    return canvas[:, top : top + side, left : left + side]
