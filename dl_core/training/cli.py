"""`lightprobe train NAME`: scenes to train on, and what is trained, as a table."""

from __future__ import annotations

import argparse
from typing import Final

from ..subcommands import Subcommand, add_subcommands

__all__ = ["TRAININGS", "add_arguments", "run"]

TRAININGS: Final[dict[str, Subcommand]] = {
    "scenes": Subcommand("draw procedural skies and rooms, or path trace them", f"{__package__}.scenes.command"),
    "data": Subcommand("make pairs to train an exposure LoRA on, from HDR panoramas", f"{__package__}.data.command"),
    "lora": Subcommand("train the exposure LoRA of SDXL or of the mini model", f"{__package__}.lora.command"),
    "turbo": Subcommand(
        "train a Turbo LoRA on medians that the iterative method paints", f"{__package__}.turbo.command"
    ),
    "mini": Subcommand("train a stage of the mini model", f"{__package__}.mini.command"),
}
"""The commands by name; a new one is a new row."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the commands; each declares its own options when it is chosen."""
    add_subcommands(parser, TRAININGS, "training")


def run(args: argparse.Namespace) -> int | None:
    """Run the chosen command."""
    return TRAININGS[args.training].load().run(args)
