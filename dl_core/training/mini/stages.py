"""What the stages of `lightprobe train mini` do; their options are in `command.py`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch

from ...backends.mini import LORA_FILE, MINI_FOLDER, MiniModel, load_mini
from ...errors import OptionError
from ...imageio import require_writable
from ..lora.base import LoraBase
from ..lora.exposure_lora import train_exposure_loras
from ..lora.settings import LORA_SETTINGS
from ..panoramas import load_panoramas
from ..tensor_files import write_tensors
from ..work_folder import require_work_folder
from .base import train_base
from .control import train_control
from .decoder import train_decoder
from .drawn_pairs import DrawnPairs
from .export import write_networks
from .feed import Feed
from .loop import Budget
from .mean_light import mean_light, write_mean_light
from .regressor import train_regressor
from .scene_sampler import SceneSampler

__all__ = ["run_stage"]

Report = Callable[[str], None]

SKETCH: Final = 2
"""The denoiser sees blocks of 8 pixels only; pictures at half size give it the same for a quarter of the work."""

SCENE_ROWS: Final = 256
"""Rows of the maps the decoder learns detail from."""

SKETCH_ROWS: Final = 128
"""Rows of the maps behind half-size pictures."""


GOING_ON: Final = ("base", "control")
"""Stages that can start from weights that are there."""


def _sampler(
    args: argparse.Namespace, model: MiniModel, *, scale: int = SKETCH, bracket: bool = False, centred: float = 0.7
) -> SceneSampler:
    rows = SKETCH_ROWS if scale == SKETCH else SCENE_ROWS
    bank = load_panoramas(args.panoramas, args.scenes, height=rows, real_share=args.real_share)
    canvas, diameter = model.defaults.canvas // scale, model.defaults.diameter // scale
    ev_min = model.defaults.ev_min
    return SceneSampler(bank, canvas, diameter, args.seed, bracket=bracket, centred=centred, ev_min=ev_min)


def _feed(args: argparse.Namespace) -> Feed:
    if args.noises > 1 and args.stage not in GOING_ON:
        raise OptionError("--noises", args.noises, "1 for all stages but " + " and ".join(GOING_ON))
    if args.loaders and args.stage not in (*GOING_ON, "regressor"):
        raise OptionError("--loaders", args.loaders, "0 for all stages but base, control and regressor")
    return Feed(args.batch, args.noises, args.loaders)


def _budget(args: argparse.Namespace) -> Budget:
    return Budget(args.steps, args.learning_rate, bf16=args.mixed_precision == "bf16")


def _vae(args: argparse.Namespace, report: Report) -> list[Path]:
    model = MiniModel.untrained(args.out)
    sampler = _sampler(args, model, scale=1, bracket=True)
    weights = train_decoder(model, sampler, _budget(args), args.work / "vae", batch=args.batch, report=report)
    return write_networks(args.out, weights)


def _base(args: argparse.Namespace, report: Report) -> list[Path]:
    model = load_mini(args.out, without=("controlnet",)) if args.go_on else MiniModel.untrained(args.out)
    sampler = _sampler(args, model)
    weights = train_base(
        model, sampler, _budget(args), args.work / "base", feed=_feed(args), fresh=not args.go_on, report=report
    )
    return write_networks(args.out, weights)


def _control(args: argparse.Namespace, report: Report) -> list[Path]:
    model = load_mini(args.out, without=() if args.go_on else ("controlnet",))
    sampler = _sampler(args, model, centred=0.85)
    weights = train_control(
        model, sampler, _budget(args), args.work / "control", feed=_feed(args), fresh=not args.go_on, report=report
    )
    return write_networks(args.out, weights)


def _mean(args: argparse.Namespace, report: Report) -> list[Path]:
    sampler = _sampler(args, MiniModel.untrained(args.out))
    return [write_mean_light(args.out, mean_light(sampler, args.steps), args.steps)]


def _regressor(args: argparse.Namespace, report: Report) -> list[Path]:
    model = MiniModel.untrained(args.out)
    sampler = _sampler(args, model, bracket=True)
    weights = train_regressor(model, sampler, _budget(args), args.work / "regressor", feed=_feed(args), report=report)
    return write_networks(args.work / "regressor", weights)


def _lora(args: argparse.Namespace, report: Report) -> list[Path]:
    model = load_mini(args.out, without=("controlnet",))
    pairs = DrawnPairs(_sampler(args, model, bracket=True), args.steps * args.batch, SKETCH)
    settings = replace(
        LORA_SETTINGS["mini"],
        steps=args.steps,
        batch=args.batch,
        learning_rate=args.learning_rate,
        precision=args.mixed_precision,
        ev_min=model.defaults.ev_min,
        seed=args.seed,
    )
    base = LoraBase.from_mini(model)
    (lora,) = train_exposure_loras(base, pairs, settings, args.work / "lora", report=report)
    return [write_tensors(args.out / LORA_FILE, lora.weights, lora.metadata)]


_STAGES: Final[dict[str, Callable[[argparse.Namespace, Report], list[Path]]]] = {
    "vae": _vae,
    "base": _base,
    "control": _control,
    "lora": _lora,
    "mean": _mean,
    "regressor": _regressor,
}


def run_stage(args: argparse.Namespace, report: Report) -> list[Path]:
    """Run a stage with steps and learning rate filled in; returns what it wrote.

    Raises:
        OptionError: an option that is not accepted, named as on the command line.
        ModelError: a network the stage builds on is not there yet.
        OutputError: a folder cannot be written; said before any training.
    """
    args.out = args.out or MINI_FOLDER
    require_writable(args.out / "mini.json")
    require_work_folder(args.work)
    if args.go_on and args.stage not in GOING_ON:
        raise OptionError("--go-on", args.stage, "the stages " + " and ".join(GOING_ON))
    _feed(args)
    torch.manual_seed(args.seed)  # random starts: a resumed run builds the same ones
    return _STAGES[args.stage](args, report)
