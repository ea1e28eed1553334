"""`lightprobe bench protocol NAME`: the paper's protocols, on given maps or on maps painted for it."""

from __future__ import annotations

import argparse

from ...errors import OptionError
from ..pairs import add_convention
from ..report import add_output
from ..scoring import PROTOCOLS, check_protocol
from . import given_maps, painted

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    names = "; ".join(f"{name}: {entry.summary}" for name, entry in PROTOCOLS.items())
    parser.add_argument("protocol", choices=tuple(PROTOCOLS), metavar="NAME", help=names)
    given_maps.add_arguments(parser)
    painted.add_arguments(parser)
    add_convention(parser, sorted({key for entry in PROTOCOLS.values() for key in entry.conventions}))
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Score given maps, or paint and score.

    Raises:
        OptionError: neither --panoramas nor both --maps and --truth, or all of them; a convention that the protocol
            is not scored by.
    """
    check_protocol(args.protocol, args.convention)
    pair = (args.maps is not None, args.truth is not None)
    if args.panoramas is None and all(pair):
        return given_maps.run(args)
    if args.panoramas is not None and not any(pair):
        return painted.run(args)
    chosen = [name for name in ("--panoramas", "--maps", "--truth") if getattr(args, name[2:]) is not None]
    raise OptionError("input", ", ".join(chosen) or "none", "either --panoramas, or --maps and --truth")
