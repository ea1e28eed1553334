"""Draws training pairs: a photograph of a panorama at EV 0, and in it a mirror ball at an EV of its own.

A pair follows from the options, the panoramas and its index, so that a stream of them goes on anywhere, and is the same
whether it is stored (`shards`) or drawn anew.

The ball is seen from far away (orthographic), wherever it is on the canvas, as in the paper. Depth of the scene is not
known: depth maps show the ball alone.

Source: DiffusionLight, Sec. 4.2 ("Training set") and Appendix C.1.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from ...ball import Ball, Frame, crop_ball, photograph_frame, place_ball
from ...errors import OptionError
from ...exposure import auto_exposure, expose, quantize
from ...geometry import ball_coverage
from ...imageio import read_envmap
from ...shapes import BallImage, Image
from ..mini.scene_sampler import ASPECTS
from ..scenes.procedural import random_uniform
from .pairs import Pair
from .views import Camera, Surroundings, take_ball, take_photograph

__all__ = ["PairOptions", "PairSampler", "Take"]

SPREADS: Final = 3
"""Elevation and roll stay within as many of their spreads."""
SIZES: Final = (0.6, 1.1)
"""Of a ball that is not in the middle, in units of the usual one's diameter."""
JITTER: Final = 0.3
"""Exposure jitter: stops up and down."""
TINT: Final = 0.12
"""White balance: standard deviation of each channel's logarithm."""
CACHED_BYTES: Final = 2 << 30
"""Panoramas kept in memory."""


@dataclass(frozen=True)
class PairOptions:
    """How pairs are drawn.

    Attributes:
        canvas: side of the pictures, pixels.
        diameter: of the ball, pixels.
        fov: of the photograph across its longer side, degrees.
        elevation: standard deviation of the camera's elevation, degrees, cut at three of them.
        roll: likewise of its roll.
        central: share of pairs with the ball in the middle; the others have one of another size elsewhere.
        ev_min: darkest exposure; they are uniform in [ev_min, 0].
        augment: mirror half of the panoramas, and vary exposure and white balance.
        seed: of the whole stream.
    """

    canvas: int = 1024
    diameter: int = 256
    fov: float = 60.0
    elevation: float = 12.0
    roll: float = 2.0
    central: float = 1.0
    ev_min: float = -5.0
    augment: bool = False
    seed: int = 1

    def __post_init__(self) -> None:
        place_ball(self.canvas, self.diameter)
        limits = {"fov": (1, 150), "elevation": (0, 28), "roll": (0, 60), "central": (0, 1), "ev_min": (-20, 0)}
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise OptionError(name, getattr(self, name), f"{low} to {high}")


@dataclass(frozen=True)
class Take:
    """A pair and how it came about.

    Attributes:
        pair: the pair.
        camera: in the panorama.
        frame: where the photograph lies on the canvas.
        scale: exposure: what the panorama's radiance is multiplied by at EV 0.
        tint: what its channels are multiplied by besides.
    """

    pair: Pair
    camera: Camera
    frame: Frame
    scale: float
    tint: tuple[float, float, float]


