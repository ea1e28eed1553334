"""`lightprobe train data`: pairs to train an exposure LoRA on, from any folder of HDR panoramas, as shards.

A run that was killed goes on when the same command is given again. Only the options are here, so that help comes
without loading torch.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...progress_lines import say

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    folder: dict[str, Any] = {"type": Path, "required": True, "metavar": "DIR"}
    add("--panoramas", **folder, action="append", help="folder of .exr or .hdr maps; may be repeated")
    add("--split", help="of the folders' manifest.json (default: training where there is one, all files elsewhere)")
    add("--out", **folder, help="folder for the shards")
    add("--count", type=int, default=2000, help="pairs (default: 2000)")
    add("--canvas", type=int, default=1024, help="side of the pictures, pixels (default: 1024)")
    add("--diameter", type=int, default=256, help="of the ball, pixels (default: 256)")
    add("--fov", type=float, default=60.0, help="of the photograph across its longer side, degrees (default: 60)")
    add("--elevation", type=float, default=12.0, help="spread of the camera's elevation, degrees (default: 12)")
    add("--roll", type=float, default=2.0, help="spread of the camera's roll, degrees (default: 2)")
    share: dict[str, Any] = {"type": float, "metavar": "SHARE"}
    elsewhere = "others are elsewhere, 0.6 to 1.1 times as large"
    add("--central", **share, default=1.0, help=f"of balls in the middle; {elsewhere} (default: 1)")
    add("--ev-min", type=float, default=-5.0, help="darkest exposure of a ball; they are even down to it (default: -5)")
    add("--augment", action="store_true", help="mirror half of the maps, and vary exposure and white balance")
    add("--seed", type=int, default=1, help="of the whole set (default: 1)")
    add("--shard-size", type=int, default=200, help="pairs of a shard (default: 200)")
    add("--validation", **share, default=0.0, help="of maps and pairs held out, in shards of their own (default: 0)")


def run(args: argparse.Namespace) -> None:
    """Make the pairs that are missing.

    Raises:
        OptionError: an option out of range, no panoramas, or a folder that holds other pairs.
        OutputError: a shard cannot be written.
    """
    from .pair_data import DataOptions, make_pairs
    from .pair_sampler import PairOptions

    names = PairOptions.__dataclass_fields__
    options = PairOptions(**{name: getattr(args, name) for name in names})
    data = DataOptions(args.count, args.shard_size, args.validation)
    print(f"wrote {make_pairs(args.panoramas, args.split, args.out, options, data, say)}")
