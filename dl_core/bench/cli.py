"""`lightprobe bench NAME`: the benches as a table.

Options and output that benches share are in `report`: `--panoramas` by `add_panoramas`, `--out` and `--json` by
`add_output`; a run ends in `publish`.
"""

from __future__ import annotations

import argparse
from typing import Final

from ..subcommands import Subcommand, add_subcommands

__all__ = ["BENCHES", "add_arguments", "run"]

BENCHES: Final[dict[str, Subcommand]] = {
    "oracle": Subcommand("what unwrap and merge lose behind a perfect painter", f"{__package__}.oracle"),
    "geometry": Subcommand("what latlong -> ball -> latlong loses", f"{__package__}.geometry"),
    "fit": Subcommand("how well radius and centre of a painted ball are found", f"{__package__}.fit"),
    "metrics": Subcommand("score a picture against the true one", f"{__package__}.pairs"),
    "steering": Subcommand("how well exposures follow the EV asked for", f"{__package__}.steering"),
    "pareto": Subcommand("error against cost over schedules, as a chart", f"{__package__}.pareto.command"),
    "early": Subcommand("what medians lose and save that stop denoising early", f"{__package__}.early.command"),
    "bracket": Subcommand("what a scene-sized bracket keeps and costs", f"{__package__}.bracket"),
    "quality": Subcommand("how well good balls are told from bad ones", f"{__package__}.quality"),
    "confidence": Subcommand("whether an estimate knows how wrong it is", f"{__package__}.confidence"),
    "stability": Subcommand("where the method fails, and what it depends on", f"{__package__}.stability.command"),
    "mend": Subcommand("what options around an estimate gain", f"{__package__}.mend"),
    "protocol": Subcommand("score given maps by the paper's protocols", f"{__package__}.protocol.command"),
    "full-size": Subcommand("what SDXL takes on this machine, random weights", f"{__package__}.full_size"),
    "lights": Subcommand("how small a light stands for a map, and how long it takes to find", f"{__package__}.lights"),
}
"""The benches by name; a new one is a new row."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benches; each declares its own options when it is chosen."""
    add_subcommands(parser, BENCHES, "bench")


def run(args: argparse.Namespace) -> int | None:
    """Run the chosen bench."""
    return BENCHES[args.bench].load().run(args)
