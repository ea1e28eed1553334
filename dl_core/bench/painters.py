"""Painters a protocol can be run with: the truth itself, or a diffusion model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

from ..backends.loading import BACKENDS, LoadedPainter, ModelFiles
from ..errors import OptionError
from ..painter import Painter
from .cameras import Shot
from .paintings import PainterOf, Variant
from .perfect import PerfectPainter

__all__ = ["PAINTERS", "Studio", "open_studio"]


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


def open_studio(name: str, files: ModelFiles) -> Studio:
    """The studio of a name.

    Raises:
        OptionError: an unknown name, or files it has no use for.
        ModelError: files that do not serve.
    """
    if name not in PAINTERS:
        raise OptionError("--painter", name, ", ".join(PAINTERS))
    return PAINTERS[name](files)
