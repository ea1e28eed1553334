"""Distances between two lightings: energy, irradiance, si-RMSE, angular error, strongest light, harmonics.

Irradiance is compared rather than radiance because it is what a lit diffuse surface shows: a light map may blur a
lamp and still be right, or look right and miss the sun. Pictures of lit spheres are compared in `picture_errors`.

Sources: Grosse et al., Ground truth dataset and baseline evaluations for intrinsic image algorithms (ICCV 2009), for
the scale-invariant error; LeGendre et al., DeepLight (CVPR 2019), for the angular error; Ramamoorthi and Hanrahan,
An efficient representation for irradiance environment maps (SIGGRAPH 2001), Eq. 1, for irradiance; Gardner et al.,
Deep parametric indoor lighting estimation (ICCV 2019), for lights as regions down to a third of their peak; Liang et
al., LuxDiT (2025), for comparing the directions of the strongest lights.
"""

from __future__ import annotations

import math
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from .errors import ImageError
from .exposure import luminance
from .geometry import latlong_directions, latlong_energy, latlong_solid_angles
from .harmonics import sh_project
from .shapes import Directions, Latlong

__all__ = [
    "angular_error",
    "dominant_light",
    "energy_kept",
    "irradiance",
    "least_squares_scale",
    "light_direction_error",
    "rgb_angles",
    "sh_band_errors",
    "si_rmse",
    "spread_directions",
]

LIGHT_RADIUS: Final = 10.0
"""Angular radius, in degrees, of the caps that compete for the strongest light."""
LIGHT_EDGE: Final = 1 / 3
"""Share of a light's peak down to which pixels belong to it (Gardner et al. 2019, Sec. 3)."""
_SEARCH_ROWS: Final = 32
"""Rows that a map is reduced to for the search; the direction itself is measured on the full map."""
_STRIP: Final = 1 << 15
"""Pixels of a map whose light is summed at once."""
_RECENTRINGS: Final = 3
"""Times the winning cap is moved to the centroid of its light, so that a light is not cut by the search's grid."""


def spread_directions(count: int) -> Float[Tensor, "n 3"]:
    """Well-spread unit vectors: the Fibonacci spiral, equal steps in height and golden angles around.

    Source: González, Measurement of areas on a sphere using Fibonacci and latitude-longitude lattices (2010).
    """
    index = torch.arange(count, dtype=torch.float64) + 0.5
    y = 1 - 2 * index / count
    azimuth = index * (math.pi * (3 - math.sqrt(5)))
    ring = torch.sqrt(1 - y * y)
    return torch.stack((ring * torch.cos(azimuth), y, ring * torch.sin(azimuth)), dim=-1).float()


def irradiance(latlong_hdr: Latlong, normals: Directions) -> Float[Tensor, "b n c"]:
    """Irradiance on surfaces of given normals: the sum over the map of L max(0, n·ω) dω.

    Args:
        latlong_hdr: (B, H, 2H, C) linear radiance; every pixel is taken as a light at its centre, with its exact
            solid angle. No visibility, no albedo: a uniform map of radiance 1 gives π.
        normals: (n, 3) unit vectors.
    """
    height = latlong_hdr.shape[1]
    weights = latlong_solid_angles(height, device=latlong_hdr.device)
    directions = latlong_directions(height, device=latlong_hdr.device)
    light = (latlong_hdr * weights[None, :, :, None]).flatten(1, 2)
    # One product serves every map of the batch, and strips keep large maps within memory.
    strips = zip(light.transpose(0, 1).split(_STRIP), directions.reshape(-1, 3).split(_STRIP), strict=True)
    lit = sum((normals.to(light) @ towards.T).clamp(min=0) @ part.flatten(1) for part, towards in strips)
    return torch.as_tensor(lit).unflatten(1, (len(light), -1)).transpose(0, 1)


def energy_kept(estimate_hdr: Latlong, truth_hdr: Latlong) -> float:
    """Energy of an estimate as a share of the truth's: radiance integrated over the sphere, channels summed."""
    truth = float(latlong_energy(truth_hdr).sum())
    if truth <= 0:
        raise ImageError("truth", "holds no light")
    return float(latlong_energy(estimate_hdr).sum()) / truth


def least_squares_scale(estimate: Float[Tensor, "*n"], truth: Float[Tensor, "*n"]) -> float:
    """The scale a that minimizes ‖a·estimate - truth‖: e·t / e·e; 0 for an estimate that is 0 everywhere.

    Source: Grosse et al. 2009, Sec. 4 (one window over the whole signal).
    """
    e, t = estimate.double(), truth.double()
    power = float((e * e).sum())
    return float((e * t).sum()) / power if power > 0 else 0.0


def si_rmse(estimate: Float[Tensor, "*n c"], truth: Float[Tensor, "*n c"]) -> float:
    """Scale-invariant RMSE relative to the truth's mean: min over a of ‖a·estimate - truth‖ / (√N · mean truth).

    One scale serves all channels, and the mean goes over items and channels alike. Divided by the mean, scenes of
    different brightness weigh the same; a published figure without that division is not comparable.

    Args:
        estimate: linear values.
        truth: linear values of the same shape, not all zero.

    Raises:
        ImageError: a truth without light.
    """
    e, t = estimate.double(), truth.double()
    mean = float(t.mean())
    if mean <= 0:
        raise ImageError("truth", "holds no light")
    return math.sqrt(float((least_squares_scale(e, t) * e - t).square().mean())) / mean


