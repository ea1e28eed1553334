"""The trained LoRA's weights by names that ComfyUI, diffusers and this package load.

The names are kohya's trainer's for SDXL (`lora_unet_input_blocks_4_1_….lora_down.weight`, `.alpha`), the only ones that
every host knows: ComfyUI's own loader leaves plain PEFT names out with a line in its log.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor

from ...lora_names import comfyui_layers

__all__ = ["kohya_weights"]


def kohya_weights(adapter: Mapping[str, Tensor], layers: Collection[str]) -> dict[str, Tensor]:
    """Rename an adapter's weights.

    Args:
        adapter: PEFT's, by diffusers' names of layers (`down_blocks.….to_q.lora_A.weight`), of alpha equal to rank.
        layers: all layers of the UNet that can take a LoRA, by diffusers' names.

    Returns:
        lora_down (r, in), lora_up (out, r) and alpha of each layer, single precision, on the CPU.
    """
    names = comfyui_layers(layers)
    weights: dict[str, Tensor] = {}
    for layer in sorted({name.rsplit(".lora_", 1)[0] for name in adapter}):
        down, up = (adapter[f"{layer}.lora_{part}.weight"].float().cpu().contiguous() for part in "AB")
        stem = f"lora_unet_{names[layer].replace('.', '_')}"
        weights |= {f"{stem}.lora_down.weight": down, f"{stem}.lora_up.weight": up}
        weights[f"{stem}.alpha"] = torch.tensor(float(len(down)))
    return weights
