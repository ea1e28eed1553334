"""A random LoRA, written as every trainer and host writes it, and what it adds to a UNet's weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

RANK: Final = 4
ALPHA: Final = 2.0

Written = Callable[[str, str], dict[str, str]]
"""Layer by diffusers' name and by ComfyUI's -> names of down, up and, where the convention has one, alpha."""


def _pair(down: str, up: str, alpha: str | None = None) -> dict[str, str]:
    return {"down": down, "up": up} | ({} if alpha is None else {"alpha": alpha})


def _processor(layer: str, comfyui: str) -> dict[str, str]:
    attention, projection = layer.removesuffix(".0").rsplit(".", 1)
    stem = f"unet.{attention}.processor.{projection}_lora"
    return _pair(f"{stem}.down.weight", f"{stem}.up.weight")


def _underscored(layer: str) -> dict[str, str]:
    stem = f"lora_unet_{layer.replace('.', '_')}"
    return _pair(f"{stem}.lora_down.weight", f"{stem}.lora_up.weight", f"{stem}.alpha")


def _peft(prefix: str, layer: str, adapter: str = "") -> dict[str, str]:
    return _pair(f"{prefix}{layer}.lora_A{adapter}.weight", f"{prefix}{layer}.lora_B{adapter}.weight")


CONVENTIONS: Final[dict[str, Written]] = {
    "diffusers, attention processors": _processor,
    "diffusers, layers": lambda layer, _: _pair(f"unet.{layer}.lora.down.weight", f"unet.{layer}.lora.up.weight"),
    "diffusers, linear layers": lambda layer, _: _pair(
        f"{layer}.lora_linear_layer.down.weight", f"{layer}.lora_linear_layer.up.weight"
    ),
    "peft": lambda layer, _: _peft("", layer),
    "peft of a pipeline": lambda layer, _: _peft("unet.", layer),
    "peft of a model": lambda layer, _: _peft("base_model.model.", layer),
    "peft with an adapter": lambda layer, _: _peft("base_model.model.", layer, ".exposure"),
    "kohya": lambda layer, _: _underscored(layer),
    "kohya for SDXL": lambda _, comfyui: _underscored(comfyui),
    "ComfyUI": lambda _, comfyui: _pair(
        f"diffusion_model.{comfyui}.lora_down.weight",
        f"diffusion_model.{comfyui}.lora_up.weight",
        f"diffusion_model.{comfyui}.alpha",
    ),
    "ComfyUI, peft": lambda _, comfyui: _peft("diffusion_model.", comfyui),
}


@dataclass(frozen=True)
class RandomLora:
    """Pairs of down and up by layer; with a convention that has no alpha its up half carries alpha / rank."""

    pairs: Mapping[str, tuple[Tensor, Tensor]]

    @staticmethod
    def on(shapes: Mapping[str, tuple[int, ...]], generator: torch.Generator, size: float = 0.1) -> RandomLora:
        """A LoRA on all layers given, each product about `size` times as large as a layer's weights are at the start.

        A layer's entries have a standard deviation near 1 / sqrt(3 n), n its inputs; a product of r terms a · b has
        sqrt(r) σ_a σ_b.
        """
        pairs = {}
        for layer, (out, *inside) in shapes.items():
            inputs = torch.Size(inside).numel()
            down = torch.randn((RANK, *inside), generator=generator) / inputs**0.5
            up = torch.randn((out, RANK, *(1 for _ in inside[1:])), generator=generator)
            pairs[layer] = (down, up * size * RANK / ALPHA / (3 * RANK) ** 0.5)
        return RandomLora(pairs)

    def deltas(self) -> dict[str, Tensor]:
        """alpha / rank · up · down by layer, summed over the rank."""
        return {
            layer: torch.einsum("or,ri->oi", up.flatten(1), down.flatten(1)).reshape(len(up), *down.shape[1:])
            * (ALPHA / RANK)
            for layer, (down, up) in self.pairs.items()
        }

    def written(self, convention: str, comfyui: Mapping[str, str]) -> dict[str, Tensor]:
        """The file's content in a convention; `comfyui` gives the layers' names there."""
        weights = {}
        for layer, (down, up) in self.pairs.items():
            names = CONVENTIONS[convention](layer, comfyui[layer])
            carried = up if "alpha" in names else up * (ALPHA / RANK)
            parts = {"down": down, "up": carried, "alpha": torch.tensor(ALPHA)}
            weights |= {name: parts[part] for part, name in names.items()}
        return weights


def merged(weights: Mapping[str, Tensor], lora: RandomLora, scale: float) -> dict[str, Tensor]:
    """A UNet's weights by diffusers' names with a LoRA added by hand: W + scale · alpha / rank · B A."""
    deltas = lora.deltas()
    return {
        name: weight + scale * deltas[name.removesuffix(".weight")]
        if name.removesuffix(".weight") in deltas and name.endswith(".weight")
        else weight
        for name, weight in weights.items()
    }


def attention_layers(layers: Mapping[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """The projections of every attention, which is where the authors' LoRAs act."""
    ends = (".to_q", ".to_k", ".to_v", ".to_out.0")
    return {layer: shape for layer, shape in layers.items() if layer.endswith(ends)}
