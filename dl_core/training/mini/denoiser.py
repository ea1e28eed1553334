"""What base, ControlNet and LoRA training share: batches of noisy latents, text conditioning, the loss.

The mini model predicts v = sqrt(ᾱ) ε - sqrt(1 - ᾱ) z (Salimans and Ho, Progressive Distillation, ICLR 2022). Its noise
schedule is SDXL's. Predicting ε as SDXL does leaves a small network to state overall brightness and colour as a small
difference between its input and its output at the noisiest steps, which is where lighting is settled.

The ball's latents are those that a sampler which started from noise alone meets on its way (`starts`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from diffusers import DDPMScheduler
from diffusers.models.attention_processor import AttnProcessor
from jaxtyping import Float
from torch import Tensor

from ...backends.mini import SCHEDULER_CONFIG, MiniModel
from ...ball import Ball, disc_mask
from ..starts import carried_noise, draw_starts
from .autoencoder import block_latents
from .feed import Feed
from .scene_sampler import BASE_CAPTIONS, SceneSampler

__all__ = [
    "OFF_BALL_WEIGHT",
    "Batch",
    "TextBank",
    "draw_batch",
    "latent_disc",
    "spell_out_attention",
    "time_ids",
    "velocity_loss",
    "weighted_error",
]

_NOISE = DDPMScheduler(**SCHEDULER_CONFIG)

OFF_BALL_WEIGHT = 0.1
"""Weight of latents that show the photograph; at inference they are imputed, so the ball matters more."""


@dataclass(frozen=True)
class Batch:
    """Latents of training pictures at random noise levels.

    Attributes:
        noisy: (B, 4, m, m) latents with noise.
        timesteps: (B,) in [0, 1000).
        target: (B, 4, m, m) the velocity to predict.
        weights: (B, 1, m, m) of the loss, about 1 on the ball.
        captions: (B,) indices into `BASE_CAPTIONS`.
        evs: (B,) exposure of each ball.
        balls: where each ball is, in pixels of the full-size canvas.
    """

    noisy: Float[Tensor, "b 4 m m"]
    timesteps: Tensor
    target: Float[Tensor, "b 4 m m"]
    weights: Float[Tensor, "b 1 m m"]
    captions: Tensor
    evs: Float[Tensor, "b"]
    balls: tuple[Ball, ...]

    def to(self, device: torch.device) -> Batch:
        """The same on a device."""
        tensors: dict[str, Any] = {
            name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **tensors)


class TextBank:
    """Embeddings of the few captions training uses, in the form SDXL's UNet takes them."""

    def __init__(self, model: MiniModel) -> None:
        self.model = model
        self.tokens = [
            tokenizer(list(BASE_CAPTIONS), padding="max_length", max_length=77, truncation=True, return_tensors="pt")
            for tokenizer in (model.tokenizer, model.tokenizer_2)
        ]

    def embed(self) -> tuple[Float[Tensor, "k 77 c"], Float[Tensor, "k p"]]:
        """Token embeddings (penultimate layers of both encoders) and pooled embeddings of all captions."""
        encoders = (self.model.text_encoder, self.model.text_encoder_2)
        first, second = (
            encoder(tokens.input_ids.to(encoder.device), output_hidden_states=True)
            for encoder, tokens in zip(encoders, self.tokens, strict=True)
        )
        return torch.cat((first.hidden_states[-2], second.hidden_states[-2]), dim=-1), second.text_embeds


def spell_out_attention(network: Any) -> None:
    """Let a UNet or ControlNet on a CPU compute attention by plain products instead of the fused kernel.

    The mini model attends over 16 or 64 latents, where the fused kernel's way back costs a CPU a sixth of a step.
    """
    if network.device.type == "cpu":
        network.set_attn_processor(AttnProcessor())


def time_ids(count: int, side: int) -> Float[Tensor, "b 6"]:
    """SDXL's size conditioning for an uncropped square picture."""
    return torch.tensor([[side, side, 0, 0, side, side]], dtype=torch.float32).expand(count, -1)


def draw_batch(sampler: SceneSampler, step: int, feed: Feed, *, full_canvas: int, noisiest: float = 0.5) -> Batch:
    """The batch of a step; it follows from the sampler's seed and the step alone.

    Args:
        sampler: draws the pictures.
        step: of the training.
        feed: examples in the batch, and how many are made of a picture; those follow each other.
        full_canvas: side of the canvas the model paints on; the sampler's may be smaller.
        noisiest: share drawn from the noisiest 40% of levels, where the layout of light is settled; the rest are
            spread over all.
    """
    scale = full_canvas // sampler.canvas
    size, count = feed.batch, feed.batch // feed.noises
    drawn = [sampler.draw(step * count + i) for i in range(count)]
    clean = block_latents(torch.cat([picture.canvas_ldr for picture in drawn]), 8 // scale)
    clean = clean.repeat_interleave(feed.noises, dim=0)
    pictures = [picture for picture in drawn for _ in range(feed.noises)]
    generator = torch.Generator().manual_seed(sampler.seed * 7_919 + step)
    levels = torch.randint(0, 1000, (size,), generator=generator)
    high_levels = torch.randint(600, 1000, (size,), generator=generator)
    levels = torch.where(torch.rand(size, generator=generator) < noisiest, high_levels, levels)
    noise = torch.randn(clean.shape, generator=generator)
    side = clean.shape[-1]
    discs = torch.cat([latent_disc(picture.ball, side, grow=picture.ball.dilation) for picture in pictures])
    noise = carried_noise(noise, clean, discs, draw_starts(levels, generator), _NOISE.alphas_cumprod)
    return Batch(
        noisy=_NOISE.add_noise(clean, noise, levels),
        timesteps=levels,
        target=_NOISE.get_velocity(clean, noise, levels),
        weights=OFF_BALL_WEIGHT + (1 - OFF_BALL_WEIGHT) * discs,
        captions=torch.tensor([picture.caption for picture in pictures]),
        evs=torch.tensor([picture.ev for picture in pictures]),
        balls=tuple(picture.ball.enlarged(scale) for picture in pictures),
    )


def latent_disc(ball: Ball, side: int, *, grow: float) -> Float[Tensor, "1 1 m m"]:
    """A ball's disc, larger by `grow` pixels, at latent size: the share of each latent that it covers."""
    return torch.nn.functional.interpolate(disc_mask(ball, grow=grow)[None], size=(side, side), mode="area")


def velocity_loss(predicted: Tensor, batch: Batch) -> Float[Tensor, ""]:
    """Weighted mean squared error of the predicted velocity."""
    return weighted_error(predicted, batch.target, batch.weights)


def weighted_error(predicted: Tensor, target: Tensor, weights: Float[Tensor, "b 1 m m"]) -> Float[Tensor, ""]:
    """Weighted mean squared error of predictions (B, C, m, m)."""
    return (weights * (predicted - target).square()).sum() / (weights.sum() * predicted.shape[1])
