"""A light model as a glTF 2.0 scene: KHR_lights_punctual for its lights, extras for what glTF has no word for.

A directional light of glTF shines along its node's -Z and is measured in lux: intensity times colour is the irradiance
of each channel, radiance 1 of the map taken for 1 cd/m². Axes are the map's own: +Y up, cameras look along -Z.
Ambient light, harmonics and the radius of a light are extras under `lightprobe`.

Sources: Khronos, glTF 2.0 specification; KHR_lights_punctual.
"""

from __future__ import annotations

import math
from typing import Any, Final

from .. import __version__
from .describe import describe_harmonics, describe_light
from .model import Light, LightModel

__all__ = ["EXTENSION", "gltf_scene"]

EXTENSION: Final = "KHR_lights_punctual"


def gltf_scene(model: LightModel) -> dict[str, Any]:
    """The document, as its JSON holds it."""
    scene: dict[str, Any] = {
        "name": "light",
        "extras": {
            "lightprobe": {
                "model": model.name,
                "parameters": model.parameters,
                "spherical_harmonics": describe_harmonics(model),
                "lights": [describe_light(light) for light in model.lights],
            }
        },
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"ComfyUI-LightProbe {__version__}"},
        "scene": 0,
        "scenes": [scene],
    }
    if model.lights:  # glTF has no empty lists
        scene["nodes"] = list(range(len(model.lights)))
        document["extensionsUsed"] = [EXTENSION]
        document["extensions"] = {EXTENSION: {"lights": [_light(*item) for item in enumerate(model.lights)]}}
        document["nodes"] = [_node(*item) for item in enumerate(model.lights)]
    return document


def _light(index: int, light: Light) -> dict[str, Any]:
    brightest = max(light.irradiance)
    facts: dict[str, Any] = {
        "name": f"light {index + 1}",
        "type": "directional",
        "color": [channel / brightest for channel in light.irradiance],
        "intensity": brightest,
    }
    if light.angular_radius is not None:
        facts["extras"] = {"lightprobe": {"angular_radius_deg": light.angular_radius}}
    return facts


def _node(index: int, light: Light) -> dict[str, Any]:
    return {
        "name": f"light {index + 1}",
        "rotation": list(_quaternion(light.direction)),
        "extensions": {EXTENSION: {"light": index}},
    }


def _quaternion(direction: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """The shortest turn from +Z to a direction: the node's -Z then points the way the light travels."""
    x, y, z = direction
    length = math.hypot(x, y, 1 + z)
    if length < 1e-9:
        return 0.0, 1.0, 0.0, 0.0  # half a turn; any axis across does
    return -y / length, x / length, 0.0, (1 + z) / length
