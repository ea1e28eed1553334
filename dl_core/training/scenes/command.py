"""`lightprobe train scenes`: procedural HDR panoramas into a folder; those that are there already are kept."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...progress_lines import say

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--out", type=Path, required=True, help="folder for the maps")
    add("--drawn", type=int, default=240, help="skies and rooms in closed form (default: 240)")
    add("--rendered", type=int, default=0, help="streets and rooms path traced by Mitsuba (default: 0)")
    add("--rows", type=int, default=256, help="rows of a map, half its width (default: 256)")


def run(args: argparse.Namespace) -> None:
    """Draw what is missing.

    Raises:
        OptionError: an option out of range, or renders without Mitsuba.
        OutputError: the folder cannot be written.
    """
    from ...errors import OptionError
    from ..panoramas import KINDS, draw_scenes

    for name in ("drawn", "rendered"):
        if getattr(args, name) < 0:
            raise OptionError(f"--{name}", getattr(args, name), "0 or more")
    if not 16 <= args.rows <= 4096:
        raise OptionError("--rows", args.rows, "16 to 4096")
    for kind in KINDS:
        draw_scenes(args.out, kind, getattr(args, kind), args.rows, report=say)
