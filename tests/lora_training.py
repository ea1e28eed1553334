"""A small model and pairs to train LoRAs on in tests: the mini model with random weights, pictures of 64 pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import torch

from dl_core.backends.mini import MiniModel
from dl_core.ball import place_ball
from dl_core.training.data.pairs import Pair
from dl_core.training.lora.base import LoraBase
from dl_core.training.lora.settings import LORA_SETTINGS, LoraSettings

__all__ = ["CANVAS", "SETTINGS", "Untrained", "random_pairs"]

CANVAS: Final = 64
SETTINGS: Final = replace(LoraSettings(), steps=6, batch=2, learning_rate=1e-2, rank=2)


@dataclass(frozen=True)
class Untrained:
    """Networks by the seed of their random weights."""

    seed: int = 0

    def model(self) -> MiniModel:
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            model = MiniModel.untrained()
        # Random networks paint black with little guidance.
        return replace(model, defaults=replace(model.defaults, guidance=1.5))

    def base(self) -> LoraBase:
        return LoraBase.from_mini(self.model())


def random_pairs(count: int = 5, seed: int = 3) -> list[Pair]:
    """Noise with a ball that is off the middle; EVs from 0 to the mini model's darkest."""
    generator = torch.Generator().manual_seed(seed)
    pictures = (torch.rand(count, 1, CANVAS, CANVAS, 3, generator=generator) * 255).round() / 255
    evs = torch.linspace(0, LORA_SETTINGS["mini"].ev_min, count).tolist()
    ball = place_ball(CANVAS, 26, x=27, y=35)
    return [Pair(picture, ball, ev, f"map {i}") for i, (picture, ev) in enumerate(zip(pictures, evs, strict=True))]
