"""Reflection by rough surfaces as Blender's Principled BSDF models it, in closed form and by quadrature.

A rough surface is made of mirrors whose normals h follow the GGX distribution (Trowbridge and Reitz), with α the
square of the roughness; they hide each other by Smith's factor for both directions at once:

    D(h) = α² / (π ((n·h)² (α² - 1) + 1)²),   Λ(w) = (√(1 + α² tan² θ_w) - 1) / 2,
    f(v, l) = F(v·h) D(h) / (4 (n·v) (n·l) (1 + Λ(v) + Λ(l))).

That counts light reflected once. E(v), what it reflects of uniform light if F = 1, falls short of 1 by the light that
meets a second mirror. Cycles gives it back by scaling f for each view: 1 + Fₘ (1 - E) / E, where
Fₘ = F̄ Ē / (1 - F̄ (1 - Ē)), with Ē and F̄ the cosine-weighted means of E and F. The result is not reciprocal, and
reflects all light if F = 1.

Metal: F is Schlick's, from the base colour at right angles to white at grazing (an F82 tint of white changes nothing).
Not metal: F is the Fresnel equations' for the index of refraction; below lies Lambert's surface of the base colour,
dimmed by what the coat reflects from the viewer's side: F₀ + (1 - F₀) s(v), where s is the mean over the mirrors seen
from v of (F - F₀) / (1 - F₀), those that reflect below the surface counting 0. Only the view dims it: the light is not
dimmed a second time on its way in.

Sources: Walter, Marschner, Li and Torrance, Microfacet models for refraction through rough surfaces (EGSR 2007);
Heitz, Understanding the masking-shadowing function in microfacet-based BRDFs (JCGT 2014), Eq. 99, and Sampling the
GGX distribution of visible normals (JCGT 2018); Schlick, An inexpensive BRDF model for physically-based rendering
(1994); Kulla and Conty, Revisiting physically based shading at Imageworks (SIGGRAPH courses 2017), for Fₘ and the fit
to F̄ of a dielectric; Cycles' public source, version 5, for how they are put together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError

__all__ = ["Surface", "directional_albedo", "fresnel_dielectric", "fresnel_schlick", "mean_albedo"]

_SMOOTH: Final = 0.03
"""Roughness below which a surface is taken for a mirror: a lobe 0.1 degrees wide."""
_NODES: Final = 64
"""Of the quadratures along each axis."""


# --- Fresnel -----------------------------------------------------------------------------------------------------


def fresnel_schlick(cosine: Float[Tensor, "*n"], base: float) -> Float[Tensor, "*n"]:
    """Share of light a metal reflects: `base` at right angles, all of it at grazing (Schlick 1994, Eq. 24)."""
    return base + (1 - base) * (1 - cosine).clamp(0, 1) ** 5


def fresnel_dielectric(cosine: Float[Tensor, "*n"], ior: float) -> Float[Tensor, "*n"]:
    """Share of unpolarized light reflected where the index of refraction rises by `ior` > 1 (Fresnel's equations)."""
    inside = torch.sqrt(ior**2 - 1 + cosine**2)  # ior x the cosine of the refracted ray
    across = (cosine - inside) / (cosine + inside)
    along = (ior**2 * cosine - inside) / (ior**2 * cosine + inside)
    return (across**2 + along**2) / 2


# --- GGX ---------------------------------------------------------------------------------------------------------


def _distribution(cos_h: Tensor, alpha: float) -> Tensor:
    return alpha**2 / (math.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)


def _lambda(cosine: Tensor, alpha: float) -> Tensor:
    squared = (cosine**2).clamp(min=1e-12)
    return (torch.sqrt(1 + alpha**2 * (1 - squared) / squared) - 1) / 2


@dataclass(frozen=True)
class _Mirrors:
    """Mirrors a view sees: cosines v·h and n·l of (views, nodes), and how often each is seen (nodes)."""

    between: Tensor
    light: Tensor
    share: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """Mean over the mirrors seen; those that reflect below the surface count 0."""
        return (values * (self.light > 0)) @ self.share


def _seen_mirrors(cos_view: Tensor, alpha: float) -> _Mirrors:
    """Nodes of a quadrature over the mirrors seen from each view.

    Heitz 2018: stretch the view so that the surface is a hemisphere of roughness 1, whose projection shows every mirror
    as often as it is seen. Nodes are a polar grid over that disc, denser towards its edge, where GGX's long tail is.
    """
    steps = (torch.arange(_NODES, dtype=torch.float64) + 0.5) / _NODES
    radius, turn = torch.sqrt(1 - (1 - steps) ** 2)[:, None], (2 * math.pi * steps)[None, :]
    share = ((1 - steps) * (2 / _NODES**2))[:, None].expand(-1, _NODES).flatten()
    first, second = (radius * torch.cos(turn)).flatten(), (radius * torch.sin(turn)).flatten()
    cos_v = cos_view.double()[:, None]
    sin_v = torch.sqrt(1 - cos_v**2)
    stretched = torch.hypot(alpha * sin_v, cos_v)
    sin_s, cos_s = alpha * sin_v / stretched, cos_v / stretched
    lower = (1 + cos_s) / 2
    second = (1 - lower) * torch.sqrt(1 - first**2) + lower * second
    third = torch.sqrt((1 - first**2 - second**2).clamp(min=0))
    along = -cos_s * second + sin_s * third
    up = sin_s * second + cos_s * third
    x, y = alpha * along, alpha * first
    length = torch.sqrt(x**2 + y**2 + up**2)
    cos_vh = (x * sin_v + up * cos_v) / length
    return _Mirrors(cos_vh, 2 * cos_vh * up / length - cos_v, share)


def _shown(cos_view: Tensor, cos_light: Tensor, alpha: float) -> Tensor:
    """How much of a mirror that is seen is lit as well."""
    seen, lit = _lambda(cos_view.double(), alpha)[:, None], _lambda(cos_light, alpha)
    return (1 + seen) / (1 + seen + lit)


def directional_albedo(cos_view: Float[Tensor, "n"], roughness: float) -> Float[Tensor, "n"]:
    """E: what a rough surface of F = 1 reflects once, of uniform light, towards a view; 0 to 1, float64.

    Args:
        cos_view: cosines above 0 between view and normal.
        roughness: Blender's, above 0; its square is α.
    """
    alpha = roughness**2
    mirrors = _seen_mirrors(cos_view, alpha)
    return mirrors.mean(_shown(cos_view, mirrors.light, alpha))


@lru_cache(maxsize=64)
def mean_albedo(roughness: float) -> float:
    """Ē = 2 ∫ E(μ) μ dμ, the albedo under uniform light from all sides seen from all sides."""
    cosines = (torch.arange(32, dtype=torch.float64) + 0.5) / 32
    return float((directional_albedo(cosines, roughness) * cosines).sum() / cosines.sum())


# --- surfaces ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Surface:
    """A grey surface: the inputs of Blender's Principled BSDF that the authors set, distribution Multiscatter GGX.

    Attributes:
        base: base colour, 0 to 1.
        metallic: whether it is a metal; one that is not has a Lambertian body under its coat.
        roughness: 0 (a mirror) to 1; of a metal or of the coat.
        ior: index of refraction of the coat, above 1.
    """

    base: float
    metallic: bool
    roughness: float
    ior: float = 1.5

    def __post_init__(self) -> None:
        if not 0 <= self.base <= 1:
            raise OptionError("base", self.base, "0 to 1")
        if not 0 <= self.roughness <= 1:
            raise OptionError("roughness", self.roughness, "0 to 1")
        if not self.metallic and self.roughness < _SMOOTH:
            raise OptionError("roughness", self.roughness, f"{_SMOOTH} or more, unless the surface is a metal")
        if not self.ior > 1:
            raise OptionError("ior", self.ior, "above 1")

    @property
    def is_mirror(self) -> bool:
        """Whether it reflects in one direction only."""
        return self.metallic and self.roughness < _SMOOTH

    def fresnel(self, cosine: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Share of light that one of its mirrors reflects, given the cosine between light and mirror normal."""
        return fresnel_schlick(cosine, self.base) if self.metallic else fresnel_dielectric(cosine, self.ior)

    @property
    def _mean_fresnel(self) -> float:
        """F̄ = 2 ∫ F(μ) μ dμ: exact for Schlick, within 0.1% for a dielectric (Kulla and Conty's fit)."""
        if self.metallic:
            return self.base + (1 - self.base) / 21
        return (self.ior - 1) / (4.08567 + 1.00071 * self.ior)

    def _regained(self, cos_view: Tensor) -> tuple[Tensor, Tensor]:
        """Factor on single reflection that gives back further ones, and that factor relative to F = 1's."""
        once, mean = directional_albedo(cos_view, self.roughness), mean_albedo(self.roughness)
        further = self._mean_fresnel * mean / (1 - self._mean_fresnel * (1 - mean))
        factor = 1 + further * (1 - once) / once
        return factor, factor * once

    def body(self, cos_view: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Albedo of what lies under the coat, as seen from a view, float64; 0 for a metal."""
        if self.metallic:
            return torch.zeros_like(cos_view, dtype=torch.float64)
        normal = ((self.ior - 1) / (self.ior + 1)) ** 2
        mirrors = _seen_mirrors(cos_view, self.roughness**2)
        excess = (fresnel_dielectric(mirrors.between, self.ior) - normal) / (1 - normal)
        coat = normal + (1 - normal) * mirrors.mean(excess)
        return self.base * (1 - self._regained(cos_view)[1] * coat)

    def gloss(
        self, cos_view: Float[Tensor, "n"], cos_light: Float[Tensor, "n m"], cos_between: Float[Tensor, "n m"]
    ) -> Float[Tensor, "n m"]:
        """The rough part, f(v, l) x (n·l): per steradian of light, radiance for each unit of radiance.

        Args:
            cos_view: n·v of n views, above 0.
            cos_light: n·l of m lights for each; 0 where it is not above 0.
            cos_between: v·l.

        Source: Walter et al. 2007, Eq. 20, 33 and 34, with Heitz 2014, Eq. 99, for hiding.
        """
        alpha, view = self.roughness**2, cos_view[:, None]
        length = torch.sqrt((2 + 2 * cos_between).clamp(min=1e-12))  # of v + l
        cos_vh, cos_nh = (1 + cos_between) / length, (view + cos_light) / length
        hidden = 1 + _lambda(view, alpha) + _lambda(cos_light, alpha)
        once = self.fresnel(cos_vh) * _distribution(cos_nh, alpha) / (4 * view * hidden)
        return once * self._regained(cos_view)[0].to(once)[:, None] * (cos_light > 0)

    def gloss_albedo(self, cos_view: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """The integral of `gloss` over all light: what is seen of it under uniform light, float64."""
        alpha = self.roughness**2
        mirrors = _seen_mirrors(cos_view, alpha)
        once = mirrors.mean(self.fresnel(mirrors.between) * _shown(cos_view, mirrors.light, alpha))
        return once * self._regained(cos_view)[0]

    def albedo(self, cos_view: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Radiance seen in a uniform world of radiance 1, float64 (a mirror included)."""
        if self.is_mirror:
            return self.fresnel(cos_view.double())
        return self.gloss_albedo(cos_view) + self.body(cos_view)
