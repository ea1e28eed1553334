"""`lightprobe train turbo`: a LoRA that paints at once the ball which the iterative method arrives at.

The medians come first, painted by this package with the exposure LoRA into a folder below --work; then the LoRA is
trained on them as `lightprobe train lora` does, on the noisiest timesteps. Only the options are here, so that help
comes without loading torch.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ...progress_lines import say
from ..lora.command import add_training_arguments

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--photographs", type=Path, required=True, help="folder of photographs")
    add("--preset", default="paper", help="how medians are painted: any preset but turbo (default: paper)")
    add("--lora", type=Path, help="exposure LoRA to paint with (SDXL only; mini: its own)")
    add("--depth", type=Path, help="folder of a depth model; without it scenes count as far away")
    add_training_arguments(parser)
    add("--timesteps", metavar="FIRST-LAST", default="800-999", help="noise levels trained on (default: 800-999)")


def run(args: argparse.Namespace) -> None:
    """Paint and train; an error names the option."""
    from ...backends.loading import quiet_libraries

    quiet_libraries()  # before they are imported: that is when they speak
    from .run import run_turbo

    for path in run_turbo(args, say):
        print(f"wrote {path}")
