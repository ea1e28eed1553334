"""The model a LoRA is trained on: SDXL from local files, or the mini model."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from diffusers import DDPMScheduler, StableDiffusionXLControlNetInpaintPipeline
from jaxtyping import Float
from torch import Tensor, nn

from ...backends.diffusers_painter import PAPER_DEFAULTS, DiffusersPainter
from ...backends.mini import MiniModel, ModelDefaults
from ...backends.sdxl_files import load_base, load_controlnet
from ...shapes import Image
from ..mini.autoencoder import block_latents

__all__ = ["LoraBase"]

SAMPLED: Final = 257
"""Values of every weight that the fingerprint of a network looks at."""


@dataclass(frozen=True)
class LoraBase:
    """Networks with frozen weights, as the pipeline that also paints with them.

    Attributes:
        source: name of the model for people: a file, a folder, or `mini`.
        pipeline: of SDXL's kind; its ControlNet may be missing.
        defaults: prompts and settings of painting.
        from_noise: whether the model was trained on what a sampler meets that started from noise alone (`starts`), and
            its LoRA is to be.
    """

    source: str
    pipeline: Any
    defaults: ModelDefaults
    from_noise: bool = False

    @staticmethod
    def from_files(model: Path, controlnet: Path | None, dtype: torch.dtype) -> LoraBase:
        """SDXL from local files; nothing is downloaded.

        Args:
            model: a checkpoint, or a folder in diffusers' layout.
            controlnet: a depth ControlNet for pictures of validation; without one the ball is painted by inpainting
                alone.
            dtype: of the frozen weights.

        Raises:
            ModelError: a file is missing, unreadable, or not of SDXL's architecture.
        """
        base = load_base(model, dtype)
        control = None if controlnet is None else load_controlnet(controlnet, base, dtype)
        pipeline = StableDiffusionXLControlNetInpaintPipeline(**base.components, controlnet=control)
        return LoraBase(model.name, pipeline, PAPER_DEFAULTS)

    @staticmethod
    def from_mini(model: MiniModel) -> LoraBase:
        """The mini model without the exposure LoRA it comes with, which is what is trained anew."""
        networks = {**vars(model), "lora": None}
        painter = DiffusersPainter.from_mini(MiniModel(**networks))
        return _MiniBase("mini", painter.pipeline, model.defaults, from_noise=True)

    @property
    def schedule(self) -> DDPMScheduler:
        """The noise schedule the model was trained with, and what it predicts."""
        return DDPMScheduler.from_config(self.pipeline.scheduler.config)

    @torch.no_grad()
    def encode(self, canvas_ldr: Image) -> Float[Tensor, "b k m m"]:
        """Latents of pictures (B, S, S, 3), scaled as the UNet takes them, single precision, on the CPU.

        Of an autoencoder with a posterior the mode is taken: latents are kept and shown many times, and one draw kept
        for good would be an error added to them, not a distribution.
        """
        vae = self.pipeline.vae
        encoded = vae.encode((canvas_ldr.permute(0, 3, 1, 2) * 2 - 1).to(vae.device, vae.dtype))
        latents = encoded.latent_dist.mode() if hasattr(encoded, "latent_dist") else encoded.latents
        scaled: Tensor = latents.float().cpu() * vae.config.scaling_factor
        return scaled

    def fingerprint(self) -> str:
        """Tells models apart by names, shapes and a sample of all weights that training depends on."""
        parts = ("unet", "vae", "text_encoder", "text_encoder_2")
        digest = hashlib.sha256()
        for part in parts:
            _digest(digest, getattr(self.pipeline, part))
        return digest.hexdigest()[:16]


class _MiniBase(LoraBase):
    """The mini model, whose encoder's closed form costs a hundredth of the network it is written into."""

    def encode(self, canvas_ldr: Image) -> Float[Tensor, "b k m m"]:
        return block_latents(canvas_ldr, 8)


def _digest(digest: Any, network: nn.Module) -> None:
    for name, weight in network.state_dict().items():
        flat = weight.detach().flatten()
        sample = flat[:: max(1, len(flat) // SAMPLED)].float().cpu().contiguous()
        digest.update(f"{name} {tuple(weight.shape)}".encode())
        digest.update(sample.numpy().tobytes())
