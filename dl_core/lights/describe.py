"""A decision as plain data: what the command prints and what `.json` files hold."""

from __future__ import annotations

from typing import Any, Final

from jaxtyping import Float
from torch import Tensor

from .choose import LEVELS, Decision
from .model import Light, LightModel
from .search import Candidate
from .shading import COSINE_LOBE

__all__ = ["describe", "describe_harmonics", "describe_light"]

_BASIS: Final = (
    "real, orthonormal, without the Condon-Shortley phase, polar axis +Y: "
    "L1-1 multiplies sqrt(3 / (4 pi)) x, L10 the same times y, L11 the same times z"
)
_AXES: Final = "+X right of the photograph, +Y up, the camera looks along -Z"


def describe(decision: Decision) -> dict[str, Any]:
    """What was chosen, at what price and error, and what else there was; numbers, text and lists alone.

    `map_errors` are those of the chosen light as a map, whose harmonics cannot be negative.

    Keys of a light are `direction` (a unit vector), `irradiance` (RGB on a surface that faces it, radiance units x sr)
    and, of a light that is a disc, `angular_radius_deg`.
    """
    chosen = decision.chosen
    model = chosen.model
    return {
        **_summary(chosen),
        "errors": chosen.errors,
        "map_errors": decision.map_errors,
        "tolerance": decision.tolerance,
        "materials": list(decision.materials),
        "axes": _AXES,
        "lights": [] if model is None else [describe_light(light) for light in model.lights],
        "spherical_harmonics": None if model is None else describe_harmonics(model),
        "levels": {f"{level:g}": _summary(decision.cheapest(level)) for level in LEVELS},
        "candidates": [{**_summary(candidate), "errors": candidate.errors} for candidate in decision.candidates],
    }


def _summary(candidate: Candidate) -> dict[str, Any]:
    return {
        "model": candidate.name,
        "parameters": candidate.parameters,
        "relative_error": candidate.relative_error,
    }


def describe_light(light: Light) -> dict[str, Any]:
    """A light as plain data."""
    facts: dict[str, Any] = {"direction": list(light.direction), "irradiance": list(light.irradiance)}
    if light.angular_radius is not None:
        facts["angular_radius_deg"] = light.angular_radius
    return facts


def describe_harmonics(model: LightModel) -> dict[str, Any]:
    """Coefficients by both conventions that are in use, in one order.

    `radiance` describes the light itself; `irradiance` what a diffuse surface receives, the cosine lobe multiplied in,
    so that irradiance in direction n is their sum times the basis at n. `negative_share` is how much light a map of
    them holds too much, because it cannot be negative.
    """
    bands = _bands(len(model.coefficients))
    received = model.coefficients * model.coefficients.new_tensor([COSINE_LOBE[band] for band, _ in bands])[:, None]
    return {
        "basis": _BASIS,
        "order": [f"L{band}{order}" for band, order in bands],
        "radiance": _rows(model.coefficients),
        "irradiance": _rows(received),
        "negative_share": model.negative_share(),
    }


def _bands(count: int) -> list[tuple[int, int]]:
    """Band and order of each of so many coefficients."""
    pairs = [(band, order) for band in range(len(COSINE_LOBE)) for order in range(-band, band + 1)]
    return pairs[:count]


def _rows(values: Float[Tensor, "k 3"]) -> list[list[float]]:
    return [[float(value) for value in row] for row in values]
