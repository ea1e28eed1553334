"""LoRA files of any common naming, loaded through ComfyUI's own machinery.

ComfyUI knows a UNet's LoRA by the names kohya's trainer gives (`lora_unet_down_blocks_…_to_q.lora_down.weight`) and by
some older ones. Of the names diffusers and PEFT write it skips several with no more than a line in the log, so they are
translated first.
"""

from __future__ import annotations

import re
from typing import Any, Final

import comfy.sd
import torch

from ..dl_core.errors import ModelError

__all__ = ["kohya_names", "with_lora"]

_DIFFUSERS: Final = re.compile(
    r"^(?:unet\.)?(?:base_model\.model\.)?"
    r"(?P<layer>(?:down_blocks|mid_block|up_blocks)\..+?)"
    r"(?:\.lora_(?P<peft>[AB])(?:\.\w+)?|[._]lora(?:_linear_layer)?\.(?P<half>down|up))\.weight$"
)
_HALVES: Final = {"A": "down", "B": "up"}


def kohya_names(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The weights of a UNet LoRA under kohya's names; names of no known form are kept."""
    return {_kohya_name(name): tensor for name, tensor in weights.items()}


def _kohya_name(name: str) -> str:
    match = _DIFFUSERS.match(name)
    if not match:
        return name
    layer = match["layer"].replace(".processor.", ".")
    if layer.endswith(".to_out"):
        # Attention processors named the projection without its place in the list it stands in.
        layer += ".0"
    half = match["half"] or _HALVES[match["peft"]]
    return f"lora_unet_{layer.replace('.', '_')}.lora_{half}.weight"


def with_lora(model: Any, weights: dict[str, torch.Tensor], scale: float, source: str) -> Any:
    """A clone of a MODEL with a LoRA added at a scale.

    Raises:
        ModelError: not one weight of the LoRA fits the model; `source` names the LoRA.
    """
    patched = comfy.sd.load_lora_for_models(model, None, kohya_names(weights), scale, 0)[0]
    if _patch_count(patched) == _patch_count(model):
        raise ModelError(source, "has no weights for this model; a LoRA for the UNet of its architecture is accepted")
    return patched


def _patch_count(model: Any) -> int:
    return sum(len(patches) for patches in model.patches.values())
