"""`lightprobe bench full-size`: what SDXL's networks take on this machine, with random weights and no download.

Memory and time do not depend on what weights say. Measured are a training of the exposure LoRA, as `lightprobe train
lora` runs it, beside the bytes computed for it (`training.lora.memory`), and the painter's denoiser evaluations.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, Final

import torch

from ..ball import Ball, paint_depth, place_ball
from ..errors import OptionError
from ..painter import PaintRequest
from ..shapes import Image
from ..training.lora.settings import LORA_SETTINGS
from .report import Column, Report, Row, add_output, prepare_output, publish

__all__ = ["SIZES", "Size", "add_arguments", "bench_full_size", "run"]


@dataclass(frozen=True)
class Size:
    """An architecture and the pictures it is used with.

    Attributes:
        build: makes a pipeline with random weights, on a device and in a type.
        canvas: side of its pictures, pixels.
        text_width: of its pooled text embedding.
    """

    build: Callable[[torch.device, torch.dtype], Any]
    canvas: int
    text_width: int


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: an option out of range, or a report that cannot be written.
    """
    started = time.perf_counter()
    for name in ("steps", "evaluations"):
        if getattr(args, name) < 2:
            raise OptionError(f"--{name}", getattr(args, name), "2 or more; the first is not timed")
    prepare_output(args)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    rows = bench_full_size(SIZES[args.size], device, steps=args.steps, evaluations=args.evaluations)
    protocol = {
        "size": args.size,
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "precision": str(_precision(device)).removeprefix("torch."),
        "weights": "random",
        "peak": "most memory that tensors held at once on the GPU, GB (10^9 bytes); not known on a CPU",
    }
    publish(Report("full-size", protocol, rows, [], time.perf_counter() - started), args, rows=_ROWS, summary=())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--size", choices=SIZES, default="sdxl", help="whose architecture (default: sdxl)")
    parser.add_argument("--steps", type=int, default=6, help="steps of training (default: 6)")
    parser.add_argument("--evaluations", type=int, default=8, help="steps of painting (default: 8)")
    add_output(parser)


def bench_full_size(size: Size, device: torch.device, *, steps: int, evaluations: int) -> list[Row]:
    """Rows for the training's first step with all encoding before it, its further steps, and painting 1 and 4 balls.

    Args:
        size: architecture and canvas.
        device: where it runs.
        steps: of training, 2 or more.
        evaluations: steps of a painting, 2 or more.
    """
    from ..backends.diffusers_painter import PAPER_DEFAULTS, DiffusersPainter

    rows = _training_rows(size, device, steps)
    painter = DiffusersPainter(size.build(device, _precision(device)), PAPER_DEFAULTS)
    return rows + [_painting_row(painter, size.canvas, count, evaluations, device) for count in (1, 4)]


def _precision(device: torch.device) -> torch.dtype:
    return torch.float16 if device.type == "cuda" else torch.float32


@dataclass(frozen=True)
class _NoisePair:
    image: Image
    ball: Ball
    ev: float
    panorama: str


def _noise_pairs(canvas: int, count: int) -> list[_NoisePair]:
    generator = torch.Generator().manual_seed(1)
    ball = place_ball(canvas, canvas // 4)
    pictures = [torch.rand(1, canvas, canvas, 3, generator=generator) for _ in range(count)]
    return [_NoisePair(picture, ball, -5 * i / count, "noise") for i, picture in enumerate(pictures)]


def _training_rows(size: Size, device: torch.device, steps: int) -> list[Row]:
    from ..backends.diffusers_painter import PAPER_DEFAULTS
    from ..training.lora.base import LoraBase
    from ..training.lora.exposure_lora import train_exposure_loras
    from ..training.lora.memory import step_memory

    precision = "fp16" if device.type == "cuda" else "no"
    settings = replace(LORA_SETTINGS["sdxl"], steps=1, precision=precision)
    pairs = _noise_pairs(size.canvas, settings.batch)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, until in (("encoding and first step", 1), ("further steps", steps)):
            torch.manual_seed(1)  # the same weights, or the second training would be of another model
            base = LoraBase("random", size.build(device, _precision(device)), PAPER_DEFAULTS)
            computed = step_memory(dict(base.pipeline.unet.config), settings, size.canvas, size.text_width)
            with _Peak(device) as peak:
                started = _now(device)
                train_exposure_loras(base, pairs, replace(settings, steps=until), Path(folder), report=_silent)
                seconds = _now(device) - started
            rows.append(
                {
                    "what": f"LoRA training, {name}",
                    "batch": settings.batch,
                    "canvas": size.canvas,
                    "seconds": seconds / max(1, until - 1),
                    "peak_gb": peak.gigabytes,
                    "computed_gb": computed.total / 1e9,
                }
            )
            del base
    return rows


def _painting_row(painter: Any, canvas: int, balls: int, steps: int, device: torch.device) -> Row:
    ball = place_ball(canvas, canvas // 4)
    picture = torch.full((1, canvas, canvas, 3), 0.5)
    request = PaintRequest(picture, paint_depth(None, ball), ball, 0.0, tuple(range(balls)), steps=steps)
    times = [_now(device)]
    with _Peak(device) as peak:
        encoded = painter.encode(picture)
        painter.inpaint(request, encoded, lambda evaluations: times.append(_now(device)))
    spent = [after - before for before, after in pairwise(times[1:])]
    per_step = painter.evaluations(balls, 1, 1.0)
    return {
        "what": "painting, an evaluation",
        "batch": balls,
        "canvas": canvas,
        "seconds": median(spent) / per_step,
        "peak_gb": peak.gigabytes,
        "computed_gb": None,
    }


class _Peak:
    """Most memory that tensors held on a GPU inside a block."""

    def __init__(self, device: torch.device) -> None:
        self._cuda = device.type == "cuda"
        self.gigabytes: float | None = None

    def __enter__(self) -> _Peak:
        if self._cuda:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
        return self

    def __exit__(self, *fault: Any) -> None:
        if self._cuda:
            self.gigabytes = torch.cuda.max_memory_allocated() / 1e9


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def _silent(line: str) -> None:
    """Nobody waits for a few steps."""


# Networks take seconds to import, so they are where they are wanted.


def _sdxl(device: torch.device, dtype: torch.dtype) -> Any:
    from ..backends.random_weights import sdxl_pipeline

    return sdxl_pipeline(device, dtype)


def _mini(device: torch.device, dtype: torch.dtype) -> Any:
    from ..backends.random_weights import mini_pipeline

    return mini_pipeline(device, dtype)


SIZES: Final = {"sdxl": Size(_sdxl, 1024, 1280), "mini": Size(_mini, 256, 32)}
"""Architectures by name."""


_ROWS: Final[Sequence[Column]] = (
    Column("what", "what"),
    Column("batch", "batch"),
    Column("canvas", "canvas"),
    Column("seconds", "seconds", ".3f"),
    Column("peak GB", "peak_gb", ".2f"),
    Column("computed GB", "computed_gb", ".2f"),
)
