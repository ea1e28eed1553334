"""`lightprobe train mini STAGE`: the stages that make the mini model, in order: vae, base, control, lora.

Stages `mean` and `regressor` make what the benches compare it with.

Each is seeded, checkpoints every two minutes under the work folder, and goes on from there when run again.
Only the options are here, so that help comes without loading torch.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ...progress_lines import say
from ..lora.settings import LORA_SETTINGS

__all__ = ["STAGES", "Stage", "add_arguments", "run"]


@dataclass(frozen=True)
class Stage:
    """A stage of training and what it does by default.

    Attributes:
        summary: one line for people.
        steps: optimizer steps; for `mean`, pictures.
        learning_rate: peak of the schedule.
    """

    summary: str
    steps: int
    learning_rate: float


_LORA: Final = LORA_SETTINGS["mini"]

STAGES: Final[dict[str, Stage]] = {
    "vae": Stage("write the closed-form encoder and train the decoder", 600, 4e-4),
    "base": Stage("train UNet and text encoders", 2400, 4e-4),
    "control": Stage("train the depth ControlNet, and the base further with it", 1600, 3e-4),
    "lora": Stage("train the exposure LoRA on the finished base", _LORA.steps, _LORA.learning_rate),
    "mean": Stage("the mean of all training light, to compare with", 4000, 0.0),
    "regressor": Stage(
        "train the base's networks to give balls at once, to compare with; written to --work", 2400, 4e-4
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("stage", choices=STAGES, help="; ".join(f"{name}: {stage.summary}" for name, stage in STAGES.items()))
    add("--panoramas", type=Path, help="folder of HDR maps whose manifest.json names a training split")
    add("--scenes", type=Path, help="folder of `lightprobe train scenes`")
    add("--work", type=Path, required=True, help="folder for checkpoints and logs")
    add("--out", type=Path, help="folder of the mini model's files (default: the package's own)")
    add("--steps", type=int, help="optimizer steps (default: the stage's)")
    add("--batch", type=int, default=8, help="pictures a step (default: 8)")
    add("--noises", type=int, default=1, help="examples of a step made of each picture (default: 1; base, control)")
    add(
        "--loaders",
        type=int,
        default=0,
        help="processes that draw pictures ahead of a GPU (default: 0; base, control, regressor)",
    )
    add(
        "--real-share",
        type=float,
        default=0.5,
        help="share of pictures in maps of --panoramas where there are --scenes too (default: 0.5)",
    )
    add("--learning-rate", type=float, help="peak learning rate (default: the stage's)")
    add("--seed", type=int, default=1, help="of weights and pictures (default: 1)")
    add(
        "--mixed-precision",
        choices=("no", "bf16"),
        default="no",
        help="of all stages' networks; bf16 is 1.7 times as fast where the processor has AMX (default: no)",
    )
    add(
        "--go-on",
        action="store_true",
        help="start from the weights in --out, with fresh averages, instead of from random ones (base, control)",
    )


def run(args: argparse.Namespace) -> None:
    """Run a stage of training; an error names the option."""
    from .stages import run_stage

    stage = STAGES[args.stage]
    args.steps = stage.steps if args.steps is None else args.steps
    args.learning_rate = stage.learning_rate if args.learning_rate is None else args.learning_rate
    for path in run_stage(args, say):
        print(f"wrote {path}")
