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
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import ImageError, OptionError
from ..geometry import require_latlong
from ..harmonics import sh_project
from ..resize import resize_latlong
from ..shapes import Latlong
from ..spheres import MATERIALS
from .extract import Extraction, offer_lights
from .model import CHANNELS, Light, LightModel
from .shading import BAND, ROWS, Spheres, check_materials, errors_of, shade_harmonics, shade_lights, shade_map

__all__ = ["FULL_MAP", "LEVELS", "MOST_LIGHTS", "Candidate", "Decision", "choose_light", "extract_lights"]

LEVELS: Final = (0.01, 0.05)
"""Tolerances that are always reported."""
MOST_LIGHTS: Final = 8
_ENOUGH: Final = 0.98
"""Share of the largest gain (in squared error) with which a smaller cap is good enough: the farther off a light's
surroundings are looked at, the less well it is known what is behind it."""
FULL_MAP: Final = "full map"


@dataclass(frozen=True)
class Candidate:
    """One way to say a map's light.

    Attributes:
        model: harmonics and lights; None for the map itself.
        parameters: its price, in numbers.
        errors: relative error of each material's sphere.
    """

    model: LightModel | None
    parameters: int
    errors: dict[str, float]

    @property
    def name(self) -> str:
        """What it is made of."""
        return FULL_MAP if self.model is None else self.model.name

    @property
    def relative_error(self) -> float:
        """On the material it does worst on."""
        return max(self.errors.values())


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
        The candidates, up to the cheapest within the tolerance and within all of `LEVELS`, and the map itself.

    Raises:
        OptionError: a tolerance, materials or a number of lights out of range, or a map that is not 2:1.
        ImageError: several maps, or one without light.
    """
    if not 0 < tolerance < 1:
        raise OptionError("tolerance", tolerance, "above 0, below 1; 0.05 is 5%")
    if not 0 <= most_lights <= 32:
        raise OptionError("most_lights", most_lights, "0 to 32")
    names = check_materials(materials)
    latlong = _reduced(latlong_hdr)
    truth = shade_map(latlong, names)
    target = min(tolerance, *LEVELS)
    found = [Candidate(None, math.prod(latlong_hdr.shape[1:]), dict.fromkeys(names, 0.0))]
    for candidates in _tried(latlong, truth, most_lights):
        found += candidates
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
        ImageError: several maps, or one without light.
    """
    names = check_materials(materials)
    latlong = _reduced(latlong_hdr)
    taken = _Taken.nothing(latlong, shade_map(latlong, names))
    for _ in range(count):
        further = taken.further()
        if further is None:
            break
        taken = further
    return LightModel(taken.coefficients, taken.lights)


def _plain_price(lights: int) -> int:
    """Of harmonics and so many directional lights."""
    return CHANNELS * (BAND + 1) ** 2 + lights * Light((0.0, 1.0, 0.0), (1.0, 1.0, 1.0)).parameters


def _reduced(latlong_hdr: Latlong) -> Float[Tensor, "b rows columns c"]:
    require_latlong(latlong_hdr)
    if latlong_hdr.shape[0] != 1:
        raise ImageError("latlong", f"holds {latlong_hdr.shape[0]} maps; one is accepted")
    if not bool((latlong_hdr > 0).any()):
        raise ImageError("latlong", "holds no light")
    return resize_latlong(latlong_hdr.float(), ROWS)


# --- candidates --------------------------------------------------------------------------------------------------


def _tried(latlong: Latlong, truth: Spheres, most_lights: int) -> Iterator[list[Candidate]]:
    """Candidates in groups of a number of lights: none, one, and so on."""
    taken = _Taken.nothing(latlong, truth)
    yield taken.harmonics()
    for _ in range(most_lights):
        further = taken.further()
        if further is None:
            return
        taken = further
        yield taken.mixtures()


