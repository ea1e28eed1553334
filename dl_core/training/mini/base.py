"""Train the mini model's base: UNet and text encoders on pictures of scenes with a chrome ball."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from ...backends.mini import MiniModel
from .denoiser import TextBank, draw_batch, spell_out_attention, time_ids, velocity_loss
from .feed import Ahead, Feed
from .loop import Budget, train, training_device
from .scene_sampler import SceneSampler

__all__ = ["train_base", "wake_text_encoders"]


def train_base(
    model: MiniModel,
    sampler: SceneSampler,
    budget: Budget,
    folder: Path,
    *,
    feed: Feed,
    fresh: bool = True,
    report: Callable[[str], None],
) -> dict[str, dict[str, Tensor]]:
    """Train UNet and text encoders together.

    Args:
        model: its networks are trained in place.
        sampler: draws the pictures.
        budget: steps and learning rate.
        folder: for checkpoints and the log.
        feed: what a step is given.
        fresh: whether the networks have their random start, rather than weights to go on from.
        report: told of progress.

    Returns:
        Averaged weights by network name.
    """
    device = training_device()
    networks = {name: getattr(model, name).train().to(device) for name in ("unet", "text_encoder", "text_encoder_2")}
    spell_out_attention(model.unet)
    bank = TextBank(model)
    side = model.defaults.canvas
    batches = Ahead(lambda step: draw_batch(sampler, step, feed, full_canvas=side), feed.loaders)
    sizes = time_ids(feed.batch, side).to(device)

    def loss_of_step(step: int) -> Tensor:
        drawn = batches(step).to(device)
        tokens, pooled = bank.embed()
        predicted = model.unet(
            drawn.noisy,
            drawn.timesteps,
            tokens[drawn.captions],
            added_cond_kwargs={"text_embeds": pooled[drawn.captions], "time_ids": sizes},
        ).sample
        return velocity_loss(predicted, drawn)

    if fresh and not (folder / "checkpoint.pt").is_file():
        wake_text_encoders(model)
    return train(networks, loss_of_step, budget, folder, report=report)


@torch.no_grad()
def wake_text_encoders(model: MiniModel) -> None:
    """CLIP starts its embeddings at a deviation of 0.02, too faint for a UNet to hear within a short training."""
    generator = torch.Generator().manual_seed(49408)
    for encoder in (model.text_encoder, model.text_encoder_2):
        embeddings = encoder.get_input_embeddings().weight
        embeddings.copy_(0.5 * torch.randn(embeddings.shape, generator=generator).to(embeddings))
