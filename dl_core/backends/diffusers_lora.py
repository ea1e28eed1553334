"""LoRA files of any common naming as adapters of a diffusers pipeline."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, Final

from torch import Tensor, nn

from ..lora import read_lora

__all__ = ["EXPOSURE", "TURBO", "add_lora", "lora_shapes"]

EXPOSURE: Final = "exposure"
TURBO: Final = "turbo"
"""Names of the pipeline's adapters."""


def lora_shapes(unet: nn.Module) -> dict[str, tuple[int, ...]]:
    """Shapes of the weights a LoRA can act on, by layer: linear ones (out, in), convolutions (out, in, kh, kw).

    Adapters the UNet already has are looked through.
    """
    return {
        name.removesuffix(".weight").removesuffix(".base_layer"): tuple(weight.shape)
        for name, weight in unet.named_parameters()
        if name.endswith(".weight") and weight.ndim > 1 and ".lora_" not in name
    }


def add_lora(pipeline: Any, weights: Mapping[str, Tensor], adapter: str, source: object) -> None:
    """Load a LoRA into a pipeline's UNet as an adapter, at scale 1 and alone in force.

    Args:
        pipeline: of SDXL's kind, from diffusers.
        weights: of the file, under any of the names `lora_names` knows.
        adapter: name to give it.
        source: names the LoRA in messages.

    Raises:
        ModelError: a LoRA that does not fit the UNet, in whole or in part.
    """
    unet = pipeline.unet
    named: dict[str, Tensor] = {}
    for layer, product in read_lora(weights, lora_shapes(unet), source).items():
        named[f"{layer}.lora_A.weight"] = product.down.to(unet.dtype)
        # diffusers takes a file of these names for one without α, so the up half carries it.
        named[f"{layer}.lora_B.weight"] = (product.up.float() * product.scale).to(unet.dtype)
    with warnings.catch_warnings():
        # PEFT warns of a second adapter in one network, which is what is wanted.
        warnings.filterwarnings("ignore", "Already found a `peft_config`", UserWarning)
        unet.load_lora_adapter(named, prefix=None, adapter_name=adapter)
    pipeline.set_adapters(adapter)
