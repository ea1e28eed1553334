"""Train the mini model's depth ControlNet on its finished base."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from diffusers import ControlNetModel
from jaxtyping import Float
from torch import Generator, Tensor

from ..backends.mini import MiniModel
from ..ball import Ball, paint_depth
from .denoiser import TextBank, draw_batch, time_ids, velocity_loss
from .loop import Budget, train
from .scenes import SceneSampler

__all__ = ["train_control"]


def train_control(
    model: MiniModel, sampler: SceneSampler, budget: Budget, folder: Path, *, batch: int, report: Callable[[str], None]
) -> dict[str, dict[str, Tensor]]:
    """Train the ControlNet, started as a copy of the UNet's encoder; UNet and text encoders stay as they are.

    The first layers that look at the depth map keep their random start: at full picture size they would cost as much
    as the rest together, and random features of a disc and a ramp lose nothing of them.

    Args, Returns: as `base.train_base`.
    """
    control = model.controlnet
    control.load_state_dict(ControlNetModel.from_unet(model.unet).state_dict(), strict=False)
    model.unet.requires_grad_(False)
    hint = control.controlnet_cond_embedding
    hint.requires_grad_(False)
    hint.conv_out.requires_grad_(True)
    side = model.defaults.canvas
    with torch.no_grad():
        tokens, pooled = TextBank(model).embed()

    def loss_of_step(step: int) -> Tensor:
        drawn = draw_batch(sampler, step, batch, full_canvas=side)
        generator = torch.Generator().manual_seed(sampler.seed * 104_729 + step)
        depth = torch.cat([_depth(ball, generator) for ball in drawn.balls]).permute(0, 3, 1, 2)
        text = {"encoder_hidden_states": tokens[drawn.captions]}
        added = {"text_embeds": pooled[drawn.captions], "time_ids": time_ids(batch, side)}
        down, middle = control(
            drawn.noisy, drawn.timesteps, controlnet_cond=depth, added_cond_kwargs=added, return_dict=False, **text
        )
        predicted = model.unet(
            drawn.noisy,
            drawn.timesteps,
            added_cond_kwargs=added,
            down_block_additional_residuals=down,
            mid_block_additional_residual=middle,
            **text,
        ).sample
        return velocity_loss(predicted, drawn)

    return train({"controlnet": control.train()}, loss_of_step, budget, folder, report=report)


def _depth(ball: Ball, generator: Generator) -> Float[Tensor, "1 s s 3"]:
    """A depth map with the ball: nothing behind it, or ground that comes nearer towards the bottom."""
    if float(torch.rand((), generator=generator)) < 0.5:
        return paint_depth(None, ball)
    start, power = torch.rand(2, generator=generator).tolist()
    ramp = ((torch.linspace(0, 1, ball.canvas) - start * 0.6).clamp(min=0)) ** (0.5 + 1.5 * power)
    depth = paint_depth(ramp[None, :, None, None].expand(1, -1, ball.canvas, 1), ball)
    disc = paint_depth(None, ball)
    return torch.maximum(depth * 0.8, disc)
