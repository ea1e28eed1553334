"""The embedded mini model as ComfyUI's MODEL, CLIP, VAE and CONTROL_NET.

The mini model lives in diffusers and transformers modules (`dl_core.backends.mini`). Import this module late: it brings
in diffusers, which takes seconds and nothing else in the pack needs.
"""

from __future__ import annotations

from typing import Any

import comfy.latent_formats
import comfy.sd
import torch

from ..dl_core.backends.mini import SCHEDULER_CONFIG, MiniModel
from .from_diffusers import clip_of, control_net_of, load_weights, model_of
from .lora import with_lora

__all__ = ["to_clip", "to_controlnet", "to_model", "to_vae"]


class _MiniLatents(comfy.latent_formats.LatentFormat):  # type: ignore[misc]
    """Four channels, used as the autoencoder gives them."""

    scale_factor = 1.0


def to_model(mini: MiniModel, lora_scale: float) -> Any:
    """ComfyUI's MODEL of the mini UNet, with its exposure LoRA, where it has one, at a scale (0 leaves it out).

    Raises:
        ModelError: weights that do not fit.
    """
    model = model_of(mini.unet, SCHEDULER_CONFIG, _MiniLatents, "mini model's unet")
    if lora_scale == 0 or mini.lora is None:
        return model
    return with_lora(model, mini.lora, lora_scale, "mini model's exposure LoRA")


def to_controlnet(mini: MiniModel) -> Any:
    """ComfyUI's CONTROL_NET of the mini depth ControlNet.

    Raises:
        ModelError: weights that do not fit.
    """
    return control_net_of(mini.controlnet, "mini model's controlnet")


def to_vae(mini: MiniModel) -> Any:
    """ComfyUI's VAE of the mini autoencoder, which has TAESD's shape and no scale or shift of its latents.

    Raises:
        ModelError: weights that do not fit.
    """
    weights = {"vae_scale": torch.tensor(1.0), "vae_shift": torch.tensor(0.0)}
    for name, tensor in mini.vae.state_dict().items():
        half, _, index, rest = name.split(".", 3)
        # ComfyUI's decoder counts the clamp of its input as a layer, diffusers' does not.
        place = int(index) + (half == "decoder")
        weights[f"taesd_{half}.{place}.{rest}"] = tensor
    vae = comfy.sd.VAE(sd=weights, dtype=torch.float32)
    load_weights(vae.first_stage_model, weights, "mini model's vae")
    return vae


def to_clip(mini: MiniModel) -> Any:
    """ComfyUI's CLIP of the two mini text encoders, behind ComfyUI's own CLIP tokenizers.

    Raises:
        ModelError: weights that do not fit.
    """
    return clip_of(mini.text_encoder, mini.text_encoder_2, "mini model's text encoders")
