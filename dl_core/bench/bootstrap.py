"""How sure a mean over scenes is: intervals by resampling the scenes.

Source: Efron, Bootstrap methods: another look at the jackknife (Annals of Statistics 1979), percentile intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ..errors import OptionError

__all__ = ["LEVEL", "Interval", "mean_interval"]

LEVEL: Final = 0.95
"""Share of intervals that hold the true mean, if the scenes are like those to come."""
_DRAWS: Final = 4000
_SEED: Final = 20240617
"""Of the draws: the same scenes always have the same interval."""


@dataclass(frozen=True)
class Interval:
    """A mean and where it may lie.

    Attributes:
        mean: over the scenes.
        low: lower end; None for a single scene, which tells nothing of others.
        high: upper end, likewise.
    """

    mean: float
    low: float | None
    high: float | None


def mean_interval(values: Sequence[float]) -> Interval:
    """The mean of one value a scene, with its 95% interval.

    Args:
        values: one for each scene.

    Raises:
        OptionError: no values.
    """
    if not values:
        raise OptionError("values", 0, "1 or more")
    scenes = np.asarray(values, dtype=np.float64)
    if len(scenes) == 1:
        return Interval(float(scenes[0]), None, None)
    draws = np.random.default_rng(_SEED).integers(0, len(scenes), size=(_DRAWS, len(scenes)))
    low, high = np.quantile(scenes[draws].mean(axis=1), ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(float(scenes.mean()), float(low), float(high))
