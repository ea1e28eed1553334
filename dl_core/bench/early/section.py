"""What the sections of `lightprobe bench early` share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

from torch import Tensor

from ...ball import Ball, crop_disc, fit_canvas, paint_depth, place_ball
from ...errors import OptionError
from ...exposure import expose
from ...geometry import latlong_to_ball
from ...imageio import read_envmap
from ...painter import Painter, PaintRequest
from ...shapes import BallImage, Image
from ..cameras import Camera, Shot, take
from ..painters import Studio
from ..report import Column, Row

__all__ = ["LatentPainter", "Options", "Scene", "Section", "ball_rmse", "latents_of", "require_latents"]


@dataclass(frozen=True)
class Options:
    """What is painted.

    Attributes:
        balls: of a median.
        rounds: medians taken.
        steps: of a full schedule.
        strength: share of it that later rounds and the last ball run.
        untils: shares of it after which medians stop.
        seeds: noises that are compared.
        seed: the first of them, and of every first ball.
        out: folder for what is painted; memory alone without one.
    """

    balls: int
    rounds: int
    steps: int
    strength: float
    untils: tuple[float, ...]
    seeds: int
    seed: int
    out: Path | None = None


@dataclass(frozen=True)
class Scene:
    """A photograph taken inside a panorama, its canvas, and the balls that are true there.

    Attributes:
        shot: photograph and light.
        request: for one ball at EV 0, seed 0.
        true_ball_hdr: (1, D, D, 3) linear radiance.
    """

    shot: Shot
    request: PaintRequest
    true_ball_hdr: BallImage

    @staticmethod
    def of(path: Path, studio: Studio) -> Scene:
        """The scene of a map's file, on a studio's canvas."""
        shot, ball = take(read_envmap(path), Camera()), place_ball(studio.canvas, studio.diameter)
        canvas = fit_canvas(shot.photo_ldr, ball.canvas)
        request = PaintRequest(canvas, paint_depth(None, ball), ball, 0.0, (0,))
        return Scene(shot, request, latlong_to_ball(shot.truth_hdr, ball.diameter))

    def true_ball(self, ev: float) -> BallImage:
        """(1, D, D, 3) display-encoded."""
        return expose(self.true_ball_hdr, ev)


class Section(ABC):
    """One thing that is measured, panorama by panorama."""

    summary: ClassVar[str]
    rows: ClassVar[tuple[Column, ...]]
    columns: ClassVar[tuple[Column, ...]]

    def __init__(self, studio: Studio, options: Options) -> None:
        """Take the painters and what to paint."""
        self._studio, self._options = studio, options

    @property
    @abstractmethod
    def each(self) -> int:
        """Rows of a panorama."""

    @abstractmethod
    def measure(self, path: Path) -> list[Row]:
        """The rows of a panorama."""

    @abstractmethod
    def summarize(self, rows: list[Row]) -> list[Row]:
        """Records over all panoramas."""

    @abstractmethod
    def protocol(self) -> Row:
        """What was measured how."""


def ball_rmse(one: BallImage, other: BallImage) -> float:
    """Root mean square difference inside the ball, (1, D, D, 3) display-encoded each."""
    diameter = one.shape[1]
    ball = Ball(0, 0, diameter, diameter, 0)
    inside = crop_disc(ball)[None, ..., None]
    return float((((one - other) ** 2 * inside).sum() / (3 * inside.sum())).sqrt())


@runtime_checkable
class LatentPainter(Painter, Protocol):
    """A painter whose latents can be reached: `backends.diffusers_painter.DiffusersPainter`."""

    pipeline: Any

    def encode(self, canvas: Image) -> Any:
        """What the autoencoder makes of a canvas."""

    def inpaint(self, request: PaintRequest, encoded: Any, counted: Callable[[int], None]) -> Tensor:
        """Latents of a request's balls."""

    def decode(self, latents: Tensor) -> Image:
        """Pictures of latents of any size."""

    def decode_ball(self, latents: Tensor, ball: Ball) -> BallImage:
        """Balls of latents."""


def require_latents(painter: Painter) -> LatentPainter:
    """A painter whose latents can be reached.

    Raises:
        OptionError: another one.
    """
    if not isinstance(painter, LatentPainter):
        raise OptionError("--painter", type(painter).__name__, "a painter on diffusers for this section")
    return painter


def latents_of(painter: LatentPainter, canvas: Image) -> Tensor:
    """Clean latents of a canvas as the denoiser has them; the mode, where the autoencoder has one."""
    encoded = painter.encode(canvas)
    latents = encoded.latent_dist.mode() if hasattr(encoded, "latent_dist") else encoded.latents
    return latents.float() * painter.pipeline.vae.config.scaling_factor
