"""Train the mini model's depth ControlNet, and go on training its base with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F
from diffusers import ControlNetModel
from jaxtyping import Float
from torch import Generator, Tensor

from ...backends.mini import MiniModel
from ...ball import Ball, paint_depth
from .denoiser import Batch, TextBank, draw_batch, spell_out_attention, time_ids, velocity_loss
from .feed import Ahead, Feed
from .loop import Budget, train, training_device
from .scene_sampler import SceneSampler

__all__ = ["train_control"]

WITHOUT: Final = 0.1
"""Share of steps without the ControlNet, so that the base still works alone."""
NOISIEST: Final = 0.75
"""Share of the noisiest levels: there the ball's place and the scene's light are settled."""
BLACK: Final = 0.85
"""Share of depth maps with nothing behind the ball."""
_HINT: Final = "controlnet_cond_embedding."


def train_control(
    model: MiniModel,
    sampler: SceneSampler,
    budget: Budget,
    folder: Path,
    *,
    feed: Feed,
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
    side, device = model.defaults.canvas, training_device()
    with torch.no_grad():
        tokens, pooled = (embedding.to(device) for embedding in TextBank(model).embed())
    networks = {"unet": model.unet.train().to(device), "controlnet": control.train().to(device)}
    for network in networks.values():
        spell_out_attention(network)
    looking = control.controlnet_cond_embedding
    # The trained part takes features in place of a picture, so that each depth map is looked at once a step.
    control.controlnet_cond_embedding = looking.conv_out
    batches = Ahead(lambda step: _draw(sampler, step, feed, side), feed.loaders)
    sizes = time_ids(feed.batch, side).to(device)

    def loss_of_step(step: int) -> Tensor:
        drawn = batches(step)
        batch = drawn.batch.to(device)
        text = {"encoder_hidden_states": tokens[batch.captions]}
        added = {"text_embeds": pooled[batch.captions], "time_ids": sizes}
        residuals = {}
        if drawn.depths is not None:
            hints = _see(looking, drawn.depths.to(device))[drawn.shown.to(device)]
            down, middle = control(
                batch.noisy, batch.timesteps, controlnet_cond=hints, added_cond_kwargs=added, return_dict=False, **text
            )
            residuals = {"down_block_additional_residuals": down, "mid_block_additional_residual": middle}
        unet: Any = model.unet
        predicted = unet(batch.noisy, batch.timesteps, added_cond_kwargs=added, **residuals, **text).sample
        return velocity_loss(predicted, batch)

    averaged = train(networks, loss_of_step, budget, folder, report=report)
    control.controlnet_cond_embedding = looking
    trained = {key.replace(_HINT, _HINT + "conv_out."): value for key, value in averaged["controlnet"].items()}
    return {"unet": averaged["unet"], "controlnet": {**control.state_dict(), **trained}}


@dataclass(frozen=True)
class _Drawn:
    """A batch with its depth maps.

    Attributes:
        batch: noisy latents.
        depths: (K, S, S) in 8 bits, each different one once; None in a step without the ControlNet.
        shown: (B,) which of them goes with each example.
    """

    batch: Batch
    depths: Tensor | None
    shown: Tensor


def _draw(sampler: SceneSampler, step: int, feed: Feed, side: int) -> _Drawn:
    """The batch of a step. Mostly nothing is behind a ball, else ground that comes nearer downwards."""
    batch = draw_batch(sampler, step, feed, full_canvas=side, noisiest=NOISIEST)
    generator = torch.Generator().manual_seed(sampler.seed * 104_729 + step)
    if float(torch.rand((), generator=generator)) < WITHOUT:
        return _Drawn(batch, None, torch.zeros(feed.batch, dtype=torch.long))
    depths: list[Tensor] = []
    of_black: dict[Ball, int] = {}
    shown = []
    for ball in batch.balls[:: feed.noises]:
        black = float(torch.rand((), generator=generator)) < BLACK
        if not black or ball not in of_black:
            depths.append(paint_depth(None, ball) if black else _ground(ball, generator))
        shown.append(of_black.setdefault(ball, len(depths) - 1) if black else len(depths) - 1)
    codes = (torch.cat(depths)[..., 0] * 255).round().to(torch.uint8)
    return _Drawn(batch, codes, torch.tensor(shown).repeat_interleave(feed.noises))


@torch.no_grad()
def _see(looking: Any, depths: Tensor) -> Float[Tensor, "k c m m"]:
    """What the ControlNet's untrained first layers see of depth maps."""
    seen = F.silu(looking.conv_in((depths.float() / 255)[:, None].expand(-1, 3, -1, -1)))
    for layer in looking.blocks:
        seen = F.silu(layer(seen))
    return seen


def _ground(ball: Ball, generator: Generator) -> Float[Tensor, "1 s s 3"]:
    start, power = torch.rand(2, generator=generator).tolist()
    ramp = (torch.linspace(0, 1, ball.canvas) - 0.6 * start).clamp(min=0) ** (0.5 + 1.5 * power)
    ground = paint_depth(ramp[None, :, None, None].expand(1, -1, ball.canvas, 1), ball)
    return torch.maximum(0.8 * ground, paint_depth(None, ball))