class PairSampler:
    """Draws pairs from panoramas, every panorama as often as any other.

    Args:
        panoramas: files by name.
        options: how.
        stream: name of a stream; those of different names have nothing in common.

    Raises:
        OptionError: no panoramas.
    """

    def __init__(self, panoramas: Mapping[str, Path], options: PairOptions, stream: str = "training") -> None:
        if not panoramas:
            raise OptionError("panoramas", "none", "one or more HDR maps")
        self.panoramas = dict(sorted(panoramas.items()))
        self.options = options
        self.stream = stream
        self._scenes: OrderedDict[str, Surroundings] = OrderedDict()

    def draw(self, index: int) -> Pair:
        """The pair of an index, 0 or more.

        Raises:
            ImageError: its panorama cannot be read any more.
        """
        return self.take(index).pair

    def take(self, index: int) -> Take:
        """The pair of an index with its camera; raises as `draw`."""
        options, generator = self.options, self._generator(index)
        name = self._name(index)
        scene = self._scene(name)
        camera, frame = self._camera(generator), self._frame(generator)
        ev = random_uniform(generator, options.ev_min, 0)
        ball = self._place(generator, frame)
        camera, jitter, tint = self._augmented(generator, camera)
        gains = torch.tensor(tint)
        photo = take_photograph(scene, camera, frame.height, frame.width) * gains
        scale = auto_exposure(photo) * jitter
        canvas = torch.zeros(1, options.canvas, options.canvas, 3)
        frame.cut(canvas).copy_(expose(photo * scale, 0.0))
        _blend(canvas, expose(take_ball(scene, camera, ball.diameter) * gains * scale, ev), ball)
        return Take(Pair(quantize(canvas), ball, ev, name), camera, frame, scale, tint)

    def _generator(self, *key: object) -> Generator:
        text = " ".join(str(part) for part in (self.options.seed, self.stream, *key))
        return torch.Generator().manual_seed(int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "big"))

    def _name(self, index: int) -> str:
        epoch, place = divmod(index, len(self.panoramas))
        order = torch.randperm(len(self.panoramas), generator=self._generator("order", epoch))
        return list(self.panoramas)[int(order[place])]

    def _scene(self, name: str) -> Surroundings:
        options = self.options
        scene = self._scenes.pop(name, None)
        if scene is None:
            latlong = read_envmap(self.panoramas[name])
            scene = Surroundings.of(latlong, options.canvas, options.fov, options.diameter)
        self._scenes[name] = scene
        while len(self._scenes) > 1 and sum(kept.nbytes for kept in self._scenes.values()) > CACHED_BYTES:
            self._scenes.popitem(last=False)
        return scene

    def _camera(self, generator: Generator) -> Camera:
        yaw = random_uniform(generator, -180, 180)
        pitch, roll = (
            spread * max(-SPREADS, min(SPREADS, float(torch.randn((), generator=generator))))
            for spread in (self.options.elevation, self.options.roll)
        )
        return Camera(yaw, pitch, roll, self.options.fov)

    def _frame(self, generator: Generator) -> Frame:
        aspect = ASPECTS[int(torch.randint(len(ASPECTS), (), generator=generator))]
        side = 12 * self.options.canvas  # so that the sides of every aspect are near whole numbers
        return photograph_frame(round(side / aspect), side, self.options.canvas)

    def _place(self, generator: Generator, frame: Frame) -> Ball:
        options = self.options
        central, size, across, down = torch.rand(4, generator=generator).tolist()
        if central < options.central:
            return place_ball(options.canvas, options.diameter)
        diameter = 2 * round(options.diameter * (SIZES[0] + (SIZES[1] - SIZES[0]) * size) / 2)
        diameter = max(16, min(diameter, options.canvas))
        x, y = (
            first + diameter / 2 + part * (side - diameter) if side > diameter else options.canvas / 2
            for first, side, part in ((frame.left, frame.width, across), (frame.top, frame.height, down))
        )
        return place_ball(options.canvas, diameter, x=x, y=y)

    def _augmented(self, generator: Generator, camera: Camera) -> tuple[Camera, float, tuple[float, float, float]]:
        """Drawn last and always, so that a pair differs by nothing else with and without."""
        mirrored = random_uniform(generator, 0, 1) < 0.5
        jitter = 2 ** random_uniform(generator, -JITTER, JITTER)
        red, green, blue = torch.exp(TINT * torch.randn(3, generator=generator)).tolist()
        if not self.options.augment:
            return camera, 1.0, (1.0, 1.0, 1.0)
        return Camera(camera.yaw, camera.pitch, camera.roll, camera.fov, mirrored), jitter, (red, green, blue)


@lru_cache(maxsize=32)
def _cover(diameter: int) -> Float[Tensor, "d d 1"]:
    return ball_coverage(diameter, samples=16)[..., None]


def _blend(canvas: Image, crop: BallImage, ball: Ball) -> None:
    """Paste a ball by the share of each pixel that it covers; the canvas is overwritten."""
    window = crop_ball(canvas, ball)
    window.copy_(torch.lerp(window, crop, _cover(ball.diameter)))
