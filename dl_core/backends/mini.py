"""The embedded mini model: SDXL's architecture at toy width, to see the method work before any download.

It is a laboratory animal and a preview. Estimates meant for production use SDXL.

A folder holds `mini.json` (defaults of use), a CLIP tokenizer, and one fp16 safetensors file per network in the
key layout of diffusers and transformers. Its numbers against SDXL's: UNet widths 64/64/128/128 (320/640/1280), one
residual block a level (2), one transformer block in the two inner levels (0/2/10), text widths 32 + 32 (768 + 1280),
the autoencoder in TAESD's shape. Latents are 8 times smaller than the picture and have 4 channels, as SDXL's.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import torch
from diffusers import AutoencoderTiny, ControlNetModel, UNet2DConditionModel
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

from ..errors import ModelError
from ..json_text import read_json
from ..prompts import DARK_PROMPT, NEGATIVE_PROMPT, PROMPT

__all__ = [
    "CONTROLNET_CONFIG",
    "LORA_FILE",
    "MINI_FOLDER",
    "NETWORK_FILES",
    "SCHEDULER_CONFIG",
    "TEXT_CONFIG",
    "UNET_CONFIG",
    "MiniModel",
    "ModelDefaults",
    "load_mini",
    "load_network",
    "read_weights",
]

MINI_FOLDER: Final = Path(__file__).resolve().parent.parent / "data" / "mini"

_BLOCKS: Final[dict[str, Any]] = {
    "in_channels": 4,
    "down_block_types": ("DownBlock2D", "DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
    "block_out_channels": (64, 64, 128, 128),
    "layers_per_block": 1,
    "transformer_layers_per_block": 1,
    # diffusers reads this as the number of heads: 64 channels a head, as in SDXL.
    "attention_head_dim": (1, 1, 2, 2),
    "cross_attention_dim": 64,
    "use_linear_projection": True,
    "addition_embed_type": "text_time",
    "addition_time_embed_dim": 256,
    "projection_class_embeddings_input_dim": 6 * 256 + 32,
}
UNET_CONFIG: Final[dict[str, Any]] = _BLOCKS | {
    "sample_size": 32,
    "out_channels": 4,
    "up_block_types": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D", "UpBlock2D"),
}
CONTROLNET_CONFIG: Final[dict[str, Any]] = _BLOCKS | {"conditioning_embedding_out_channels": (16, 32, 96, 256)}
TEXT_CONFIG: Final[dict[str, Any]] = {
    "vocab_size": 49408,
    "hidden_size": 32,
    "intermediate_size": 128,
    "num_hidden_layers": 3,
    "num_attention_heads": 2,
    "max_position_embeddings": 77,
    "projection_dim": 32,
    "eos_token_id": 49407,
}

SCHEDULER_CONFIG: Final[dict[str, Any]] = {
    "num_train_timesteps": 1000,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "prediction_type": "v_prediction",
}
"""SDXL's noise schedule; SDXL itself predicts epsilon."""

NETWORK_FILES: Final = {
    "unet": "unet.safetensors",
    "controlnet": "controlnet.safetensors",
    "vae": "vae.safetensors",
    "text_encoder": "text_encoder.safetensors",
    "text_encoder_2": "text_encoder_2.safetensors",
}
LORA_FILE: Final = "exposure_lora.safetensors"


@dataclass(frozen=True)
class ModelDefaults:
    """How a model wants to be used; for the mini model, the fields of `mini.json`.

    Attributes:
        canvas: side of the canvas it paints on, pixels.
        diameter: of the ball on it, pixels.
        guidance: scale of classifier-free guidance.
        control_scale: of the depth ControlNet.
        lora_scale: of the exposure LoRA.
        ev_min: EV at which the dark prompt stands alone.
        prompt: of a mirror ball at EV 0.
        dark_prompt: of a mirror ball at `ev_min`.
        negative_prompt: what guidance moves away from.
    """

    canvas: int
    diameter: int
    guidance: float
    control_scale: float
    lora_scale: float
    ev_min: float
    prompt: str = PROMPT
    dark_prompt: str = DARK_PROMPT
    negative_prompt: str = NEGATIVE_PROMPT


