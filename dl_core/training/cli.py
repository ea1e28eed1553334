"""`lightprobe train STAGE`: the stages that make the mini model, in order: data, vae, base, control, lora.

Each is seeded, checkpoints every two minutes under the work folder, and goes on from there when run again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch

from ..backends.mini import MINI_FOLDER, MiniModel, load_mini
from ..imageio import require_writable
from .base import train_base
from .control import train_control
from .decoder import train_decoder
from .export import write_lora, write_networks
from .loop import Budget
from .lora import train_lora
from .panoramas import draw_scenes, load_panoramas
from .scenes import SceneSampler

__all__ = ["STAGES", "Stage", "add_arguments", "run"]

Report = Callable[[str], None]

SKETCH: Final = 2
"""The denoiser sees blocks of 8 pixels only; pictures at half size give it the same for a quarter of the work."""


@dataclass(frozen=True)
class Stage:
    """A stage of training and what it does by default.

    Attributes:
        summary: one line for people.
        steps: optimizer steps (for `data`: scenes drawn).
        learning_rate: peak of the schedule.
        train: does it, given the options and whom to tell of progress; the files written.
    """

    summary: str
    steps: int
    learning_rate: float
    train: Callable[[argparse.Namespace, Report], list[Path]]


SCENE_ROWS: Final = 256
"""Rows of the drawn scenes, and of the maps the decoder learns detail from."""

SKETCH_ROWS: Final = 128
"""Rows of the maps behind half-size pictures."""


def _sampler(
    args: argparse.Namespace, model: MiniModel, *, scale: int = SKETCH, bracket: bool = False, centred: float = 0.7
) -> SceneSampler:
    rows = SKETCH_ROWS if scale == SKETCH else SCENE_ROWS
    bank = load_panoramas(args.panoramas, args.work / "scenes", height=rows)
    canvas, diameter = model.defaults.canvas // scale, model.defaults.diameter // scale
    ev_min = model.defaults.ev_min
    return SceneSampler(bank, canvas, diameter, args.seed, bracket=bracket, centred=centred, ev_min=ev_min)


def _budget(args: argparse.Namespace) -> Budget:
    stage = STAGES[args.stage]
    return Budget(args.steps or stage.steps, args.learning_rate or stage.learning_rate)


def _data(args: argparse.Namespace, report: Report) -> list[Path]:
    draw_scenes(args.work / "scenes", args.steps or STAGES["data"].steps, SCENE_ROWS, report=report)
    return [args.work / "scenes"]


def _vae(args: argparse.Namespace, report: Report) -> list[Path]:
    model = _untrained(args)
    sampler = _sampler(args, model, scale=1, bracket=True)
    weights = train_decoder(model, sampler, _budget(args), args.work / "vae", batch=args.batch, report=report)
    return write_networks(args.out, weights)


def _base(args: argparse.Namespace, report: Report) -> list[Path]:
    model = _untrained(args)
    sampler = _sampler(args, model)
    weights = train_base(model, sampler, _budget(args), args.work / "base", batch=args.batch, report=report)
    return write_networks(args.out, weights)


def _control(args: argparse.Namespace, report: Report) -> list[Path]:
    model = load_mini(args.out, without=("controlnet",))
    sampler = _sampler(args, model, centred=0.3)
    weights = train_control(model, sampler, _budget(args), args.work / "control", batch=args.batch, report=report)
    return write_networks(args.out, weights)


def _lora(args: argparse.Namespace, report: Report) -> list[Path]:
    model = load_mini(args.out, without=("controlnet",))
    sampler = _sampler(args, model, bracket=True)
    weights = train_lora(model, sampler, _budget(args), args.work / "lora", batch=args.batch, report=report)
    return [write_lora(args.out, weights)]


def _untrained(args: argparse.Namespace) -> MiniModel:
    torch.manual_seed(args.seed)
    return MiniModel.untrained(args.out)


STAGES: Final[dict[str, Stage]] = {
    "data": Stage("draw procedural skies and rooms", 240, 0.0, _data),
    "vae": Stage("write the closed-form encoder and train the decoder", 600, 4e-4, _vae),
    "base": Stage("train UNet and text encoders", 2400, 4e-4, _base),
    "control": Stage("train the depth ControlNet on the finished base", 400, 4e-4, _control),
    "lora": Stage("train the exposure LoRA on the finished base", 400, 1e-3, _lora),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `lightprobe train`."""
    parser.add_argument("stage", choices=STAGES, help="; ".join(f"{name}: {s.summary}" for name, s in STAGES.items()))
    parser.add_argument(
        "--panoramas", type=Path, help="folder of HDR maps with manifest.json; its training split is used"
    )
    parser.add_argument("--work", type=Path, required=True, help="folder for scenes, checkpoints and logs")
    parser.add_argument("--out", type=Path, default=MINI_FOLDER, help="folder of the mini model's files")
    parser.add_argument("--steps", type=int, help="optimizer steps, or scenes for data")
    parser.add_argument("--batch", type=int, default=8, help="pictures a step")
    parser.add_argument("--learning-rate", type=float, help="peak learning rate")
    parser.add_argument("--seed", type=int, default=1, help="of weights and pictures")


def run(args: argparse.Namespace) -> None:
    """Run a stage of training."""

    def report(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    require_writable(args.out / "mini.json")
    for path in STAGES[args.stage].train(args, report):
        print(f"wrote {path}")
