"""`lightprobe inspect FILE`: what an environment map says about itself, and whether it is of a good mirror ball.

The picture of a ball is judged likewise.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import OptionError

if TYPE_CHECKING:
    from ..quality.inspection import Inspection
    from ..shapes import Latlong

__all__ = ["add_arguments", "describe", "inspect", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `inspect`."""
    parser.add_argument("file", metavar="FILE", help="environment map (EXR, Radiance .hdr), or the picture of a ball")
    parser.add_argument("--ball", metavar="X,Y,DIAMETER", help="the ball in a picture of more than it, in pixels")
    parser.add_argument("--json", action="store_true", help="print it as JSON")


def run(args: argparse.Namespace) -> None:
    """Print the description.

    Raises:
        ImageError: a file that is neither a map nor the picture of a ball.
        OptionError: a place of the ball that is none, or one for a map.
    """
    facts, found = inspect(Path(args.file), args.ball)
    if args.json:
        print(json.dumps(facts | found.document(), indent=2))
        return
    width = max(len(name) for name in facts)
    for name, value in facts.items():
        print(f"{name:{width}}  {_text(value)}")
    print(f"\nscore {found.score:.2f} of 1 as a mirror ball")
    for check in found.checks:
        print(check.line())
    for note in found.notes:
        print(f"      {note}")


def inspect(path: Path, ball: str | None = None) -> tuple[dict[str, Any], Inspection]:
    """Facts about a file by name, and what was found of its ball.

    Args:
        path: of the file.
        ball: `X,Y,DIAMETER` of the ball in a picture of more than it.

    Raises:
        ImageError: a file that is neither a map nor the picture of a ball.
        OptionError: a place of the ball that is none, or one for a map.
    """
    from ..imageio import is_envmap, read_envmap, read_photograph
    from ..quality.inspection import inspect_map, inspect_picture, parse_ball

    if is_envmap(path):
        if ball is not None:
            raise OptionError("--ball", ball, "nothing with an environment map")
        return describe(path), inspect_map(read_envmap(path))
    picture = read_photograph(path)
    height, width = picture.shape[1:3]
    place = None if ball is None else parse_ball(ball, width, height)
    return {"format": "picture", "size": f"{width} x {height}"}, inspect_picture(picture, place)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def describe(path: Path) -> dict[str, Any]:
    """Header, metadata and light of a map, by name.

    Energy is radiance integrated over the sphere, for each channel (radiance units x sr); a uniform map of radiance 1
    holds 4π. The brightest direction is that of the pixel of highest luminance, in degrees right of straight ahead
    and above the horizon.

    Raises:
        ImageError: a file that is no environment map.
    """
    from ..imageio import is_exr, read_envmap

    latlong = read_envmap(path)
    header = _exr_facts(path) if is_exr(path) else {"format": "Radiance RGBE"}
    return header | {"size": f"{latlong.shape[2]} x {latlong.shape[1]}"} | _light(latlong)


def _exr_facts(path: Path) -> dict[str, Any]:
    from ..imageio import exr_channels, read_exr_header

    attributes = read_exr_header(path)
    facts: dict[str, Any] = {
        "format": "OpenEXR",
        "channels": [f"{name} {kind}" for name, kind in exr_channels(path).items()],
        "compression": attributes["compression"].name.removesuffix("_COMPRESSION"),
    }
    if "envmap" in attributes:
        facts["envmap"] = attributes["envmap"].name.removeprefix("ENVMAP_").lower()
    if "chromaticities" in attributes:
        facts["chromaticities"] = [round(float(value), 4) for value in attributes["chromaticities"]]
    return facts | {name: value for name, value in attributes.items() if isinstance(value, str)}


def _light(latlong: Latlong) -> dict[str, Any]:
    from ..exposure import luminance
    from ..geometry import latlong_directions, latlong_energy

    energy = latlong_energy(latlong)[0].double()
    bright = luminance(latlong)[0, :, :, 0]
    x, y, z = latlong_directions(latlong.shape[1]).reshape(-1, 3)[int(bright.argmax())].tolist()
    return {
        "lowest": float(latlong.min()),
        "highest": float(latlong.max()),
        "energy": energy.tolist(),
        "mean radiance": (energy / (4 * math.pi)).tolist(),
        "brightest, degrees right and up": [math.degrees(math.atan2(x, -z)), math.degrees(math.asin(y))],
    }
