"""Candidates with a growing number of lights: each light is taken out where it leaves the smallest error.

Rendering is the cost, so what was rendered is kept: every candidate's spheres are sums of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ..harmonics import sh_project
from ..shapes import Latlong
from .extract import Extraction, offer_lights
from .model import Light, LightModel
from .shading import BAND, ROWS, Spheres, errors_of, shade_harmonics, shade_lights

__all__ = ["FULL_MAP", "Candidate", "Taken"]

FULL_MAP: Final = "full map"
_ENOUGH: Final = 0.98
"""Share of the largest gain (in squared error) with which a smaller cap is good enough: the farther off a light's
surroundings are looked at, the less well it is known what is behind it."""


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
class Taken:
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
    def nothing(cls, latlong: Latlong, truth: Spheres) -> Taken:
        """A map as it is."""
        none = {name: sphere[:0] for name, sphere in truth.items()}
        return cls(truth, latlong, sh_project(latlong, BAND)[0], (), none, none)

    @property
    def names(self) -> tuple[str, ...]:
        """The materials."""
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

    def further(self) -> Taken | None:
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

    def _with(self, offer: Extraction, lit: Spheres) -> Taken:
        plain = shade_lights([replace(offer.light, angular_radius=None)], self.names)
        rest = offer.rest(self.rest)
        return Taken(
            self.truth,
            rest,
            sh_project(rest, BAND)[0],
            (*self.lights, offer.light),
            {name: torch.cat((self.shaded[name], lit[name])) for name in self.names},
            {name: torch.cat((self.plain[name], plain[name])) for name in self.names},
        )

    def model(self) -> LightModel:
        """All lights with their radii, and the harmonics of the rest."""
        return LightModel(self.coefficients, self.lights)
