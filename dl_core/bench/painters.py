"""Painters a protocol can be run with: the truth itself, or a diffusion model."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Final

from ..backends.loading import BACKENDS, LoadedPainter, ModelFiles
from ..errors import OptionError
from ..painter import Painter
from .cameras import Shot
from .journal import fingerprint
from .paintings import PainterOf, Variant
from .perfect import PerfectPainter

__all__ = ["PAINTERS", "Studio", "add_files", "identity", "open_studio", "studio_for_workers"]

_FILES: Final = {
    "model": "checkpoint",
    "controlnet": "depth ControlNet",
    "lora": "exposure LoRA",
    "turbo-lora": "Turbo LoRA",
}


@dataclass(frozen=True)
class Studio:
    """Painters of a kind, and the canvas they want.

    Attributes:
        painter_of: the painter of a variant and a shot.
        canvas: side of the canvas, pixels.
        diameter: of the ball, pixels.
    """

    painter_of: PainterOf
    canvas: int
    diameter: int


def _perfect(files: ModelFiles) -> Studio:
    return Studio(lambda variant, shot: PerfectPainter(shot.truth_hdr), 1024, 256)


def _backend(name: str) -> Callable[[ModelFiles], Studio]:
    def open_backend(files: ModelFiles) -> Studio:
        @cache  # a model is loaded once with its LoRA and once without, each when first wanted
        def load(exposure_lora: bool) -> LoadedPainter:
            return BACKENDS[name].load(replace(files, exposure_lora=exposure_lora), "initial")

        def painter_of(variant: Variant, shot: Shot) -> Painter:
            return load(variant.lora).painter

        loaded = load(True)
        return Studio(painter_of, loaded.canvas, loaded.diameter)

    return open_backend


PAINTERS: Final[dict[str, Callable[[ModelFiles], Studio]]] = {
    "perfect": _perfect,
    **{name: _backend(name) for name in BACKENDS},
}
"""Painters by name: files -> studio. `perfect` paints the true ball in 8 bits, whatever the files."""


def add_files(parser: argparse._ActionsContainer) -> None:
    """Declare the options that name a painter's files, as `ModelFiles.of` reads them."""
    for name, what in _FILES.items():
        parser.add_argument(f"--{name}", metavar="PATH", help=f"{what} of the painter, as for estimate")
    parser.add_argument("--precision", metavar="TYPE", help="what its networks compute in, as for estimate")


def identity(painter: str, files: ModelFiles) -> str:
    """Name of a painter, with a fingerprint of its files and its precision where they are named."""
    places = (files.model, files.controlnet, files.lora, files.turbo_lora)
    named = f"{painter} {fingerprint(*places)}" if any(places) else painter
    return named if files.precision is None else f"{named} {files.precision}"


def open_studio(name: str, files: ModelFiles) -> Studio:
    """The studio of a name.

    Raises:
        OptionError: an unknown name, or files it has no use for.
        ModelError: files that do not serve.
    """
    if name not in PAINTERS:
        raise OptionError("--painter", name, ", ".join(PAINTERS))
    return PAINTERS[name](files)


def studio_for_workers(workers: int, studio: Studio, name: str, files: ModelFiles) -> Callable[[], Studio]:
    """What gives each panorama its studio: one worker has it open, several, being other processes, open their own.

    Args:
        workers: processes, as `workers.results_of` takes them.
        studio: of the name and the files.
        name: of `PAINTERS`.
        files: of the painter.
    """
    return (lambda: studio) if workers == 1 else partial(open_studio, name, files)
