"""Training pairs drawn when they are asked for, instead of read from shards."""

from __future__ import annotations

from dataclasses import dataclass

from .pairs import Pair
from .scenes import SceneSampler

__all__ = ["DrawnPairs"]


@dataclass(frozen=True)
class DrawnPairs:
    """The first pairs of a sampler's stream.

    Attributes:
        sampler: draws brackets.
        count: how many pairs there are.
    """

    sampler: SceneSampler
    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Pair:
        """The pair of an index from 0."""
        if not 0 <= index < self.count:
            raise IndexError(f"pair {index} of {self.count}")
        picture = self.sampler.draw(index)
        return Pair(picture.canvas_ldr, picture.ball, picture.ev, "drawn")
