"""`lightprobe spheres MAP -o OUT.png`: spheres in the light of a map."""

from __future__ import annotations

import argparse

from ..errors import OptionError

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `spheres`."""
    parser.add_argument("map", metavar="MAP", help="environment map: EXR or Radiance .hdr")
    parser.add_argument("-o", "--output", metavar="OUT.png", required=True, help="picture to write")
    parser.add_argument("--size", type=int, default=256, help="side of a sphere's picture in pixels (default: 256)")
    parser.add_argument("--albedo", type=float, default=0.8, help="of the diffuse sphere, 0 to 1 (default: 0.8)")


def run(args: argparse.Namespace) -> None:
    """Render and write.

    Raises:
        ProbeError: a map that cannot be read, an option out of range, or a picture that cannot be written.
    """
    from ..imageio import read_envmap, require_writable, write_png
    from ..spheres import sphere_sheet

    if not 16 <= args.size <= 4096:
        raise OptionError("size", args.size, "16 to 4096 pixels")
    require_writable(args.output)
    sheet = sphere_sheet(read_envmap(args.map), size=args.size, albedo=args.albedo)
    print(write_png(args.output, sheet))