@dataclass(frozen=True)
class MiniModel:
    """The mini model's networks, as diffusers and transformers modules in fp32 on the CPU."""

    unet: UNet2DConditionModel
    controlnet: ControlNetModel
    vae: AutoencoderTiny
    text_encoder: CLIPTextModel
    text_encoder_2: CLIPTextModelWithProjection
    tokenizer: CLIPTokenizer
    tokenizer_2: CLIPTokenizer
    defaults: ModelDefaults
    lora: dict[str, torch.Tensor] | None

    @staticmethod
    def untrained(folder: Path = MINI_FOLDER) -> MiniModel:
        """The architecture with random weights (global torch seed), no LoRA; tokenizer and defaults from a folder."""
        try:
            defaults = _defaults(read_json(folder / "mini.json"))
        except (OSError, TypeError, ValueError) as error:
            raise ModelError(
                folder / "mini.json", f"cannot be used as the mini model's settings ({error!r})"
            ) from error
        # SDXL pads its first text encoder with the end token and its second with token 0, "!".
        tokenizer = CLIPTokenizer.from_pretrained(folder / "tokenizer")
        tokenizer_2 = CLIPTokenizer.from_pretrained(folder / "tokenizer", pad_token="!")
        return MiniModel(
            unet=UNet2DConditionModel(**UNET_CONFIG).eval(),
            controlnet=ControlNetModel(**CONTROLNET_CONFIG).eval(),
            vae=AutoencoderTiny(scaling_factor=1.0).eval(),
            text_encoder=CLIPTextModel(CLIPTextConfig(**TEXT_CONFIG, hidden_act="quick_gelu")).eval(),
            text_encoder_2=CLIPTextModelWithProjection(CLIPTextConfig(**TEXT_CONFIG, hidden_act="gelu")).eval(),
            tokenizer=tokenizer,
            tokenizer_2=tokenizer_2,
            defaults=defaults,
            lora=None,
        )

    def networks(self) -> dict[str, nn.Module]:
        """The networks by the names of `NETWORK_FILES`."""
        return {name: getattr(self, name) for name in NETWORK_FILES}


def _defaults(values: Any) -> ModelDefaults:
    """The defaults that a file states.

    Raises:
        TypeError: it states something else.
        ValueError: one of them has another type, or the ball does not fit on the canvas.
    """
    defaults = ModelDefaults(**values)
    kinds: dict[str, tuple[type, ...]] = {"int": (int,), "float": (int, float), "str": (str,)}
    for field in fields(defaults):
        if type(getattr(defaults, field.name)) not in kinds[str(field.type)]:
            raise ValueError(f"{field.name} is {getattr(defaults, field.name)!r}, {field.type} is accepted")
    if not 0 < defaults.diameter < defaults.canvas:
        raise ValueError(f"a ball of {defaults.diameter} on a canvas of {defaults.canvas} pixels")
    return defaults


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Tensors of a safetensors file, as fp32.

    Raises:
        ModelError: no such file, or not a safetensors file.
    """
    if not path.is_file():
        raise ModelError(path, "no such model file")
    try:
        return {name: tensor.float() for name, tensor in load_file(path).items()}
    except SafetensorError as error:
        raise ModelError(path, f"is not a readable safetensors file ({error})") from error


def _rename_text_keys(weights: dict[str, torch.Tensor], network: nn.Module) -> dict[str, torch.Tensor]:
    """The files name text layers `text_model.…`, as the hub does; some transformers releases drop that prefix."""
    prefix = "text_model."
    if any(name.startswith(prefix) for name in network.state_dict()):
        return weights
    return {name.removeprefix(prefix): tensor for name, tensor in weights.items()}


def load_network(network: nn.Module, path: Path, what: str) -> None:
    """Load a file of a network's weights in place; `what` names the network in errors.

    Raises:
        ModelError: the file is missing, unreadable, or holds another architecture.
    """
    try:
        network.load_state_dict(_rename_text_keys(read_weights(path), network))
    except RuntimeError as error:
        raise ModelError(path, f"holds another architecture than the mini model's {what} ({error})") from error


def load_mini(folder: Path = MINI_FOLDER, *, without: Collection[str] = ()) -> MiniModel:
    """Load the mini model.

    Args:
        folder: holds `mini.json`, `tokenizer/` and the files of `NETWORK_FILES`; the exposure LoRA is optional.
        without: networks to leave untrained, for the training of those.

    Raises:
        ModelError: a file is missing, unreadable, or holds another architecture.
    """
    model = MiniModel.untrained(folder)
    for name, network in model.networks().items():
        if name in without:
            continue
        load_network(network, folder / NETWORK_FILES[name], name)
    lora = read_weights(folder / LORA_FILE) if (folder / LORA_FILE).exists() else None
    return MiniModel(**{**{field.name: getattr(model, field.name) for field in fields(model)}, "lora": lora})
