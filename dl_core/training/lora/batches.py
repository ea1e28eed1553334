"""What a step of LoRA training sees; it follows from the seed and the step alone.

Source: DiffusionLight, Sec. 4.2 (Eq. 5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from diffusers import DDPMScheduler
from jaxtyping import Float, Int
from torch import Tensor

from ..starts import carried_noise, draw_starts
from .latent_cache import LatentCache

__all__ = ["LoraBatch", "LoraBatches", "diffusion_target"]


@dataclass(frozen=True)
class LoraBatch:
    """Latents of pairs at random noise levels.

    Attributes:
        noisy: (B, C, m, m) latents with noise.
        timesteps: (B,) noise levels.
        target: (B, C, m, m) what the model is to predict.
        ball: (B, 1, m, m) share of each latent that the ball covers.
        evs: (B,) exposures.
    """

    noisy: Float[Tensor, "b c m m"]
    timesteps: Int[Tensor, " b"]
    target: Float[Tensor, "b c m m"]
    ball: Float[Tensor, "b 1 m m"]
    evs: Float[Tensor, " b"]


@dataclass(frozen=True)
class LoraBatches:
    """Batches by number.

    Attributes:
        cache: the pairs' latents.
        chosen: (N,) indices of the pairs used. Each is shown once before any is shown again.
        schedule: noise levels, and what the model predicts.
        size: pairs to a batch.
        timesteps: first and last noise level, both included, all equally likely.
        seed: of order, levels and noise.
        from_noise: see `LoraBase`.
    """

    cache: LatentCache
    chosen: Int[Tensor, " n"]
    schedule: DDPMScheduler
    size: int
    timesteps: tuple[int, int]
    seed: int
    from_noise: bool = False

    def batch(self, number: int) -> LoraBatch:
        """The batch of a number from 0."""
        indices = self.chosen[self._places(number)]
        clean = self.cache.latents(indices)
        generator = torch.Generator().manual_seed(self.seed * 15_485_867 + number)
        first, last = self.timesteps
        levels = torch.randint(first, last + 1, (self.size,), generator=generator)
        noise = torch.randn(clean.shape, generator=generator)
        if self.from_noise:
            discs = self.cache.discs(indices, clean.shape[-1], dilated=True)
            starts = draw_starts(levels, generator)
            noise = carried_noise(noise, clean, discs, starts, self.schedule.alphas_cumprod)
        return LoraBatch(
            noisy=self.schedule.add_noise(clean, noise, levels),
            timesteps=levels,
            target=diffusion_target(self.schedule, clean, noise, levels),
            ball=self.cache.discs(indices, clean.shape[-1]),
            evs=self.cache.evs[indices],
        )

    def _places(self, number: int) -> Tensor:
        count = len(self.chosen)
        places = range(number * self.size, (number + 1) * self.size)
        return torch.stack([_order(count, self.seed, place // count)[place % count] for place in places])


@lru_cache(maxsize=2)
def _order(count: int, seed: int, epoch: int) -> Tensor:
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed * 32_452_843 + epoch))


def diffusion_target(schedule: DDPMScheduler, clean: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor:
    """What a model of a schedule's kind predicts: the noise, or the velocity."""
    if schedule.config.prediction_type == "v_prediction":
        return schedule.get_velocity(clean, noise, timesteps)
    return noise
