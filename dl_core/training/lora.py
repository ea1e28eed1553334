"""Train the exposure LoRA: one set of low-rank weights, steered by interpolated prompts.

Source: DiffusionLight, Sec. 4.2 (Eq. 4 and 5) and Appendix C.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from peft import LoraConfig
from peft.utils import get_peft_model_state_dict
from torch import Tensor

from ..backends.mini import MiniModel
from ..prompts import DARK_PROMPT, PROMPT
from .denoiser import OFF_BALL_WEIGHT, Batch, TextBank, draw_batch, time_ids, velocity_loss
from .loop import Budget, train
from .scenes import BASE_CAPTIONS, SceneSampler

__all__ = ["train_lora"]

ATTENTION_LAYERS = ["to_q", "to_k", "to_v", "to_out.0"]


def train_lora(
    model: MiniModel,
    sampler: SceneSampler,
    budget: Budget,
    folder: Path,
    *,
    batch: int,
    rank: int = 4,
    report: Callable[[str], None],
) -> dict[str, Tensor]:
    """Train the exposure LoRA on every attention layer of the UNet.

    Args:
        model: its UNet receives the LoRA; base weights and text encoders stay as they are.
        sampler: draws balls at EVs uniform in [EV_min, 0] (`bracket=True`).
        budget: steps and learning rate.
        folder: for checkpoints and the log.
        batch: pictures a step.
        rank: of the LoRA.
        report: told of progress.

    Returns:
        The LoRA's averaged weights in diffusers' key layout ("unet.….lora_A.weight").
    """
    model.unet.requires_grad_(False)
    config = LoraConfig(r=rank, lora_alpha=rank, target_modules=ATTENTION_LAYERS, init_lora_weights="gaussian")
    model.unet.add_adapter(config, adapter_name="exposure")
    side = model.defaults.canvas
    with torch.no_grad():
        tokens, pooled = TextBank(model).embed()
    original, dark = BASE_CAPTIONS.index(PROMPT), BASE_CAPTIONS.index(DARK_PROMPT)

    def loss_of_step(step: int) -> Tensor:
        drawn = draw_batch(sampler, step, batch, full_canvas=side)
        share = (drawn.evs / model.defaults.ev_min).view(-1, 1)
        predicted = model.unet(
            drawn.noisy,
            drawn.timesteps,
            torch.lerp(tokens[original], tokens[dark], share[..., None]),
            added_cond_kwargs={
                "text_embeds": torch.lerp(pooled[original], pooled[dark], share),
                "time_ids": time_ids(batch, side),
            },
        ).sample
        return velocity_loss(predicted, _ball_only(drawn))

    averaged = train({"unet": model.unet.train()}, loss_of_step, budget, folder, report=report)
    adapter = get_peft_model_state_dict(model.unet, averaged["unet"], adapter_name="exposure")
    return {f"unet.{key}": value for key, value in adapter.items()}


def _ball_only(batch: Batch) -> Batch:
    """The batch with no weight off the ball (Eq. 5)."""
    return replace(batch, weights=(batch.weights - OFF_BALL_WEIGHT) / (1 - OFF_BALL_WEIGHT))
