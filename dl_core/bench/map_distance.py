"""How far two environment maps are apart, in stops: one number that a light, a shade and a colour all count in."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from ..confidence import FLOOR
from ..geometry import latlong_solid_angles
from ..misplaced import ROWS
from ..resize import resize_latlong
from ..shapes import Latlong

__all__ = ["log_error", "map_distance"]


def log_error(estimate_hdr: Latlong, truth_hdr: Latlong) -> Float[Tensor, "h w"]:
    """Stops between two maps of one size and one scale, by direction: the mean over the channels."""
    return ((estimate_hdr + FLOOR) / (truth_hdr + FLOOR)).log2().abs().mean(dim=-1)[0]


def map_distance(first_hdr: Latlong, second_hdr: Float[Tensor, "b k l c"]) -> float:
    """Stops between two maps of one scale, the mean over directions and channels of maps of `ROWS` rows.

    Args:
        first_hdr: (1, H, 2H, 3) linear radiance, white at EV 0 being 1.
        second_hdr: (1, K, 2K, 3) the same, of any size.
    """
    error = log_error(resize_latlong(first_hdr, ROWS), resize_latlong(second_hdr, ROWS))
    shares = latlong_solid_angles(ROWS).to(error).expand_as(error)
    return float((error * shares).sum() / shares.sum())
