"""LoRAs as low-rank products by layer, whatever the file calls them, and the swap of Turbo's two.

Sources: Hu et al. 2022 (LoRA: W + α / r · B A); DiffusionLight-Turbo (swap of LoRAs within a pass).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from torch import Tensor

from .errors import ModelError, OptionError
from .lora_names import Part, WeightName, known_names, parse_weight_name

__all__ = ["EXPOSURE_SCALE", "LoraSwap", "LowRank", "read_lora"]

EXPOSURE_SCALE: Final = 0.75
"""Scale of the exposure LoRA in the paper."""

SHOWN: Final = 3
"""Names listed in a message, of however many it is about."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LowRank:
    """What a LoRA adds to one layer's weight at scale 1: `scale` · up · down.

    Attributes:
        down: A, (r, in) of a linear layer, (r, in, kh, kw) of a convolution.
        up: B, (out, r) or (out, r, 1, 1).
        scale: α / r; 1 where the file gives no α.
    """

    down: Tensor
    up: Tensor
    scale: float = 1.0

    def fits(self, shape: Sequence[int]) -> bool:
        """Whether the product has the shape of a layer's weight, (out, in) or (out, in, kh, kw)."""
        down, up, ones = tuple(self.down.shape), tuple(self.up.shape), (1,) * (len(shape) - 2)
        return down[1:] == tuple(shape[1:]) and up == (shape[0], down[0], *ones)


@dataclass(frozen=True)
class LoraSwap:
    """Two LoRAs that share a sampling pass, one after the other.

    Attributes:
        timestep: the Turbo LoRA acts at this timestep and above, the exposure LoRA below; 0 to 1000.
        turbo_scale: of the Turbo LoRA.
        exposure_scale: of the exposure LoRA.

    Source: the authors' code of DiffusionLight-Turbo; 6 of its 30 steps lie at 800 and above.
    """

    timestep: float = 800
    turbo_scale: float = 1.0
    exposure_scale: float = EXPOSURE_SCALE

    def __post_init__(self) -> None:
        if not 0 <= self.timestep <= 1000:
            raise OptionError("timestep", self.timestep, "0 to 1000")

    def turbo_at(self, timestep: float) -> bool:
        """Whether it is the Turbo LoRA that acts at a timestep."""
        return timestep >= self.timestep


def read_lora(weights: Mapping[str, Tensor], shapes: Mapping[str, Sequence[int]], source: object) -> dict[str, LowRank]:
    """The low-rank products of a LoRA by layer of the UNet, by diffusers' names.

    Weights for text encoders are left out, with a line in the log: the method leaves the text encoders as they are.

    Args:
        weights: of the file, under any of the names `lora_names` knows.
        shapes: of the weights of all the UNet's linear and convolutional layers, by diffusers' names of the layers.
        source: names the LoRA in messages.

    Raises:
        ModelError: a weight that is no part of a low-rank product of a layer this UNet has, a product that is not
            whole or not of its layer's shape, or no product at all.
    """
    found, unmatched, text = _sort(weights, known_names(shapes))
    unmatched += [name for parts in found.values() if not {"down", "up"} <= parts.keys() for name in parts.values()]
    if unmatched:
        raise ModelError(
            source,
            f"{len(unmatched)} of {len(weights)} weights have no place in this UNet: {_some(unmatched)}; a LoRA of "
            "plain up and down pairs for a model of this architecture is accepted",
        )
    if not found:
        raise ModelError(source, f"has no weights for a UNet; it holds {_some(list(weights))}")
    if text:
        _log.warning("%s: its %d weights for text encoders are left out: %s", source, len(text), _some(text))
    lora = {layer: _product(parts, weights) for layer, parts in found.items()}
    _require_fit(lora, shapes, source)
    return lora


def _sort(
    weights: Mapping[str, Tensor], known: Mapping[str, str]
) -> tuple[dict[str, dict[Part, str]], list[str], list[str]]:
    """Names of a file: by layer and part, without a place, and of text encoders."""
    found: dict[str, dict[Part, str]] = {}
    unmatched, text = [], []
    for name in weights:
        parsed = parse_weight_name(name)
        if parsed == "text encoder":
            text.append(name)
        elif isinstance(parsed, WeightName) and parsed.layer in known:
            parts = found.setdefault(known[parsed.layer], {})
            if parsed.part in parts:  # two conventions in one file, for one layer
                unmatched.append(name)
            parts.setdefault(parsed.part, name)
        else:
            unmatched.append(name)
    return found, unmatched, text


def _product(parts: Mapping[Part, str], weights: Mapping[str, Tensor]) -> LowRank:
    down, up = weights[parts["down"]], weights[parts["up"]]
    alpha = float(weights[parts["alpha"]]) if "alpha" in parts else float(len(down))
    return LowRank(down, up, alpha / len(down))


def _require_fit(lora: Mapping[str, LowRank], shapes: Mapping[str, Sequence[int]], source: object) -> None:
    for layer, product in lora.items():
        if not product.fits(shapes[layer]):
            raise ModelError(
                source,
                f"is for another model: {layer} is {tuple(shapes[layer])} here, the LoRA's weights are "
                f"{tuple(product.up.shape)} times {tuple(product.down.shape)}",
            )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
