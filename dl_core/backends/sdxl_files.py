"""SDXL and its depth ControlNet from local files: folders in diffusers' layout, or single checkpoints.

A single checkpoint holds weights and no description, which diffusers would fetch from the hub. SDXL's is in
`data/sdxl`, so nothing is fetched; its tokenizers are CLIP's, which the mini model brings along.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import torch
from diffusers import ControlNetModel, StableDiffusionXLPipeline
from transformers import CLIPTokenizer

from ..errors import ModelError
from .mini import MINI_FOLDER

__all__ = ["SDXL_FOLDER", "load_base", "load_controlnet", "sdxl_tokenizers"]

SDXL_FOLDER: Final = Path(__file__).resolve().parent.parent / "data" / "sdxl"
"""SDXL base 1.0 in diffusers' terms, without weights."""

_TOKENIZERS: Final = MINI_FOLDER / "tokenizer"


def load_base(path: Path, dtype: torch.dtype) -> StableDiffusionXLPipeline:
    """SDXL's pipeline from a checkpoint (.safetensors, .ckpt) or a folder.

    Raises:
        ModelError: a file that is missing, unreadable, or not of SDXL's architecture.
    """
    base = _loaded(
        StableDiffusionXLPipeline,
        path,
        lambda: StableDiffusionXLPipeline.from_single_file(
            str(path),
            config=str(SDXL_FOLDER),
            **sdxl_tokenizers(),
            torch_dtype=dtype,
            local_files_only=True,
        ),
        dtype,
    )
    config = base.unet.config
    if getattr(config, "addition_embed_type", None) != "text_time" or config.in_channels != 4:
        raise ModelError(path, "is not an SDXL base model (its UNet lacks SDXL's text-and-size conditioning)")
    if getattr(base.vae.config, "force_upcast", False):
        # SDXL's own autoencoder overflows half precision; the repaired one says in its folder that it does not.
        base.vae.to(torch.float32)
    return base


def sdxl_tokenizers() -> dict[str, CLIPTokenizer]:
    """SDXL's two tokenizers by their names in a pipeline; they differ in what they pad with."""
    return {
        "tokenizer": CLIPTokenizer.from_pretrained(_TOKENIZERS),
        "tokenizer_2": CLIPTokenizer.from_pretrained(_TOKENIZERS, pad_token="!"),
    }


def load_controlnet(path: Path, base: StableDiffusionXLPipeline, dtype: torch.dtype) -> ControlNetModel:
    """A depth ControlNet for a base model, from a file under diffusers' or the original names, or from a folder.

    Raises:
        ModelError: a file that is missing, unreadable, or for another base model.
    """
    control = _loaded(
        ControlNetModel,
        path,
        lambda: ControlNetModel.from_single_file(
            str(path), config=str(SDXL_FOLDER), subfolder="controlnet", torch_dtype=dtype, local_files_only=True
        ),
        dtype,
    )
    if control.config.cross_attention_dim != base.unet.config.cross_attention_dim:
        raise ModelError(path, "is not a ControlNet for SDXL (its text conditioning has another width)")
    return control


def _loaded(kind: Any, path: Path, from_file: Callable[[], Any], dtype: torch.dtype) -> Any:
    """A diffusers model or pipeline from a local file or folder."""
    if not path.exists():
        raise ModelError(path, "no such file or folder")
    try:
        if path.is_dir():
            return kind.from_pretrained(path, torch_dtype=dtype, local_files_only=True)
        return from_file()
    except Exception as error:  # diffusers raises whatever its parts do; all of it means the same to the user
        reason = " ".join(str(error).split())
        raise ModelError(path, f"cannot be loaded as {kind.__name__} ({type(error).__name__}: {reason})") from error
