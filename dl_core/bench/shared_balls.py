"""Balls that several schedules have in common, painted once.

A ball follows from its seed and its request, so the first five of thirty balls are those of a schedule of five. A
chart over many schedules then costs little more than its dearest one. Evaluations and seconds are counted for every
schedule as if it had painted all of its balls itself.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Final

import torch

from ..finished import FinishedBalls, content_key
from ..painter import Observer, Painter, PaintRequest, PaintResult

__all__ = ["SharedBalls"]

LIMIT: Final = 2**30
"""Bytes of balls kept."""


class SharedBalls:
    """A painter that keeps what another one paints.

    Attributes:
        seconds: what all requests so far would have taken, each ball at its share of the batch it was painted in.
    """

    def __init__(self, painter: Painter) -> None:
        """Take the painter whose balls are kept."""
        self._painter = painter
        self._finished = FinishedBalls(LIMIT)
        self._cost: dict[tuple[str, int], tuple[float, int]] = {}
        self.seconds = 0.0

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """See `painter.Painter`."""
        return self._painter.evaluations(balls, steps, strength, until)

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """See `painter.Painter`."""
        key = content_key(replace(request, seeds=(0,)))
        found = self._finished.find(key, request.seeds)
        wanted = tuple(seed for seed in request.seeds if seed not in found)
        notes: tuple[str, ...] = ()
        if wanted:
            started = perf_counter()
            painted = self._painter.paint(replace(request, seeds=wanted), observer)
            each = ((perf_counter() - started) / len(wanted), painted.evaluations // len(wanted))
            self._finished.keep(key, wanted, painted.balls)
            self._cost |= {(key, seed): each for seed in wanted}
            found |= dict(zip(wanted, painted.balls.split(1), strict=True))
            notes = painted.notes
        costs = [self._cost[key, seed] for seed in request.seeds]
        self.seconds += sum(seconds for seconds, _ in costs)
        balls = torch.cat([found[seed] for seed in request.seeds])
        return PaintResult(balls, sum(evaluations for _, evaluations in costs), notes)
