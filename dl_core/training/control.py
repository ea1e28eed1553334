"""Train the mini model's depth ControlNet, and go on training its base with it."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F
from diffusers import ControlNetModel
from jaxtyping import Float
from torch import Generator, Tensor

from ..backends.mini import MiniModel
from ..ball import Ball, paint_depth
from .denoiser import TextBank, draw_batch, spell_out_attention, time_ids, velocity_loss
from .loop import Budget, train
from .scenes import SceneSampler

__all__ = ["train_control"]

WITHOUT: Final = 0.1
"""Share of steps without the ControlNet, so that the base still works alone."""
NOISIEST: Final = 0.75
"""Share of the noisiest levels: there the ball's place and the scene's light are settled."""
_HINT: Final = "controlnet_cond_embedding."


def train_control(
    model: MiniModel,
    sampler: SceneSampler,
    budget: Budget,
    folder: Path,
    *,
    batch: int,
    fresh: bool = True,
    report: Callable[[str], None],
) -> dict[str, dict[str, Tensor]]:
    """Train ControlNet (its fresh start: the UNet's encoder) and UNet together; text encoders stay as they are.

    SDXL's ControlNets are trained on a frozen base. This base has seen a few ten thousand pictures, and being told
    where the ball is teaches it more of balls than as many pictures without.

    The first layers that look at the depth map keep their random start: at full picture size they would cost as much
    as the rest together, and random features of a disc and a ramp lose nothing of them.

    Args, Returns: as `base.train_base`.
    """
    control: Any = model.controlnet
    if fresh:
        control.load_state_dict(ControlNetModel.from_unet(model.unet).state_dict(), strict=False)
    for network in (model.unet, control):
        spell_out_attention(network)
    looking = control.controlnet_cond_embedding
    features = _Features(looking)
    # The trained part takes features in place of a picture, so that those of the usual ball are computed once.
    control.controlnet_cond_embedding = looking.conv_out
    side = model.defaults.canvas
    with torch.no_grad():
        tokens, pooled = TextBank(model).embed()

    def loss_of_step(step: int) -> Tensor:
        drawn = draw_batch(sampler, step, batch, full_canvas=side, noisiest=NOISIEST)
        generator = torch.Generator().manual_seed(sampler.seed * 104_729 + step)
        text = {"encoder_hidden_states": tokens[drawn.captions]}
        added = {"text_embeds": pooled[drawn.captions], "time_ids": time_ids(batch, side)}
        residuals = {}
        if float(torch.rand((), generator=generator)) >= WITHOUT:
            hints = torch.cat([features.of(ball, generator) for ball in drawn.balls])
            down, middle = control(
                drawn.noisy, drawn.timesteps, controlnet_cond=hints, added_cond_kwargs=added, return_dict=False, **text
            )
            residuals = {"down_block_additional_residuals": down, "mid_block_additional_residual": middle}
        unet: Any = model.unet
        predicted = unet(drawn.noisy, drawn.timesteps, added_cond_kwargs=added, **residuals, **text).sample
        return velocity_loss(predicted, drawn)

    networks = {"unet": model.unet.train(), "controlnet": control.train()}
    averaged = train(networks, loss_of_step, budget, folder, report=report)
    control.controlnet_cond_embedding = looking
    trained = {key.replace(_HINT, _HINT + "conv_out."): value for key, value in averaged["controlnet"].items()}
    return {"unet": averaged["unet"], "controlnet": {**control.state_dict(), **trained}}


class _Features:
    """What the ControlNet's untrained first layers see of depth maps."""

    def __init__(self, looking: Any) -> None:
        self._looking = looking
        self._of_black = lru_cache(maxsize=64)(lambda ball: self._see(paint_depth(None, ball)))

    def of(self, ball: Ball, generator: Generator) -> Float[Tensor, "1 c m m"]:
        """Features of a depth map with the ball: mostly nothing behind it, else ground that comes nearer downwards."""
        if float(torch.rand((), generator=generator)) < 0.85:
            return self._of_black(ball)
        return self._see(_ground(ball, generator))

    @torch.no_grad()
    def _see(self, depth: Float[Tensor, "1 s s 3"]) -> Float[Tensor, "1 c m m"]:
        seen = F.silu(self._looking.conv_in(depth.permute(0, 3, 1, 2)))
        for layer in self._looking.blocks:
            seen = F.silu(layer(seen))
        return seen


def _ground(ball: Ball, generator: Generator) -> Float[Tensor, "1 s s 3"]:
    start, power = torch.rand(2, generator=generator).tolist()
    ramp = (torch.linspace(0, 1, ball.canvas) - 0.6 * start).clamp(min=0) ** (0.5 + 1.5 * power)
    ground = paint_depth(ramp[None, :, None, None].expand(1, -1, ball.canvas, 1), ball)
    return torch.maximum(0.8 * ground, paint_depth(None, ball))
