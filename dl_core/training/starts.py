"""What is left of a ball on the way of a sampler that started from noise alone.

Painting starts from pure noise at some level T, but SDXL's schedule ends short of it: a picture at level T still shows
sqrt(ᾱ_T) of itself. A sampler whose estimate of the ball x is perfect from the first step on takes its start z for
sqrt(ᾱ_T) x + sqrt(1 - ᾱ_T) ε, concludes that ε = (z - sqrt(ᾱ_T) x) / sqrt(1 - ᾱ_T), and carries that noise along. At
level t its latents are then

    sqrt(ᾱ_t) x + sqrt(1 - ᾱ_t) (z' - c x)    with    c = sqrt(ᾱ_T / (1 - ᾱ_T)),

and z' normal: the ball is fainter than the level says, and at T it does not show at all. A model trained on the ball at
its full strength takes it for one nearer to mid-grey: dark exposures come out too bright. Trained on this instead, it
also has no ball to read the light from at the noisiest levels, and takes it from the photograph.

Lin et al., Common Diffusion Noise Schedules and Sample Steps Are Flawed (WACV 2024), mend the schedule's end by
another schedule; here schedule and samplers stay those of SDXL, and the training follows the sampler.
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

__all__ = ["FIRST_START", "SDEDIT_BELOW", "SDEDIT_SHARE", "carried_noise", "draw_starts"]

FIRST_START: Final = 820
"""Lowest level that painting starts from: six steps with leading spacing start at 831, thirty at 958."""
LAST_START: Final = 999
SDEDIT_BELOW: Final = 800
"""Level below which SDEdit starts, from a ball at its full strength: strength 0.8 of the schedule."""
SDEDIT_SHARE: Final = 0.3
"""Of pictures at such levels."""


def draw_starts(levels: Int[Tensor, " b"], generator: Generator) -> Int[Tensor, " b"]:
    """Level that each picture's sampler started from: the picture's own or above; -1 where it was SDEdit's."""
    starts = torch.randint(FIRST_START, LAST_START + 1, levels.shape, generator=generator)
    sdedit = torch.rand(levels.shape, generator=generator) < SDEDIT_SHARE
    return torch.where(sdedit & (levels < SDEDIT_BELOW), -1, torch.maximum(starts, levels))


def carried_noise(
    noise: Float[Tensor, "b k m m"],
    clean: Float[Tensor, "b k m m"],
    discs: Float[Tensor, "b 1 m m"],
    starts: Int[Tensor, " b"],
    alphas_cumprod: Float[Tensor, " levels"],
) -> Float[Tensor, "b k m m"]:
    """Noise ε that a sampler carries: z - c x on the ball, z where the photograph is imputed and after SDEdit.

    Args:
        noise: z, normal.
        clean: x, the latents of the picture with its ball.
        discs: share of each latent that is inpainted.
        starts: of `draw_starts`.
        alphas_cumprod: ᾱ of the schedule's levels.
    """
    kept = alphas_cumprod[starts.clamp(min=0)]
    share = torch.where(starts < 0, 0.0, (kept / (1 - kept)).sqrt())
    return noise - share.view(-1, 1, 1, 1) * discs * clean
