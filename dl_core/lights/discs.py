"""Discs of uniform radiance on a map: lights at infinity, each of irradiance 1."""

from __future__ import annotations

import math
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import latlong_directions, latlong_solid_angles
from ..shapes import Directions, Latlong

__all__ = ["disc_maps"]

_SMALLEST: Final = 0.75
"""Radius of the smallest disc in rows of the map: it meets a pixel's centre wherever it lies."""


def disc_maps(directions: Directions, radii: Float[Tensor, "n"], height: int) -> Latlong:
    """Maps of a light each: a disc whose edge is a row wide, of radiance that gives irradiance 1 exactly.

    Args:
        directions: (n, 3) unit vectors.
        radii: (n,) angular radii, radians, 0 to π / 2. What is smaller than the map holds is drawn as its smallest.
        height: rows of the maps.

    Returns:
        (n, height, 2 height, 1) radiance. The irradiance is that of the disc's whole light vector: all of the disc
        counts, by the cosine between its parts and its centre.
    """
    row = math.pi / height
    cosines = latlong_directions(height).double().reshape(-1, 3) @ directions.double().T
    drawn = radii.double().clamp(min=_SMALLEST * row)
    pixels, lights = torch.nonzero(cosines > torch.cos(drawn + row / 2), as_tuple=True)
    near = cosines[pixels, lights]
    cover = ((drawn[lights] - torch.acos(near.clamp(max=1))) / row + 0.5).clamp(0, 1)
    areas = latlong_solid_angles(height).expand(-1, 2 * height).reshape(-1)
    received = torch.zeros_like(drawn).index_add_(0, lights, cover * near * areas[pixels])
    maps = directions.new_zeros(len(drawn), len(areas))
    maps[lights, pixels] = (cover / received[lights]).to(maps)
    return maps.reshape(len(drawn), height, 2 * height, 1)
