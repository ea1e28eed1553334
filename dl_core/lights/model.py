"""Light in few numbers: spherical harmonics up to band 2, and lights at infinity.

A light arrives from one direction d. Its irradiance E is what a surface that faces it receives, in each channel. With
an angular radius a it is a disc of uniform radiance E / (π sin² a); without one it is a directional light, which no
mirror shows.

The harmonics are signed. Where they say less than nothing, a surface that sums them receives less, as their sum over
the sphere needs it to; a map of them, which has to be 0 or above, is brighter there. `negative_share` says by how much.

Prices: three numbers for each coefficient, five for a directional light (two of direction, three of colour), six for
one with a radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import latlong_solid_angles
from ..harmonics import sh_map
from ..shapes import Latlong
from .discs import disc_maps

__all__ = ["CHANNELS", "Light", "LightModel"]

CHANNELS: Final = 3
_DIRECTION: Final = 2
_BANDS: Final = {1: "ambient", 4: "sh1", 9: "sh2"}


@dataclass(frozen=True)
class Light:
    """A light at infinity.

    Attributes:
        direction: unit vector towards it; +X right, +Y up, the camera looks along -Z.
        irradiance: RGB on a surface that faces it, radiance units x sr.
        angular_radius: of its disc, degrees; None for a directional light.
    """

    direction: tuple[float, float, float]
    irradiance: tuple[float, float, float]
    angular_radius: float | None = None

    @property
    def parameters(self) -> int:
        """Numbers that describe it."""
        return _DIRECTION + CHANNELS + (self.angular_radius is not None)

    @property
    def radiance(self) -> tuple[float, ...] | None:
        """RGB radiance of its disc; None for a directional light, which has none."""
        if self.angular_radius is None:
            return None
        projected = math.pi * math.sin(math.radians(self.angular_radius)) ** 2
        return tuple(channel / projected for channel in self.irradiance)


@dataclass(frozen=True)
class LightModel:
    """Harmonics and lights that stand for a map.

    Attributes:
        coefficients: (1, 4 or 9, 3) float64, of radiance, in the order and axes of `harmonics`.
        lights: the strongest first.
    """

    coefficients: Float[Tensor, "k 3"]
    lights: tuple[Light, ...] = ()

    @property
    def name(self) -> str:
        """What it is made of, such as "sh2 + 2 directional + 1 area"."""
        area = sum(light.angular_radius is not None for light in self.lights)
        counts = ((len(self.lights) - area, "directional"), (area, "area"))
        return " + ".join((_BANDS[len(self.coefficients)], *(f"{count} {kind}" for count, kind in counts if count)))

    @property
    def parameters(self) -> int:
        """Its price: the numbers that describe it."""
        return self.coefficients.numel() + sum(light.parameters for light in self.lights)

    def harmonics_map(self, height: int) -> Latlong:
        """(1, height, 2 height, 3) radiance of the harmonics; it may be negative."""
        return sh_map(self.coefficients[None], height)

    def background_map(self, height: int) -> Latlong:
        """The harmonics as a texture: (1, height, 2 height, 3) radiance, what is negative raised to 0."""
        return self.harmonics_map(height).clamp(min=0)

    def radiance_map(self, height: int) -> Latlong:
        """The map of this light: (1, height, 2 height, 3) radiance, 0 or above.

        A directional light, which has no radiance, becomes the smallest disc that the map holds.
        """
        latlong = self.background_map(height)
        if self.lights:
            directions = torch.tensor([light.direction for light in self.lights])
            radii = torch.tensor([math.radians(light.angular_radius or 0.0) for light in self.lights])
            irradiance = torch.tensor([light.irradiance for light in self.lights])
            latlong = latlong + torch.einsum("nhwo,nc->hwc", disc_maps(directions, radii, height), irradiance)
        return latlong

    def negative_share(self, height: int = 64) -> float:
        """Energy that `background_map` adds by raising what is negative, as a share of the harmonics' energy."""
        signed = self.harmonics_map(height).double() * latlong_solid_angles(height)[None, :, :, None]
        total = float(signed.sum())
        return float(-signed.clamp(max=0).sum()) / total if total > 0 else 0.0
