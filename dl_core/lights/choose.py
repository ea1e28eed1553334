"""The cheapest light that does: candidates by price, their errors, and the choice at any tolerance.

Candidates, cheapest first: ambient light (3 numbers), harmonics to band 1 (12) and band 2 (27), those and n lights, of
which k have a radius (27 + 5 n + k), and the map itself. Lights are taken out one after the other, each at the radius
of its cap that leaves the smallest error; the harmonics are those of what is left. Of n lights those get a radius
first that go wrong most without one.

The error of a candidate is that of the material it does worst on (`shading` says what it is).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import ImageError, OptionError
from ..geometry import require_latlong
from ..resize import resize_latlong
from ..shapes import Latlong
from ..spheres import MATERIALS
from .model import CHANNELS, Light, LightModel
from .search import Candidate, Taken
from .shading import BAND, ROWS, Spheres, check_materials, errors_of, shade_map

__all__ = ["LEVELS", "MOST_LIGHTS", "Decision", "choose_light", "extract_lights"]

LEVELS: Final = (0.01, 0.05)
"""Tolerances that are always reported."""
MOST_LIGHTS: Final = 8


@dataclass(frozen=True)
class Decision:
    """Candidates for a map, and the one chosen.

    Attributes:
        tolerance: relative error that was accepted.
        materials: of the spheres.
        candidates: by price, those of one price by error; the last is the map itself.
        map_errors: of the chosen one as a map, `LightModel.radiance_map`, which cannot be negative.
    """

    tolerance: float
    materials: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    map_errors: dict[str, float]

    @property
    def chosen(self) -> Candidate:
        """The cheapest within the tolerance asked for."""
        return self.cheapest(self.tolerance)

    def cheapest(self, tolerance: float) -> Candidate:
        """The cheapest candidate within a tolerance, no smaller than the smallest the decision was made for."""
        return _cheapest(self.candidates, tolerance)


def _cheapest(candidates: Sequence[Candidate], tolerance: float) -> Candidate:
    return next(candidate for candidate in candidates if candidate.relative_error <= tolerance)


def choose_light(
    latlong_hdr: Latlong,
    tolerance: float = 0.05,
    materials: Sequence[str] = tuple(MATERIALS),
    *,
    most_lights: int = MOST_LIGHTS,
) -> Decision:
    """Find the cheapest light whose spheres are like the map's.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance, 0 or above. It is reduced to 128 rows, which is where spheres are
            compared: what is smaller than 1.4 degrees counts as that wide.
        tolerance: accepted relative error of the worst sphere, above 0, below 1.
        materials: of the spheres, names of `spheres.MATERIALS`.
        most_lights: that are tried, 0 to 32.

    Returns:
        The candidates cheaper than the map, up to the cheapest within the tolerance and within all of `LEVELS`, and
        the map itself.

    Raises:
        OptionError: a tolerance, materials or a number of lights out of range, or a map that is not 2:1.
        ImageError: several maps, one without light, or values that are no radiance.
    """
    if not 0 < tolerance < 1:
        raise OptionError("tolerance", tolerance, "above 0, below 1; 0.05 is 5%")
    if not 0 <= most_lights <= 32:
        raise OptionError("most_lights", most_lights, "0 to 32")
    names = check_materials(materials)
    latlong = _reduced(latlong_hdr)
    truth = shade_map(latlong, names)
    target = min(tolerance, *LEVELS)
    full = Candidate(None, math.prod(latlong_hdr.shape[1:]), dict.fromkeys(names, 0.0))
    found = [full]
    for candidates in _tried(latlong, truth, most_lights):
        found += [candidate for candidate in candidates if candidate.parameters < full.parameters]
        enough = min(candidate.parameters for candidate in found if candidate.relative_error <= target)
        lights = max(len(candidate.model.lights) for candidate in candidates if candidate.model)
        if enough <= _plain_price(lights + 1):
            break
    found.sort(key=lambda one: (one.parameters, one.relative_error))
    return Decision(tolerance, names, tuple(found), _map_errors(_cheapest(found, tolerance), truth))


def _map_errors(candidate: Candidate, truth: Spheres) -> dict[str, float]:
    if candidate.model is None:
        return candidate.errors
    spheres = shade_map(candidate.model.radiance_map(ROWS), tuple(truth))
    return {name: float(error) for name, error in errors_of(spheres, truth).items()}


def extract_lights(latlong_hdr: Latlong, count: int, materials: Sequence[str] = tuple(MATERIALS)) -> LightModel:
    """The strongest lights of a map, each with a radius, and the harmonics of what is left.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance, 0 or above.
        count: of lights, at most; fewer where nothing more stands out.
        materials: whose spheres decide how much of a light's surroundings belongs to it.

    Raises:
        OptionError: unknown materials, or a map that is not 2:1.
        ImageError: several maps, one without light, or values that are no radiance.
    """
    names = check_materials(materials)
    latlong = _reduced(latlong_hdr)
    taken = Taken.nothing(latlong, shade_map(latlong, names))
    for _ in range(count):
        further = taken.further()
        if further is None:
            break
        taken = further
    return taken.model()


def _plain_price(lights: int) -> int:
    """Of harmonics and so many directional lights."""
    return CHANNELS * (BAND + 1) ** 2 + lights * Light((0.0, 1.0, 0.0), (1.0, 1.0, 1.0)).parameters


def _reduced(latlong_hdr: Latlong) -> Float[Tensor, "b rows columns c"]:
    require_latlong(latlong_hdr)
    if latlong_hdr.shape[0] != 1:
        raise ImageError("latlong", f"holds {latlong_hdr.shape[0]} maps; one is accepted")
    if not bool((torch.isfinite(latlong_hdr) & (latlong_hdr >= 0)).all()):
        raise ImageError("latlong", "holds NaN, infinite or negative values, which are no radiance")
    if not bool((latlong_hdr > 0).any()):
        raise ImageError("latlong", "holds no light")
    return resize_latlong(latlong_hdr.float().cpu(), ROWS)


# --- candidates --------------------------------------------------------------------------------------------------


def _tried(latlong: Latlong, truth: Spheres, most_lights: int) -> Iterator[list[Candidate]]:
    """Candidates in groups of a number of lights: none, one, and so on."""
    taken = Taken.nothing(latlong, truth)
    yield taken.harmonics()
    for _ in range(most_lights):
        further = taken.further()
        if further is None:
            return
        taken = further
        yield taken.mixtures()
