"""Train a regressor: the mini model's own UNet, asked for the ball at once instead of for a step of denoising.

It is the honest rival of the diffusion model: as many parameters, the same pictures, the same prompts for exposure.
What it gives is the mean of all balls that a photograph allows, in one evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ...backends.mini import MiniModel
from ...exposure_prompts import embedding_at
from ...prompts import DARK_PROMPT, PROMPT
from .autoencoder import block_latents
from .base import wake_text_encoders
from .denoiser import TextBank, latent_disc, spell_out_attention, time_ids
from .feed import Ahead, Feed
from .loop import Budget, train, training_device
from .scene_sampler import BASE_CAPTIONS, SceneSampler

__all__ = ["train_regressor", "visible"]


def visible(latents: Float[Tensor, "b k m m"], discs: Float[Tensor, "b 1 m m"]) -> Float[Tensor, "b k m m"]:
    """What a regressor may see of a picture's latents: those the inpaint disc does not touch; the rest is 0.

    A latent at the rim holds some of the ball itself in training, and none of it when a ball is to be given.
    """
    return latents * (discs == 0)


def train_regressor(
    model: MiniModel, sampler: SceneSampler, budget: Budget, folder: Path, *, feed: Feed, report: Callable[[str], None]
) -> dict[str, dict[str, Tensor]]:
    """Train UNet and text encoders to give a ball's latents from the photograph's around it.

    Args:
        model: its UNet and text encoders are trained in place.
        sampler: draws balls at EVs uniform in [EV_min, 0] (`bracket=True`).
        budget: steps and learning rate.
        folder: for checkpoints and the log.
        feed: what a step is given; a picture has no levels of noise here.
        report: told of progress.

    Returns:
        Averaged weights by network name.
    """
    device = training_device()
    networks = {name: getattr(model, name).train().to(device) for name in ("unet", "text_encoder", "text_encoder_2")}
    spell_out_attention(model.unet)
    bank, side = TextBank(model), model.defaults.canvas
    original, dark = BASE_CAPTIONS.index(PROMPT), BASE_CAPTIONS.index(DARK_PROMPT)
    blocks = 8 * sampler.canvas // side

    def draw(step: int) -> tuple[Tensor, Tensor, Tensor]:
        pictures = [sampler.draw(step * feed.batch + i) for i in range(feed.batch)]
        clean = block_latents(torch.cat([picture.canvas_ldr for picture in pictures]), blocks)
        latents = clean.shape[-1]
        discs = torch.cat([latent_disc(picture.ball, latents, grow=picture.ball.dilation) for picture in pictures])
        return clean, discs, torch.tensor([picture.ev for picture in pictures])

    batches = Ahead(draw, feed.loaders)
    sizes = time_ids(feed.batch, side).to(device)

    def loss_of_step(step: int) -> Tensor:
        clean, discs, evs = (tensor.to(device) for tensor in batches(step))
        tokens, pooled = bank.embed()
        found = model.unet(
            visible(clean, discs),
            torch.zeros(feed.batch, dtype=torch.long, device=device),
            embedding_at(tokens[original, None], tokens[dark, None], evs, sampler.ev_min),
            added_cond_kwargs={
                "text_embeds": embedding_at(pooled[original, None], pooled[dark, None], evs, sampler.ev_min),
                "time_ids": sizes,
            },
        ).sample
        return (discs * (found - clean).square()).sum() / (discs.sum() * clean.shape[1])

    if not (folder / "checkpoint.pt").is_file():
        wake_text_encoders(model)
    return train(networks, loss_of_step, budget, folder, report=report)
