"""An analytic sun and sky whose light is known exactly.

The sky is CIE standard sky type 12 ("clear sky, low illuminance turbidity"): luminance relative to the zenith is

    L(Z, χ) / L(0) = f(χ) φ(Z) / (f(Zs) φ(0)),   φ(Z) = 1 + a exp(b / cos Z),
    f(χ) = 1 + c (exp(d χ) - exp(d π / 2)) + e cos² χ,

with Z the angle from the zenith, χ the angle from the sun, Zs the sun's zenith angle, and
a = -1, b = -0.32, c = 10, d = -3, e = 0.45. The sun is a disc of uniform radiance: its irradiance on a surface that
faces it is π sin²(r) times its radiance, r being its angular radius.

Source: CIE S 011/E:2003 (ISO 15469:2004), Spatial distribution of daylight; Darula and
Kittler, CIE general sky standard defining luminance distributions (eSim 2002), where both are printed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import OptionError
from ..geometry import latlong_directions, latlong_solid_angles
from ..shapes import Latlong

__all__ = ["SunAndSky", "sun_direction"]

_GRADATION = (-1.0, -0.32)
_INDICATRIX = (10.0, -3.0, 0.45)
_FINE = 8
"""Subpixels along each side of the map pixels the sun's edge may cross."""


def sun_direction(elevation: float, azimuth: float) -> tuple[float, float, float]:
    """Unit vector towards a sun.

    Args:
        elevation: degrees above the horizon.
        azimuth: degrees to the right of straight ahead.
    """
    up, right = math.radians(elevation), math.radians(azimuth)
    return math.cos(up) * math.sin(right), math.sin(up), -math.cos(up) * math.cos(right)


@dataclass(frozen=True)
class SunAndSky:
    """A clear sky with a sun above a grey ground.

    Attributes:
        sun: unit vector towards the sun's centre.
        sun_radius: angular radius of the sun in degrees; the real one's is 0.266.
        sun_irradiance: RGB irradiance of the sun on a surface that faces it, radiance units x sr.
        zenith: RGB radiance of the sky straight up.
        ground: RGB radiance of everything below the horizon.
    """

    sun: tuple[float, float, float] = (0.5, 0.5, -math.sqrt(0.5))
    sun_radius: float = 0.266
    sun_irradiance: tuple[float, float, float] = (4.0, 3.7, 3.2)
    zenith: tuple[float, float, float] = (0.12, 0.2, 0.4)
    ground: tuple[float, float, float] = (0.08, 0.07, 0.06)

    def __post_init__(self) -> None:
        if not abs(math.hypot(*self.sun) - 1) < 1e-6:
            raise OptionError("sun", self.sun, "a unit vector")
        if not 0 < self.sun_radius <= 45:
            raise OptionError("sun_radius", self.sun_radius, "above 0, up to 45 degrees")

    @property
    def sun_solid_angle(self) -> float:
        """Of the sun's disc, 2π (1 - cos r), in steradians."""
        return 2 * math.pi * (1 - math.cos(math.radians(self.sun_radius)))

    @property
    def sun_radiance(self) -> tuple[float, ...]:
        """RGB radiance of the sun's disc: irradiance / (π sin² r)."""
        projected = math.pi * math.sin(math.radians(self.sun_radius)) ** 2
        return tuple(channel / projected for channel in self.sun_irradiance)

    @property
    def sun_energy(self) -> tuple[float, ...]:
        """RGB radiance x sr of the sun's disc over the sphere."""
        return tuple(channel * self.sun_solid_angle for channel in self.sun_radiance)

    def radiance(self, directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Radiance of sky and ground, without the sun, in unit directions."""
        cos_zenith = directions[..., 1]
        relative = _gradation(cos_zenith) * _indicatrix(_angle_to(directions, self.sun)) / self._at_zenith()
        sky = relative[..., None] * directions.new_tensor(self.zenith)
        return torch.where((cos_zenith > 0)[..., None], sky, directions.new_tensor(self.ground))

    def _at_zenith(self) -> float:
        up = torch.tensor(1.0, dtype=torch.float64)
        angle = torch.tensor(math.acos(max(-1.0, min(1.0, self.sun[1]))), dtype=torch.float64)
        return float(_gradation(up) * _indicatrix(angle))

    def latlong(self, height: int) -> Latlong:
        """The map of this light: (1, height, 2 height, 3) linear radiance.

        The sun is added with the share of each pixel it covers, and its energy is exact at any size: the shares are
        normalized to the disc's solid angle. A sun smaller than a subpixel falls on the pixel at its centre.
        """
        directions = latlong_directions(height).double()
        cover = self._sun_coverage(height)
        solid_angles = latlong_solid_angles(height).double()
        cover = cover * (self.sun_solid_angle / (cover * solid_angles).sum())
        sun = cover[..., None] * directions.new_tensor(self.sun_radiance)
        return (self.radiance(directions) + sun).float()[None]

    def _sun_coverage(self, height: int) -> Float[Tensor, "h w"]:
        """Share of each pixel that the sun covers, by supersampling the pixels near it."""
        radius = math.radians(self.sun_radius)
        coarse = latlong_directions(height).double()
        near = _angle_to(coarse, self.sun) <= radius + 1.5 * math.pi / height
        rows, columns = torch.nonzero(near, as_tuple=True)
        offsets = (torch.arange(_FINE, dtype=torch.float64) + 0.5) / _FINE
        polar = (rows[:, None, None] + offsets[None, :, None]) * (math.pi / height)
        azimuth = ((columns[:, None, None] + offsets[None, None, :]) / (2 * height) - 0.5) * (2 * math.pi)
        polar, azimuth = torch.broadcast_tensors(polar, azimuth)
        fine = torch.stack(
            (polar.sin() * azimuth.sin(), polar.cos(), -polar.sin() * azimuth.cos()),
            dim=-1,
        )
        angles = _angle_to(fine, self.sun)
        covered = (angles <= max(radius, float(angles.min()))).double()
        cover = torch.zeros(height, 2 * height, dtype=torch.float64)
        cover[rows, columns] = (covered * polar.sin()).sum(dim=(1, 2)) / polar.sin().sum(dim=(1, 2))
        return cover


def _angle_to(directions: Tensor, axis: tuple[float, float, float]) -> Tensor:
    """Angles in radians between unit directions and an axis, exact for small ones too."""
    towards = directions.new_tensor(axis)
    chord = torch.linalg.norm(directions - towards, dim=-1)
    return 2 * torch.arcsin((chord / 2).clamp(max=1))


def _gradation(cos_zenith: Tensor) -> Tensor:
    a, b = _GRADATION
    return 1 + a * torch.exp(b / cos_zenith.clamp(min=1e-3))


def _indicatrix(angle: Tensor) -> Tensor:
    c, d, e = _INDICATRIX
    return 1 + c * (torch.exp(d * angle) - math.exp(d * math.pi / 2)) + e * torch.cos(angle) ** 2
