"""Distances between two lightings: energy, irradiance, si-RMSE, angular error.

Irradiance is compared rather than radiance because it is what a lit diffuse surface shows: a light map may blur a
lamp and still be right, or look right and miss the sun.

Sources: Grosse et al., Ground truth dataset and baseline evaluations for intrinsic image algorithms (ICCV 2009), for
the scale-invariant error; LeGendre et al., DeepLight (CVPR 2019), for the angular error; Ramamoorthi and Hanrahan,
An efficient representation for irradiance environment maps (SIGGRAPH 2001), Eq. 1, for irradiance.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import ImageError
from .geometry import latlong_directions, latlong_energy, latlong_solid_angles
from .shapes import Directions, Latlong

__all__ = ["angular_error", "energy_kept", "irradiance", "si_rmse", "spread_directions"]


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
    return (normals.to(light) @ directions.reshape(-1, 3).T).clamp(min=0) @ light


def energy_kept(estimate_hdr: Latlong, truth_hdr: Latlong) -> float:
    """Energy of an estimate as a share of the truth's: radiance integrated over the sphere, channels summed."""
    truth = float(latlong_energy(truth_hdr).sum())
    if truth <= 0:
        raise ImageError("truth", "holds no light")
    return float(latlong_energy(estimate_hdr).sum()) / truth


def si_rmse(estimate: Float[Tensor, "*n c"], truth: Float[Tensor, "*n c"]) -> float:
    """Scale-invariant RMSE relative to the truth's mean: min over a of ‖a·estimate - truth‖ / (√N · mean truth).

    One scale serves all channels, and the mean goes over items and channels alike. Divided by the mean, scenes of
    different brightness weigh the same; a published figure without that division is not comparable.

    Args:
        estimate: linear values.
        truth: linear values of the same shape, not all zero.

    Source: Grosse et al. 2009, Sec. 4 (one window over the whole signal).
    """
    e, t = estimate.double(), truth.double()
    mean = float(t.mean())
    if mean <= 0:
        raise ImageError("truth", "holds no light")
    power = float((e * e).sum())
    scale = float((e * t).sum()) / power if power > 0 else 0.0
    return math.sqrt(float((scale * e - t).square().mean())) / mean


def angular_error(estimate: Float[Tensor, "*n 3"], truth: Float[Tensor, "*n 3"]) -> float:
    """Mean angle between RGB vectors in degrees: an error of colour that does not see brightness.

    Pairs of which one is black have no angle and are left out; 0 if all are.

    Source: LeGendre et al. 2019, Sec. 5 (angular error between RGB vectors).
    """
    e, t = estimate.double(), truth.double()
    # arctan2 of cross and dot: arccos loses half of its digits at small angles.
    angle = torch.atan2(torch.linalg.norm(torch.linalg.cross(e, t), dim=-1), (e * t).sum(-1))
    lit = (torch.linalg.norm(e, dim=-1) > 0) & (torch.linalg.norm(t, dim=-1) > 0)
    return float(torch.rad2deg(angle[lit]).mean()) if bool(lit.any()) else 0.0
