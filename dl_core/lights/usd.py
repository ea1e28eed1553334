"""A light model as a USD stage in text: a DomeLight for what is all around, a DistantLight for each light.

The stage has +Y up and cameras look along -Z, as the map's axes have it. UsdLux reads a latlong texture as OpenEXR
does: its centre looks to +Z. So the dome is turned half a turn about +Y, and the texture is the map as it is.

A DistantLight shines along its own -Z. Its angle is the diameter of its disc; normalized, its intensity times its
colour is the irradiance on a surface that faces it, whatever the angle.

Harmonics have no word in UsdLux: the dome's texture shows them, raised to 0 where they are negative.

Sources: Pixar, UsdLux, "Quantities and units", DomeLight and DistantLight; OpenEXR, "Latitude-longitude map".
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from .model import Light

__all__ = ["usd_stage"]


def usd_stage(lights: Sequence[Light], *, texture: str | None = None, ambient: Sequence[float] = ()) -> str:
    """The stage as text.

    Args:
        lights: at infinity.
        texture: path of the dome's latlong map as the stage names it; None for an even dome.
        ambient: RGB radiance of an even dome.
    """
    prims = [_dome(texture, ambient), *(_distant(index, light) for index, light in enumerate(lights))]
    return _HEAD + "\n".join(prims) + "}\n"


_HEAD = """#usda 1.0
(
    defaultPrim = "Light"
    doc = "Light of a photograph. Radiance 1 of the map is taken for 1 nit."
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Light"
{
"""


def _colour(values: Sequence[float]) -> tuple[float, str]:
    """Intensity and colour whose product is given; the colour's largest channel is 1."""
    brightest = max(values)
    shares = [channel / brightest if brightest > 0 else 1.0 for channel in values]
    return brightest, f"({', '.join(_number(share) for share in shares)})"


def _number(value: float) -> str:
    return f"{value:.9g}"


def _dome(texture: str | None, ambient: Sequence[float]) -> str:
    if texture is None:
        intensity, colour = _colour(ambient)
        lines = [f"color3f inputs:color = {colour}", f"float inputs:intensity = {_number(intensity)}"]
    else:
        lines = [
            "float inputs:intensity = 1",
            f"asset inputs:texture:file = {_asset(texture)}",
            'token inputs:texture:format = "latlong"',
            "float3 xformOp:rotateXYZ = (0, 180, 0)",
            'uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]',
        ]
    return _prim("DomeLight", "Dome", lines)


def _asset(path: str) -> str:
    return f"@@@{path}@@@" if "@" in path else f"@{path}@"


def _distant(index: int, light: Light) -> str:
    intensity, colour = _colour(light.irradiance)
    rows = ", ".join(f"({', '.join(_number(value) for value in row)})" for row in _frame(light.direction))
    lines = [
        f"float inputs:angle = {_number(2 * (light.angular_radius or 0.0))}",
        f"color3f inputs:color = {colour}",
        f"float inputs:intensity = {_number(intensity)}",
        "bool inputs:normalize = 1",
        f"matrix4d xformOp:transform = ( {rows} )",
        'uniform token[] xformOpOrder = ["xformOp:transform"]',
    ]
    return _prim("DistantLight", f"Light{index + 1}", lines)


def _frame(direction: tuple[float, float, float]) -> list[tuple[float, ...]]:
    """A matrix whose rows are the axes of a frame with +Z towards a direction (USD multiplies row vectors)."""
    x, y, z = direction
    # The helper axis is one that the direction is far from.
    up = (0.0, 1.0, 0.0) if abs(y) < 0.9 else (1.0, 0.0, 0.0)
    right = _cross(up, direction)
    length = math.hypot(*right)
    right = (right[0] / length, right[1] / length, right[2] / length)
    above = _cross(direction, right)
    return [(*right, 0.0), (*above, 0.0), (x, y, z, 0.0), (0.0, 0.0, 0.0, 1.0)]


def _cross(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _prim(kind: str, name: str, lines: Sequence[str]) -> str:
    body = "".join(f"        {line}\n" for line in lines)
    return f'    def {kind} "{name}"\n    {{\n{body}    }}\n'
