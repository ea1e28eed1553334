"""Pipelines of full architecture with random weights: what takes memory and time, without a download."""

from __future__ import annotations

import json
from typing import Any

import torch
from diffusers import (
    AutoencoderKL,
    ControlNetModel,
    EulerDiscreteScheduler,
    StableDiffusionXLControlNetInpaintPipeline,
    UNet2DConditionModel,
)
from torch import nn
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

from .diffusers_painter import DiffusersPainter
from .mini import MiniModel
from .sdxl_files import SDXL_FOLDER, sdxl_tokenizers

__all__ = ["mini_pipeline", "sdxl_pipeline"]


def sdxl_pipeline(device: torch.device, dtype: torch.dtype) -> Any:
    """SDXL's pipeline with a depth ControlNet, as `sdxl_files` loads it, with random weights."""
    with torch.device(device), _DefaultType(dtype):
        unet = UNet2DConditionModel.from_config(_config("unet"))
        control = ControlNetModel.from_config(_config("controlnet"))
        text_encoder = CLIPTextModel(CLIPTextConfig(**_config("text_encoder")))
        text_encoder_2 = CLIPTextModelWithProjection(CLIPTextConfig(**_config("text_encoder_2")))
    with torch.device(device):
        vae = AutoencoderKL.from_config(_config("vae"))
    vae = vae if vae.config.force_upcast else vae.to(dtype)
    networks: dict[str, nn.Module] = {
        "unet": unet,
        "controlnet": control,
        "text_encoder": text_encoder,
        "text_encoder_2": text_encoder_2,
        "vae": vae,
    }
    return StableDiffusionXLControlNetInpaintPipeline(
        **{name: network.eval() for name, network in networks.items()},
        **sdxl_tokenizers(),
        scheduler=EulerDiscreteScheduler.from_config(json.loads(_text("scheduler/scheduler_config.json"))),
    )


def mini_pipeline(device: torch.device, dtype: torch.dtype) -> Any:
    """The mini model's architecture, with random weights."""
    return DiffusersPainter.from_mini(MiniModel.untrained()).pipeline.to(device, dtype)


def _text(file: str) -> str:
    return (SDXL_FOLDER / file).read_text()


def _config(network: str) -> dict[str, Any]:
    config: dict[str, Any] = json.loads(_text(f"{network}/config.json"))
    return config


class _DefaultType:
    """Tensors are made in a type: a network of billions of weights never exists in single precision."""

    def __init__(self, dtype: torch.dtype) -> None:
        self._dtype, self._before = dtype, torch.get_default_dtype()

    def __enter__(self) -> None:
        torch.set_default_dtype(self._dtype)

    def __exit__(self, *fault: Any) -> None:
        torch.set_default_dtype(self._before)
