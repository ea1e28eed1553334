"""`lightprobe bench metrics`: one picture against the true one, under a convention of `picture_errors`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Bool
from torch import Tensor

from ..errors import ImageError
from ..imageio import Render, read_render
from ..picture_errors import CONVENTIONS, RANGE, picture_errors
from .report import Column, Report, Row, add_output, prepare_output, publish

__all__ = ["ERROR_COLUMNS", "add_arguments", "add_convention", "protocol", "run", "score"]

ERROR_COLUMNS: Final = (
    Column("RMSE", "rmse", ".4f"),
    Column("si-RMSE", "si_rmse", ".4f"),
    Column("angle (deg)", "angular_error_deg", ".3f"),
    Column("normalized RMSE", "normalized_rmse", ".4f"),
)


def add_convention(parser: argparse.ArgumentParser, names: Sequence[str] = tuple(CONVENTIONS)) -> None:
    """Declare `--convention`, with those conventions that apply."""
    lines = "; ".join(f"{name}: {CONVENTIONS[name].summary}" for name in names)
    parser.add_argument(
        "--convention", choices=tuple(names), default="radiance", help=f"how errors are counted ({lines})"
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--pred", type=Path, required=True, metavar="FILE", help="predicted picture, EXR or HDR")
    parser.add_argument(
        "--truth", type=Path, required=True, metavar="FILE", help="true picture; its alpha, if any, is the mask"
    )
    add_convention(parser)
    add_output(parser)


def protocol(convention: str) -> Row:
    """What a convention does, as reports state it."""
    return {"convention": convention, **asdict(CONVENTIONS[convention]), "range_percentiles": list(RANGE)}


def _mask(truth: Render) -> Bool[Tensor, "h w"]:
    """Where pixels count: wherever the truth's alpha is above 0, or everywhere."""
    return torch.ones(truth.pixels.shape[:2], dtype=torch.bool) if truth.alpha is None else truth.alpha > 0


def score(predicted: Path, truth: Path, convention: str) -> Row:
    """Errors of a picture, with what they were taken over.

    Raises:
        ImageError: a picture that cannot be read, pictures of different sizes, or a truth that is transparent
            throughout.
    """
    estimate, true = read_render(predicted), read_render(truth)
    if estimate.pixels.shape != true.pixels.shape:
        sizes = [f"{render.pixels.shape[1]} x {render.pixels.shape[0]}" for render in (estimate, true)]
        raise ImageError(
            predicted, f"is {sizes[0]} pixels, {truth.name} {sizes[1]}; two pictures of one size are compared"
        )
    mask = _mask(true)
    if not bool(mask.any()):
        raise ImageError(truth, "is transparent throughout; nothing is left to compare")
    return {
        "pred": predicted.name,
        "truth": truth.name,
        "convention": convention,
        **asdict(picture_errors(estimate.pixels, true.pixels, mask, convention)),
        "mask": "whole frame" if true.alpha is None else "alpha of the truth",
        "mask_pixels": int(mask.sum()),
        "pixels": mask.numel(),
    }


def run(args: argparse.Namespace) -> int | None:
    """Score a pair; JSON has the errors on its top level as well."""
    prepare_output(args)
    started = time.perf_counter()
    row = score(args.pred, args.truth, args.convention)
    report = Report("metrics", protocol(args.convention), [row], [], time.perf_counter() - started, headline=row)
    columns = (Column("pred", "pred"), Column("truth", "truth"), *ERROR_COLUMNS, Column("mask", "mask"))
    publish(report, args, rows=columns)
    return 0