@dataclass(frozen=True)
class _Taken:
    """What has been taken out of a map so far.

    Attributes:
        truth: spheres under the map.
        rest: the map without the lights.
        coefficients: of the rest, (9, 3).
        lights: with their radii.
        shaded: spheres under each light, (lights, pixels, 3) by material.
        plain: the same under lights without a radius.
    """

    truth: Spheres
    rest: Latlong
    coefficients: Float[Tensor, "k 3"]
    lights: tuple[Light, ...]
    shaded: Spheres
    plain: Spheres

    @classmethod
    def nothing(cls, latlong: Latlong, truth: Spheres) -> _Taken:
        """A map as it is."""
        none = {name: sphere[:0] for name, sphere in truth.items()}
        return cls(truth, latlong, sh_project(latlong, BAND)[0], (), none, none)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.truth)

    def _sphere(self, coefficients: Float[Tensor, "n k 3"]) -> Spheres:
        """Under harmonics and all lights with their radii, signed: (n, pixels, 3) by material."""
        harmonics = shade_harmonics(coefficients, self.names)
        return {name: harmonics[name] + self.shaded[name].sum(0) for name in self.names}

    def _candidates(self, models: Sequence[LightModel], spheres: Spheres) -> list[Candidate]:
        errors = errors_of(spheres, self.truth)
        return [
            Candidate(model, model.parameters, {name: float(errors[name][index]) for name in self.names})
            for index, model in enumerate(models)
        ]

    def harmonics(self) -> list[Candidate]:
        """The candidates without lights."""
        models = [LightModel(self.coefficients[: (band + 1) ** 2]) for band in range(BAND + 1)]
        return [
            candidate
            for model in models
            for candidate in self._candidates([model], shade_harmonics(model.coefficients[None], self.names))
        ]

    def mixtures(self) -> list[Candidate]:
        """Candidates with 0, 1, 2 and so on of the lights' radii, those first that are missed most."""
        whole = self._sphere(self.coefficients[None])
        missed = {name: self.plain[name] - self.shaded[name] for name in self.names}
        alone = errors_of({name: whole[name] + missed[name] for name in self.names}, self.truth)
        order = torch.stack(list(alone.values())).amax(0).argsort(descending=True).tolist()
        # The last row is the whole; each row above it does without one more radius, the most missed last.
        none = {name: torch.zeros_like(sphere) for name, sphere in whole.items()}
        steps = {name: torch.cat((none[name], missed[name][order[::-1]].cumsum(0))).flip(0) for name in self.names}
        models = [
            LightModel(self.coefficients, tuple(self._light(index, order[:count]) for index in range(len(order))))
            for count in range(len(order) + 1)
        ]
        return self._candidates(models, {name: whole[name] + steps[name] for name in self.names})

    def _light(self, index: int, extended: Sequence[int]) -> Light:
        light = self.lights[index]
        return light if index in extended else replace(light, angular_radius=None)

    def further(self) -> _Taken | None:
        """One more light taken out, at the radius that leaves the smallest error; None if none makes it smaller."""
        offers = offer_lights(self.rest, self.coefficients)
        if not offers:
            return None
        before = self._worst(self._sphere(self.coefficients[None]))
        lit = shade_lights([offer.light for offer in offers], self.names)
        left = torch.stack([self.coefficients - offer.harmonics(ROWS) for offer in offers])
        spheres = self._sphere(left)
        worst = self._worst({name: spheres[name] + lit[name] for name in self.names})
        gains = before.square() - worst.square()
        if float(gains.max()) <= 0:
            return None
        best = int(torch.nonzero(gains >= _ENOUGH * gains.max())[0])  # the smallest caps come first
        return self._with(offers[best], {name: lit[name][best : best + 1] for name in self.names})

    def _worst(self, spheres: Spheres) -> Float[Tensor, "n"]:
        return torch.stack(list(errors_of(spheres, self.truth).values())).amax(0)

    def _with(self, offer: Extraction, lit: Spheres) -> _Taken:
        plain = shade_lights([replace(offer.light, angular_radius=None)], self.names)
        rest = offer.rest(self.rest)
        return _Taken(
            self.truth,
            rest,
            sh_project(rest, BAND)[0],
            (*self.lights, offer.light),
            {name: torch.cat((self.shaded[name], lit[name])) for name in self.names},
            {name: torch.cat((self.plain[name], plain[name])) for name in self.names},
        )
