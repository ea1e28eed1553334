"""What `lightprobe train turbo` does; its options are in `command.py`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from ...backends.loading import LoadedPainter, ModelFiles, choose_backend
from ...depth import load_depth_model
from ...errors import OptionError
from ...painter import IMPUTINGS
from ...presets import preset
from ..lora.run import require_outputs, settings_of, train_and_write
from .median_pairs import MedianPainting, paint_medians

__all__ = ["run_turbo"]


def run_turbo(args: argparse.Namespace, report: Callable[[str], None]) -> list[Path]:
    """Paint the medians that are missing, train, write; returns the file.

    Raises:
        OptionError: an option that is missing or not accepted, named as on the command line.
        ImageError: no photographs.
        ModelError: the model's files do not serve.
        OutputError: a file cannot be written.
    """
    settings, chosen = settings_of(args), preset(args.preset)
    if chosen.rounds.rounds == 0:
        raise OptionError("--preset", args.preset, "one that takes a median: any but turbo")
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        then = "then `train lora --data WORK/medians --timesteps 800-999` takes any number"
        raise OptionError("torchrun", os.environ["WORLD_SIZE"], f"one process while medians are painted; {then}")
    outs = require_outputs(args, settings)
    named = {f"--{name}": str(getattr(args, name)) for name in ("model", "controlnet", "lora", "depth", "preset")}
    rounds = replace(chosen.rounds, final=False)  # the last ball is painted from the median, which is what is wanted
    painting = MedianPainting(rounds, chosen.evs, settings.seed, named, chosen.depth_disc)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    depth_of = None if args.depth is None else load_depth_model(str(args.depth), device=device)
    pairs = paint_medians(
        args.photographs, lambda: _painter(args), painting, args.work / "medians", depth_of=depth_of, report=report
    )
    return train_and_write(args, settings, pairs, outs, (), report)


def _painter(args: argparse.Namespace) -> LoadedPainter:
    if args.model == "mini":
        return choose_backend("mini").load(ModelFiles(controlnet=args.controlnet, lora=args.lora), IMPUTINGS[0])
    if args.lora is None:
        raise OptionError("--lora", None, "the exposure LoRA, to paint medians with")
    files = ModelFiles(model=Path(args.model), controlnet=args.controlnet, lora=args.lora)
    return choose_backend("diffusers").load(files, IMPUTINGS[0])
