"""Training pairs drawn when they are asked for, instead of read from shards."""

from __future__ import annotations

from dataclasses import dataclass

from ..data.pairs import Pair
from .scene_sampler import SceneSampler

__all__ = ["DrawnPairs"]


@dataclass(frozen=True)
class DrawnPairs:
    """The first pairs of a sampler's stream.

    Attributes:
        sampler: draws brackets.
        count: how many pairs there are.
        scale: every pixel that is drawn becomes so many across and down; blocks of 8 keep their means.
    """

    sampler: SceneSampler
    count: int
    scale: int = 1

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Pair:
        """The pair of an index from 0."""
        if not 0 <= index < self.count:
            raise IndexError(f"pair {index} of {self.count}")
        picture = self.sampler.draw(index)
        pixels = picture.canvas_ldr
        for axis in (1, 2):
            pixels = pixels.repeat_interleave(self.scale, dim=axis)
        return Pair(pixels, picture.ball.enlarged(self.scale), picture.ev, "drawn")
