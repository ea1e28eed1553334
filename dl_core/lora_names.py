"""What a LoRA file calls a UNet's layers, and what the layers are called here.

Four conventions are about. The authors' file and older diffusers name attention processors
(`unet.….attn1.processor.to_q_lora.down.weight`), PEFT names adapters (`base_model.model.….to_q.lora_A.default.weight`),
kohya's trainers join a layer's name with underscores (`lora_unet_…_to_q.lora_down.weight`, `.alpha`), and ComfyUI puts
its own names of layers before any of these endings (`diffusion_model.….lora_up.weight`). Every prefix, every name of a
layer and every ending are understood in any combination.

Everything here is about strings; a layer's own name is diffusers' (`down_blocks.1.attentions.0.….attn1.to_q`).
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final, Literal

__all__ = ["Part", "WeightName", "comfyui_layers", "known_names", "parse_weight_name"]

Part = Literal["down", "up", "alpha"]
"""Of a layer's low-rank product: A (r, in), B (out, r), and the number alpha that scales it by alpha / r."""

_PREFIX: Final = re.compile(r"^(?:base_model\.model\.|unet\.|model\.diffusion_model\.|diffusion_model\.|lora_unet_)+")
_TEXT_ENCODER: Final = re.compile(
    r"^(?:base_model\.model\.)?(?:text_encoder(?:_\d)?\.|text_model\.|lora_te\d?_|clip_[lg]\.|te\d?[._])"
)
_ENDINGS: Final = (
    re.compile(r"^(?P<layer>.+?)\.lora_(?P<part>down|up|A|B)(?:\.(?!weight$)[^.]+)?\.weight$"),
    re.compile(r"^(?P<layer>.+?)[._]lora(?:_linear_layer)?\.(?P<part>down|up)\.weight$"),
    re.compile(r"^(?P<layer>.+?)(?:[._]lora)?\.(?P<part>alpha)$"),
)
_PARTS: Final[dict[str, Part]] = {"down": "down", "up": "up", "A": "down", "B": "up", "alpha": "alpha"}

_COMFYUI_RESNET: Final = {
    "conv1": "in_layers.2",
    "time_emb_proj": "emb_layers.1",
    "conv2": "out_layers.3",
    "conv_shortcut": "skip_connection",
}
_COMFYUI_ENDS: Final = {
    "conv_in": "input_blocks.0.0",
    "conv_out": "out.2",
    "time_embedding.linear_1": "time_embed.0",
    "time_embedding.linear_2": "time_embed.2",
    "add_embedding.linear_1": "label_emb.0.0",
    "add_embedding.linear_2": "label_emb.0.2",
}
_BLOCK: Final = re.compile(
    r"^(?P<side>down|up)_blocks\.(?P<level>\d+)\.(?P<kind>resnets|attentions|downsamplers|upsamplers)"
    r"\.(?P<index>\d+)\.(?P<rest>.+)$"
)
_MIDDLE: Final = re.compile(r"^mid_block\.(?P<kind>resnets|attentions)\.(?P<index>\d+)\.(?P<rest>.+)$")


@dataclass(frozen=True)
class WeightName:
    """One name of a LoRA file, taken apart.

    Attributes:
        layer: the layer as the file calls it, dots as underscores; a key of `known_names` if the model has it.
        part: which of the layer's weights it is.
    """

    layer: str
    part: Part


def parse_weight_name(name: str) -> WeightName | Literal["text encoder"] | None:
    """Take the name of a LoRA's weight apart; None if it has no ending of a low-rank product."""
    if _TEXT_ENCODER.match(name):
        return "text encoder"
    for ending in _ENDINGS:
        match = ending.match(name)
        if match:
            layer = _PREFIX.sub("", match["layer"]).replace(".processor.", ".")
            return WeightName(_joined(layer), _PARTS[match["part"]])
    return None


def known_names(layers: Collection[str]) -> dict[str, str]:
    """Every name under which a LoRA may speak of a UNet's layers, dots as underscores -> the layer.

    Args:
        layers: all layers of the UNet by diffusers' names.
    """
    comfyui = comfyui_layers(layers)
    names: dict[str, str] = {}
    for layer in layers:
        for name in (layer, comfyui.get(layer, layer)):
            names[_joined(name)] = layer
            # Attention processors named the projection without its place in the list it stands in.
            names[_joined(name.removesuffix(".0") if name.endswith(".to_out.0") else name)] = layer
    return names


def _joined(name: str) -> str:
    return name.replace(".", "_")


def comfyui_layers(layers: Collection[str]) -> dict[str, str]:
    """Layers of a UNet of SDXL's kind by ComfyUI's names: diffusers' name -> ComfyUI's.

    Args:
        layers: all layers of the UNet by diffusers' names; how many blocks a level has is read off them.
    """
    blocks = len({name.split(".")[3] for name in layers if name.startswith("down_blocks.0.resnets.")})
    attentive = {".".join(name.split(".")[:2]) for name in layers if ".attentions." in name}
    found = {layer: _comfyui_layer(layer, blocks, attentive) for layer in layers}
    return {layer: name for layer, name in found.items() if name is not None}


def _comfyui_layer(layer: str, blocks: int, attentive: Collection[str]) -> str | None:
    if middle := _MIDDLE.match(layer):
        # Residual block, attention, residual block.
        place = 1 if middle["kind"] == "attentions" else 2 * int(middle["index"])
        return f"middle_block.{place}.{_inside(middle)}"
    match = _BLOCK.match(layer)
    if not match:
        return _COMFYUI_ENDS.get(layer)
    level, index = int(match["level"]), int(match["index"])
    if match["kind"] == "downsamplers":
        return f"input_blocks.{(blocks + 1) * (level + 1)}.0.op"
    if match["kind"] == "upsamplers":
        place = 1 + (f"up_blocks.{level}" in attentive)
        return f"output_blocks.{(blocks + 1) * level + blocks}.{place}.{match['rest']}"
    # ComfyUI counts the first convolution and every downsampler as a block of its own on the way down.
    number = (blocks + 1) * level + index + (match["side"] == "down")
    side = "input" if match["side"] == "down" else "output"
    return f"{side}_blocks.{number}.{int(match['kind'] == 'attentions')}.{_inside(match)}"


def _inside(block: re.Match[str]) -> str:
    """The name of a layer inside its block."""
    return _COMFYUI_RESNET.get(block["rest"], block["rest"]) if block["kind"] == "resnets" else block["rest"]
