"""Families of diffusion models by name, and how a painter of each is loaded from local files.

What loads slowly is imported by the row that is chosen.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from ..errors import OptionError
from ..painter import Imputing, Painter

__all__ = ["BACKENDS", "PRECISIONS", "Backend", "LoadedPainter", "ModelFiles", "choose_backend", "quiet_libraries"]

PRECISIONS: Final = ("float32", "bfloat16", "float16")
"""Floating-point types that a model can compute in, by torch's names."""


@dataclass(frozen=True)
class ModelFiles:
    """Where a model's files are.

    Attributes:
        model: checkpoint or folder; None for the backend's own, where it has one.
        controlnet: a depth ControlNet.
        lora: the exposure LoRA.
        turbo_lora: the Turbo LoRA, which takes the first timesteps from the exposure LoRA.
        exposure_lora: whether LoRAs are used at all, the backend's own included.
        precision: of `PRECISIONS`, what the networks compute in; None for float16 on a GPU, float32 elsewhere.
    """

    model: Path | None = None
    controlnet: Path | None = None
    lora: Path | None = None
    turbo_lora: Path | None = None
    exposure_lora: bool = True
    precision: str | None = None

    @staticmethod
    def of(args: argparse.Namespace) -> ModelFiles:
        """From the options `--model`, `--controlnet`, `--lora`, `--turbo-lora` and `--precision`.

        Raises:
            OptionError: an unknown precision.
        """
        if args.precision not in (None, *PRECISIONS):
            raise OptionError("--precision", args.precision, ", ".join(PRECISIONS))
        names = (args.model, args.controlnet, args.lora, args.turbo_lora)
        model, controlnet, lora, turbo_lora = (None if name is None else Path(name) for name in names)
        return ModelFiles(model, controlnet, lora, turbo_lora, precision=args.precision)


@dataclass(frozen=True)
class LoadedPainter:
    """A painter and the canvas it wants.

    Attributes:
        painter: paints balls.
        canvas: side of the canvas, pixels.
        diameter: of the ball, pixels, unless another is asked for.
    """

    painter: Painter
    canvas: int
    diameter: int


@dataclass(frozen=True)
class Backend:
    """A family of diffusion models.

    Attributes:
        summary: one line for people.
        load: a painter from files, and the noise it puts on what lies outside the mask. Raises OptionError for files
            it needs or has no use for, ModelError for files that do not serve.
    """

    summary: str
    load: Callable[[ModelFiles, Imputing], LoadedPainter]


def quiet_libraries() -> None:
    """Leave the terminal to the progress bar: these libraries announce what they fall back to without torchvision."""
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    diffusers_logging.set_verbosity_error()
    transformers_logging.set_verbosity_error()


def _load_mini(files: ModelFiles, impute: Imputing) -> LoadedPainter:
    for name in ("controlnet", "lora", "turbo_lora"):
        if getattr(files, name) is not None:
            value = str(getattr(files, name))
            raise OptionError(name, value, "nothing with the backend mini: its folder holds all of it")
    quiet_libraries()
    import torch

    from .diffusers_painter import DiffusersPainter
    from .mini import MINI_FOLDER, load_mini

    model = load_mini(MINI_FOLDER if files.model is None else files.model)
    if not files.exposure_lora:
        model = replace(model, lora=None)
    painter = DiffusersPainter.from_mini(model, impute=impute)
    if files.precision is not None:
        painter = painter.in_precision(getattr(torch, files.precision))
    return LoadedPainter(painter, model.defaults.canvas, model.defaults.diameter)


def _load_diffusers(files: ModelFiles, impute: Imputing) -> LoadedPainter:
    if files.model is None or files.controlnet is None:
        name = "model" if files.model is None else "controlnet"
        raise OptionError(name, None, "a local file or folder; the backend diffusers downloads nothing")
    quiet_libraries()
    import torch

    from .diffusers_painter import DiffusersPainter

    dtype = None if files.precision is None else getattr(torch, files.precision)
    lora, turbo_lora = (files.lora, files.turbo_lora) if files.exposure_lora else (None, None)
    painter = DiffusersPainter.from_files(files.model, files.controlnet, lora, turbo_lora, dtype=dtype, impute=impute)
    return LoadedPainter(painter, painter.defaults.canvas, painter.defaults.diameter)


BACKENDS: Final[dict[str, Backend]] = {
    "mini": Backend("the model this package brings along: a preview, not an estimate to rely on", _load_mini),
    "diffusers": Backend("SDXL, a depth ControlNet and the exposure LoRA from local files", _load_diffusers),
}


def choose_backend(name: str) -> Backend:
    """The backend of a name.

    Raises:
        OptionError: no such backend.
    """
    if name not in BACKENDS:
        raise OptionError("backend", name, ", ".join(BACKENDS))
    return BACKENDS[name]
