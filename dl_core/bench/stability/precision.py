"""What rounding and slopes do where geometry and exposure are awkward: rim, poles, seam, blacks and highlights.

No painter is asked: a random ball is unwrapped and a random bracket merged, in single precision and in double.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ...exposure import expose, merge_bracket
from ...geometry import ball_to_latlong, latlong_directions
from ...presets import PAPER_EVS
from ...shapes import BallImage
from ..map_distance import log_error
from ..report import Row

__all__ = ["precision_rows"]

SIZE: Final = 64
HEIGHT: Final = 64
MERGE: Final = "robust"
RIM_DEGREES: Final = 10.0
"""From straight behind the camera: what the rim shows."""
PROBE: Final = 1e-6
"""Half the step of difference quotients, in double precision."""
ROOM: Final = 10
"""Such steps that a value has to be from black and white for the line to change it."""
ROUND_OFF: Final = "round-off"
GRADIENT: Final = "gradient"


def precision_rows() -> Iterator[Row]:
    """Rows of families `round-off`, stops between results of single and double precision, the largest of a region, and
    `gradient`, how far the slope along a random line is from the difference quotient, as a share of it."""
    light = 0.1 + 0.9 * torch.rand(1, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    yield from _rows_of(lambda ball: ball_to_latlong(ball, HEIGHT, painted=True), light, _regions())
    for name, level in _LEVELS.items():
        bracket = torch.cat([expose(level * light, ev) for ev in PAPER_EVS])
        bracket[:, 0, 0] = 0.0  # black to the last bit, where a power has no slope to speak of
        yield from _rows_of(_merged, bracket, {f"merge, {name}": torch.ones(SIZE, SIZE, dtype=torch.bool)})


_LEVELS: Final = {"blacks": 2.0**-14, "about white": 1.5, "highlights": 0.9 * 2.0**5}
"""Largest value of the light that a bracket shows, by where on the scale that is."""


def _merged(bracket_ldr: BallImage) -> Float[Tensor, "1 d d c"]:
    return merge_bracket(list(bracket_ldr.split(1)), PAPER_EVS, MERGE)


def _rows_of(function: Callable[[Tensor], Tensor], at: Tensor, regions: dict[str, Tensor]) -> Iterator[Row]:
    error = log_error(function(at.float()).double(), function(at))
    for name, region in regions.items():
        yield {"family": ROUND_OFF, "variant": name, "distance": float(error[region].max()), "unit": "stops"}
        slope = _slope_error(function, at, region)
        yield {"family": GRADIENT, "variant": name, "distance": slope, "unit": "share of the slope"}


def _regions() -> dict[str, Tensor]:
    """Directions of the map that unwrapping finds awkward, as masks."""
    directions = latlong_directions(HEIGHT)
    rows, columns = torch.arange(HEIGHT)[:, None], torch.arange(2 * HEIGHT)[None, :]
    everywhere = torch.ones(HEIGHT, 2 * HEIGHT, dtype=torch.bool)
    behind = torch.rad2deg(torch.acos(directions[..., 2].clamp(-1, 1)))
    return {
        "unwrap at the rim": behind <= RIM_DEGREES,
        "unwrap at the poles": ((rows == 0) | (rows == HEIGHT - 1)) & everywhere,
        "unwrap at the seam": ((columns == 0) | (columns == 2 * HEIGHT - 1)) & everywhere,
        "unwrap elsewhere": behind > RIM_DEGREES,
    }


def _slope_error(function: Callable[[Tensor], Tensor], at: Tensor, region: Tensor) -> float:
    """How far the slope of the region's mean along a random line is from its difference quotient, relative."""
    line = torch.randn(at.shape, generator=torch.Generator().manual_seed(1), dtype=at.dtype)
    line = line * ((at > ROOM * PROBE) & (at < 1 - ROOM * PROBE))  # to stay among display values
    weight = region.to(at)[None, ..., None]

    def mean(picture: Tensor) -> Tensor:
        return (function(picture) * weight).sum() / weight.sum()

    start = at.clone().requires_grad_()
    (slopes,) = torch.autograd.grad(mean(start), start)
    derived = float((slopes * line).sum())
    quotient = float((mean(at + PROBE * line) - mean(at - PROBE * line)) / (2 * PROBE))
    return abs(derived - quotient) / max(abs(quotient), abs(derived), 1e-300)
