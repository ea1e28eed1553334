"""What `lightprobe train lora` does; its options are in `command.py`."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch

from ...backends.mini import UNET_CONFIG, load_mini
from ...backends.sdxl_files import SDXL_FOLDER
from ...errors import OptionError
from ...imageio import require_writable
from ..data.pairs import PairShards
from ..tensor_files import write_tensors
from ..work_folder import require_work_folder
from .base import LoraBase
from .exposure_lora import TrainedLora, train_exposure_loras
from .memory import step_memory
from .settings import LORA_SETTINGS, LoraSettings, parse_evs, parse_timesteps

__all__ = ["memory_of", "require_outputs", "run_lora", "settings_of", "train_and_write"]

DTYPES: Final = {"no": torch.float32, "fp16": torch.float16, "bf16": torch.bfloat16}
SPOKEN_ALIKE: Final = (
    "rank",
    "steps",
    "batch",
    "learning_rate",
    "schedule",
    "ev_min",
    "seed",
    "gradient_checkpointing",
    "checkpoint_minutes",
    "validate_every",
)
"""Settings whose options have their names."""
CANVAS: Final = {"mini": 256, "sdxl": 1024}
CARD: Final = 24e9
"""Bytes of the memory of the paper's card, RTX 3090 Ti."""


def _kind(args: argparse.Namespace) -> str:
    return "mini" if args.model == "mini" else "sdxl"


def settings_of(args: argparse.Namespace) -> LoraSettings:
    """Settings of a command line: those of the kind of model, and over them what is given.

    Raises:
        OptionError: an option that is not accepted.
    """
    names = {
        "accumulation": args.gradient_accumulation,
        "precision": args.mixed_precision or ("fp16" if torch.cuda.is_available() and _kind(args) == "sdxl" else None),
        "timesteps": None if args.timesteps is None else parse_timesteps(args.timesteps),
    } | {name: getattr(args, name) for name in SPOKEN_ALIKE}
    given: dict[str, Any] = {name: value for name, value in names.items() if value is not None}
    return replace(LORA_SETTINGS[_kind(args)], **given)


def memory_of(args: argparse.Namespace) -> str:
    """A table of the bytes a step takes, and whether the paper's card holds them.

    Raises:
        OptionError: an option that is not accepted.
    """
    args.mixed_precision = args.mixed_precision or "fp16"
    kind, settings = _kind(args), settings_of(args)
    config = UNET_CONFIG if kind == "mini" else json.loads((SDXL_FOLDER / "unet" / "config.json").read_text())
    memory = step_memory(config, settings, CANVAS[kind], text_width=32 if kind == "mini" else 1280)
    checkpointing = "with" if settings.gradient_checkpointing else "without"
    head = (
        f"{kind}, batch {settings.batch}, {CANVAS[kind]} pixels, mixed precision {settings.precision}, {checkpointing} "
        "gradient checkpointing; computed, not measured:"
    )
    room = CARD - memory.total
    fits = f"leaves {room / 1e9:.1f} GB of 24" if room > 0 else f"does not fit 24 GB, {-room / 1e9:.1f} GB too much"
    return f"{head}\n{memory.table()}\n{fits}, before what the allocator and kernels take for themselves"


def run_lora(args: argparse.Namespace, report: Callable[[str], None]) -> list[Path]:
    """Train and write; returns the files.

    Raises:
        OptionError: an option that is missing or not accepted, named as on the command line.
        ModelError: the model's files do not serve.
        OutputError: a file cannot be written; said before any training where possible.
    """
    settings, separate = settings_of(args), () if args.separate is None else parse_evs(args.separate)
    if args.data is None:
        raise OptionError("--data", None, "a folder of `lightprobe train data`")
    outs = require_outputs(args, settings, separate)
    return train_and_write(args, settings, PairShards(args.data), outs, separate, report)


def require_outputs(args: argparse.Namespace, settings: LoraSettings, separate: Sequence[float] = ()) -> list[Path]:
    """Make sure, before long work, that what is trained can be computed and written; the files, one a LoRA.

    Raises:
        OptionError: an option that is missing or not accepted.
        OutputError: a file cannot be written.
    """
    if settings.precision == "fp16" and not torch.cuda.is_available():
        raise OptionError("--mixed-precision", "fp16", "bf16 or no where there is no GPU")
    for name in ("out", "work"):
        if getattr(args, name) is None:
            raise OptionError(f"--{name}", None, "a path")
    if args.out.suffix != ".safetensors":
        raise OptionError("--out", str(args.out), "a file name that ends in .safetensors")
    outs = [_out(args.out, ev) for ev in separate or (None,)]
    for out in outs:
        require_writable(out)
    require_work_folder(args.work)
    return outs


def train_and_write(
    args: argparse.Namespace,
    settings: LoraSettings,
    pairs: PairShards,
    outs: Sequence[Path],
    separate: Sequence[float],
    report: Callable[[str], None],
) -> list[Path]:
    """Load the model, train, write; returns the files, none from a process that does not write."""
    trained = train_exposure_loras(
        _base(args, settings), pairs, settings, args.work, separate=separate, report=_by_first_process(report)
    )
    return [_write(out, lora) for out, lora in zip(outs, trained, strict=True)] if _is_first() else []


def _base(args: argparse.Namespace, settings: LoraSettings) -> LoraBase:
    dtype = DTYPES[settings.precision]
    if _kind(args) == "sdxl":
        return LoraBase.from_files(Path(args.model), args.controlnet, dtype)
    if args.controlnet is not None:
        raise OptionError("--controlnet", str(args.controlnet), "nothing with the mini model: it brings its own")
    base = LoraBase.from_mini(load_mini())
    for network in ("unet", "controlnet", "text_encoder", "text_encoder_2"):
        getattr(base.pipeline, network).to(dtype)
    return base


def _out(path: Path, ev: float | None) -> Path:
    return path if ev is None else path.with_suffix(f".ev{ev:g}.safetensors")


def _write(path: Path, lora: TrainedLora) -> Path:
    return write_tensors(path, lora.weights, lora.metadata)


def _is_first() -> bool:
    """Whether this is the process that writes and speaks, of those that `torchrun` started."""
    return os.environ.get("RANK", "0") == "0"


def _by_first_process(report: Callable[[str], None]) -> Callable[[str], None]:
    return report if _is_first() else lambda line: None