def rgb_angles(estimate: Float[Tensor, "*n 3"], truth: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Angles between RGB vectors, in radians and float64; 0 where either is black.

    Source: LeGendre et al. 2019, Sec. 5 (angular error between RGB vectors).
    """
    e, t = estimate.double(), truth.double()
    # arctan2 of cross and dot: arccos loses half of its digits at small angles.
    return torch.atan2(torch.linalg.norm(torch.linalg.cross(e, t), dim=-1), (e * t).sum(-1))


def angular_error(estimate: Float[Tensor, "*n 3"], truth: Float[Tensor, "*n 3"]) -> float:
    """Mean angle between RGB vectors in degrees: an error of colour that does not see brightness.

    Pairs of which one is black have no angle and are left out; 0 if all are.
    """
    lit = (estimate != 0).any(-1) & (truth != 0).any(-1)
    angles = rgb_angles(estimate[lit], truth[lit])
    return float(torch.rad2deg(angles).mean()) if angles.numel() else 0.0


def dominant_light(latlong_hdr: Latlong) -> Float[Tensor, "b 3"]:
    """Direction of the strongest light of a map.

    The strongest light is the cap of 10 degrees that sends the most luminance, so that a lone bright pixel does not
    win over a lamp. Its direction is the energy-weighted centroid of the cap's pixels of at least a third of the
    cap's peak: a small light gives its own centre, wherever it lies in the cap.

    Args:
        latlong_hdr: (B, H, 2H, 3) linear radiance, 0 or above.

    Returns:
        (B, 3) unit vectors.

    Raises:
        ImageError: a map without light.

    Warnings:
        A map of even light has no strongest light; it gets some direction.

    Source: the region down to a third of its peak is that of Gardner et al. 2019; the rest is this package's own.
    """
    return torch.stack([_dominant_light(one) for one in luminance(latlong_hdr.double())[..., 0]]).float()


def _dominant_light(intensity: Float[Tensor, "h w"]) -> Float[Tensor, "3"]:
    if not bool((intensity > 0).any()):
        raise ImageError("latlong", "holds no light")
    directions = latlong_directions(intensity.shape[0], device=intensity.device).double()
    energy = intensity * latlong_solid_angles(intensity.shape[0], device=intensity.device)
    axis = _brightest_cap(intensity)
    for _ in range(_RECENTRINGS):
        axis = _centroid(energy, directions, _cap(directions, axis))
    cap = _cap(directions, axis)
    return _centroid(energy, directions, cap & (intensity >= LIGHT_EDGE * intensity[cap].max()))


def _cap(directions: Float[Tensor, "*n 3"], axis: Float[Tensor, "3"]) -> Bool[Tensor, "*n"]:
    """Which directions lie in the cap about an axis; the nearest one at least."""
    cosines = directions @ axis
    return cosines >= min(math.cos(math.radians(LIGHT_RADIUS)), float(cosines.max()))


def _centroid(
    energy: Float[Tensor, "h w"], directions: Float[Tensor, "h w 3"], region: Bool[Tensor, "h w"]
) -> Float[Tensor, "3"]:
    return F.normalize((energy[region][:, None] * directions[region]).sum(0), dim=0)


def _brightest_cap(intensity: Float[Tensor, "h w"]) -> Float[Tensor, "3"]:
    """Axis of the cap that holds the most light, among the pixel centres of the map reduced for the search."""
    height = min(intensity.shape[0], _SEARCH_ROWS)
    reduced = F.adaptive_avg_pool2d(intensity[None], (height, 2 * height))[0]
    directions = latlong_directions(height, device=intensity.device).double().reshape(-1, 3)
    energy = (reduced * latlong_solid_angles(height, device=intensity.device)).flatten()
    within = directions @ directions.T >= math.cos(math.radians(LIGHT_RADIUS))
    return directions[int((within.double() @ energy).argmax())]


def light_direction_error(estimate_hdr: Latlong, truth_hdr: Float[Tensor, "b rows columns c"]) -> Float[Tensor, "b"]:
    """Angle in degrees between the strongest lights of two maps, which may differ in size.

    Raises:
        ImageError: a map without light.

    Source: Liang et al. 2025 compare the strongest lights so; what the strongest light is, see `dominant_light`.
    """
    return torch.rad2deg(rgb_angles(dominant_light(estimate_hdr), dominant_light(truth_hdr)))


def sh_band_errors(
    estimate_hdr: Latlong, truth_hdr: Float[Tensor, "b rows columns c"], band: int = 4
) -> Float[Tensor, "b l"]:
    """Difference of two maps in each band of spherical harmonics, relative to the truth's band 0.

    The norm goes over a band's orders and the channels, ‖e_l - t_l‖ / ‖t_0‖, and does not change when both maps are
    turned. Divided by the truth's mean light rather than by the band itself, an empty band has an error too.

    Args:
        estimate_hdr: (B, H, 2H, C) linear radiance.
        truth_hdr: (B, H', 2H', C) linear radiance.
        band: highest band.

    Returns:
        (B, band + 1), float64.

    Raises:
        ImageError: a truth without light.
        OptionError: a band that `sh_project` does not take.
    """
    truth = sh_project(truth_hdr, band)
    ambient = torch.linalg.norm(truth[:, 0], dim=-1)
    if bool((ambient <= 0).any()):
        raise ImageError("truth", "holds no light")
    squares = (sh_project(estimate_hdr, band) - truth).square().sum(-1)
    bands = [squares[:, l * l : (l + 1) ** 2].sum(-1).sqrt() for l in range(band + 1)]  # noqa: E741
    return torch.stack(bands, dim=-1) / ambient[:, None]
