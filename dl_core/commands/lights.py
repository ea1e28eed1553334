"""`lightprobe lights MAP`: the smallest light whose spheres are like the map's."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..lights.choose import Decision
    from ..lights.model import Light

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `lights`."""
    add = parser.add_argument
    add("map", metavar="MAP", help="environment map: EXR or Radiance .hdr")
    add(
        "--tolerance",
        type=float,
        default=0.05,
        help="accepted error of the worst sphere, relative to the full map's (default: 0.05)",
    )
    add(
        "--materials",
        default="diffuse,matte,mirror",
        metavar="NAME,NAME",
        help="spheres that have to come out alike (default: diffuse,matte,mirror)",
    )
    add("--export", metavar="FILE", type=Path, help="write the light to FILE: .json, .gltf or .usda")
    add("--json", action="store_true", help="print it as JSON")


def run(args: argparse.Namespace) -> None:
    """Choose, write and print.

    Raises:
        ProbeError: a map that cannot be read, an option that is not accepted, or a file that cannot be written.
    """
    from ..imageio import read_envmap
    from ..lights.choose import choose_light
    from ..lights.describe import describe
    from ..lights.export import check_export, write_lights
    from ..lights.shading import check_materials

    materials = check_materials([name.strip() for name in args.materials.split(",") if name.strip()])
    if args.export is not None:
        check_export(args.export)
    source = Path(args.map)
    decision = choose_light(read_envmap(source), args.tolerance, materials)
    written = [] if args.export is None else write_lights(args.export, decision, source)
    if args.json:
        print(json.dumps(describe(decision), indent=2))
        return
    print("\n".join([*_lines(decision), *map(str, written)]))


def _lines(decision: Decision) -> list[str]:
    """The candidates as a table, the chosen one marked, and its lights."""
    width = max(len(candidate.name) for candidate in decision.candidates)
    head = f"{'model':{width}}  numbers  " + "  ".join(f"{name:>7}" for name in decision.materials)
    lines = [head]
    for candidate in decision.candidates:
        errors = "  ".join(f"{candidate.errors[name]:7.2%}" for name in decision.materials)
        mark = " <- chosen" if candidate is decision.chosen else ""
        lines.append(f"{candidate.name:{width}}  {candidate.parameters:7d}  {errors}{mark}")
    model = decision.chosen.model
    return lines + ([] if model is None else [_light_line(light) for light in model.lights])


def _light_line(light: Light) -> str:
    x, y, z = light.direction
    right, up = math.degrees(math.atan2(x, -z)), math.degrees(math.asin(max(-1.0, min(1.0, y))))
    disc = "" if light.angular_radius is None else f", radius {light.angular_radius:.1f} degrees"
    colour = ", ".join(f"{channel:.4g}" for channel in light.irradiance)
    return f"light {right:.1f} degrees right, {up:.1f} up{disc}: irradiance {colour}"
