"""`lightprobe train lora`: the exposure LoRA for SDXL or the mini model, from pairs of `lightprobe train data`.

Only the options are here, so that help comes without loading torch.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ...progress_lines import say
from .settings import LORA_SETTINGS, PRECISIONS, SCHEDULES

__all__ = ["add_arguments", "add_training_arguments", "run"]


def _default(name: str) -> str:
    sdxl, mini = (getattr(LORA_SETTINGS[kind], name) for kind in ("sdxl", "mini"))
    return f"(default: {sdxl:g})" if sdxl == mini else f"(default: {sdxl:g}; mini: {mini:g})"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--data", type=Path, help="folder of `lightprobe train data`")
    add_training_arguments(parser)
    add("--timesteps", metavar="FIRST-LAST", help="noise levels trained on (default: 900-999; mini: 0-999)")
    add(
        "--separate",
        metavar="EV,...",
        help="in place of one LoRA for all exposures, one for each of these, as in the paper's ablation: "
        "FILE.ev-2.5.safetensors",
    )
    add("--memory", action="store_true", help="only print the bytes a step takes with these options, computed")


def add_training_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what every training of a LoRA has: model, files, and all settings but the range of timesteps."""
    add = parser.add_argument
    add("--model", required=True, help="an SDXL checkpoint or a folder in diffusers' layout; or `mini`")
    add("--controlnet", type=Path, help="depth ControlNet for the pictures of --validate-every (mini: its own)")
    add("--out", type=Path, help="the LoRA, a .safetensors file")
    add("--work", type=Path, help="folder for latents, checkpoint, log and pictures; the same command goes on from it")
    add("--rank", type=int, help=f"of the LoRA {_default('rank')}")
    add("--steps", type=int, help=f"optimizer steps {_default('steps')}")
    add("--batch", type=int, help=f"pictures a process denoises at once {_default('batch')}")
    add("--gradient-accumulation", type=int, help=f"batches to a step {_default('accumulation')}")
    add("--learning-rate", type=float, help=f"of AdamW {_default('learning_rate')}")
    add("--schedule", choices=SCHEDULES, help="of the learning rate (default: constant; mini: cosine)")
    add("--ev-min", type=float, help=f"EV at which the dark prompt stands alone {_default('ev_min')}")
    add(
        "--mixed-precision",
        choices=PRECISIONS,
        help="of the frozen networks; the LoRA is in single precision (default: fp16 for SDXL on a GPU, else no)",
    )
    add(
        "--gradient-checkpointing",
        action=argparse.BooleanOptionalAction,
        help="compute the UNet's blocks twice to hold less in memory (default: yes; mini: no)",
    )
    add("--seed", type=int, help="of the LoRA's start, order, noise (default: 1)")
    add("--checkpoint-minutes", type=float, help=f"between checkpoints {_default('checkpoint_minutes')}")
    add(
        "--validate-every",
        type=int,
        metavar="STEPS",
        help="paint a photograph's ball at EV 0, -2.5 and -5 every so many steps, and at the end (default: 0, never)",
    )


def run(args: argparse.Namespace) -> None:
    """Train; an error names the option."""
    from ...backends.loading import quiet_libraries

    quiet_libraries()  # before they are imported: that is when they speak
    from .run import memory_of, run_lora

    if args.memory:
        print(memory_of(args))
        return
    for path in run_lora(args, say):
        print(f"wrote {path}")
