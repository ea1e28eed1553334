"""How a camera sees a mirror ball: points of the picture to reflected directions and back.

Points are given on the ball's disc, in radii from its centre, x right and y up, so that neither the size of the ball
nor its place in a crop matters here. World axes are those of `geometry`: the camera looks along -Z.

Orthographic: the disc point (x, y) has the normal n = (x, y, sqrt(1 - x² - y²)) and reflects r = 2 (n·v) n - v with
v = +Z. The map is equal-area, dω = 4 dx dy, and the whole rim is one direction, straight ahead.

Perspective: a pinhole at distance d (in ball radii) from the centre. By symmetry about the line from pinhole to
centre, a normal at the angle α to that line reflects to the angle β(α) = 2 α + atan2(sin α, d - cos α), which grows
monotonically, so that it is inverted by Newton's method. The tangent rays end at β = π - ψ with sin ψ = 1 / d: what
lies within ψ of the direction behind the ball is never seen. Off the optical axis the outline is an ellipse.

Source: DiffusionLight, Sec. 4 (orthographic); the perspective case follows from the law of reflection.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import torch
from jaxtyping import Bool
from torch import Tensor

from .errors import OptionError
from .shapes import Directions, Disc

__all__ = [
    "ORTHOGRAPHIC",
    "PROJECTIONS",
    "Lens",
    "Orthographic",
    "Perspective",
    "Projection",
    "disc_coordinates",
    "disc_directions",
]


def disc_directions(disc: Disc) -> Directions:
    """Directions reflected to an orthographic viewer at +Z by the points of a unit mirror ball's disc.

    Args:
        disc: (..., 2), x right and y up, with x² + y² <= 1; points outside reflect as the rim does.
    """
    x, y = disc.unbind(-1)
    squared = (x * x + y * y).clamp(max=1)
    twice_normal_z = 2 * torch.sqrt(1 - squared)
    return torch.stack((twice_normal_z * x, twice_normal_z * y, 1 - 2 * squared), dim=-1)


def disc_coordinates(directions: Directions) -> Disc:
    """Where on the unit disc a direction is reflected: the inverse of `disc_directions`.

    Straight ahead (0, 0, -1) is the whole rim; it gets the rim's rightmost point.

    Args:
        directions: (..., 3) unit vectors.
    """
    x, y, z = directions.unbind(-1)
    transverse = torch.hypot(x, y)
    # sqrt((1 - z) / 2) loses its digits near the centre, transverse / sqrt(2 + 2z) near the rim.
    radius = torch.where(z > 0, transverse / torch.sqrt(2 + 2 * z.clamp(min=0)), torch.sqrt((1 - z).clamp(min=0) / 2))
    on_axis = transverse < torch.finfo(transverse.dtype).tiny  # below it the quotient overflows
    scale = radius / torch.where(on_axis, torch.ones_like(transverse), transverse)
    return torch.stack((torch.where(on_axis, radius, scale * x), scale * y), dim=-1)


@runtime_checkable
class Lens(Protocol):
    """A projection applied to one ball: between points of its disc and directions of the world."""

    @property
    def equal_area(self) -> bool:
        """Whether every part of the disc reflects as much of the sphere as any other of its size."""

    @property
    def axis(self) -> tuple[float, float, float]:
        """Unit vector from the camera to the ball's centre: the direction the ball shows at its outline, or never."""

    def reflect(self, disc: Disc) -> Directions:
        """Directions that the points (..., 2) reflect; points off the ball reflect as its outline does."""

    def locate(self, directions: Directions) -> Disc:
        """Points (..., 2) that reflect the directions (..., 3); unseen ones get the nearest point of the outline."""

    def on_ball(self, disc: Disc) -> Bool[Tensor, "*n"]:
        """Whether points lie on the ball."""

    def sees(self, directions: Directions) -> Bool[Tensor, "*n"]:
        """Whether directions are seen on the ball at all."""


@dataclass(frozen=True)
class _Parallel:
    """All rays parallel to -Z."""

    equal_area: bool = True
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0)

    def reflect(self, disc: Disc) -> Directions:
        return disc_directions(disc)

    def locate(self, directions: Directions) -> Disc:
        return disc_coordinates(directions)

    def on_ball(self, disc: Disc) -> Bool[Tensor, "*n"]:
        return disc.square().sum(-1) <= 1

    def sees(self, directions: Directions) -> Bool[Tensor, "*n"]:
        return torch.ones(directions.shape[:-1], dtype=torch.bool, device=directions.device)


@dataclass(frozen=True)
class _Pinhole:
    """Rays through a point.

    Attributes:
        focal: distance of the picture plane, in ball radii on the picture.
        middle: where the optical axis meets the picture, from the ball's centre, in radii.
    """

    focal: float
    middle: tuple[float, float]
    equal_area: bool = False

    @property
    def axis(self) -> tuple[float, float, float]:
        """Unit vector from the pinhole to the ball's centre."""
        x, y, z = -self.middle[0], -self.middle[1], -self.focal
        length = math.sqrt(x * x + y * y + z * z)
        return x / length, y / length, z / length

    @property
    def distance(self) -> float:
        """From the pinhole to the ball's centre, in the ball's true radii.

        The outline's smaller half-axis is 1: sin² ψ = cos² δ / (1 + f²), δ the angle off the optical axis.
        """
        return math.sqrt(1 + self.focal**2) / -self.axis[2]

    def reflect(self, disc: Disc) -> Directions:
        x = disc[..., 0] - self.middle[0]
        y = disc[..., 1] - self.middle[1]
        rays = torch.nn.functional.normalize(torch.stack((x, y, torch.full_like(x, -self.focal)), dim=-1), dim=-1)
        centre = disc.new_tensor(self.axis) * self.distance
        along = rays @ centre
        gap = (along.square() - (self.distance**2 - 1)).clamp(min=0)
        normals = torch.nn.functional.normalize((along - torch.sqrt(gap))[..., None] * rays - centre, dim=-1)
        return rays - 2 * (rays * normals).sum(-1, keepdim=True) * normals

    def locate(self, directions: Directions) -> Disc:
        axis = directions.new_tensor(self.axis)
        toward = -(directions @ axis)
        across = directions + toward[..., None] * axis
        length = torch.linalg.norm(across, dim=-1, keepdim=True)
        # Straight behind the ball there is no azimuth, and nothing is seen: any point of the outline will do.
        sideways = torch.nn.functional.normalize(torch.linalg.cross(axis, axis.new_tensor([0.0, 1.0, 0.0])), dim=-1)
        across = torch.where(length > 0, across / length.clamp(min=1e-20), sideways)
        alpha = self._normal_angle(torch.atan2(length[..., 0], toward))[..., None]
        point = (self.distance - torch.cos(alpha)) * axis + torch.sin(alpha) * across
        return point[..., :2] * (self.focal / -point[..., 2:]) + directions.new_tensor(self.middle)

    def _normal_angle(self, beta: Tensor) -> Tensor:
        """α of β, at most that of the tangent rays: Newton's steps from a convex side, exact after four."""
        d = self.distance
        alpha = beta * ((d - 1) / (2 * d - 1))
        for _ in range(5):
            cos, sin = torch.cos(alpha), torch.sin(alpha)
            excess = 2 * alpha + torch.atan2(sin, d - cos) - beta
            alpha = (alpha - excess / (2 + (d * cos - 1) / (d * d - 2 * d * cos + 1))).clamp(0, math.acos(1 / d))
        return alpha

    def on_ball(self, disc: Disc) -> Bool[Tensor, "*n"]:
        x = disc[..., 0] - self.middle[0]
        y = disc[..., 1] - self.middle[1]
        axis_x, axis_y, axis_z = self.axis
        along = x * axis_x + y * axis_y - self.focal * axis_z
        return along.square() >= (1 - 1 / self.distance**2) * (x * x + y * y + self.focal**2)

    def sees(self, directions: Directions) -> Bool[Tensor, "*n"]:
        return directions @ directions.new_tensor(self.axis) <= math.sqrt(1 - 1 / self.distance**2)


@runtime_checkable
class Projection(Protocol):
    """A camera, before it is known where in its picture the ball is."""

    def lens(self, radius: float, centre: tuple[float, float], size: int) -> Lens:
        """The projection of one ball.

        Args:
            radius: of the ball in pixels; off the optical axis half the outline's shorter axis.
            centre: (x, y) where the ball's centre is seen, in pixels from the crop's top-left corner.
            size: side of the crop.
        """


@dataclass(frozen=True)
class Orthographic:
    """A camera infinitely far away: the paper's."""

    def lens(self, radius: float, centre: tuple[float, float], size: int) -> Lens:
        """The same for every ball."""
        return _Parallel()


@dataclass(frozen=True)
class Perspective:
    """A pinhole camera.

    Attributes:
        fov: field of view across `frame`, degrees, above 0 and below 180.
        frame: longer side of the whole picture that the ball crop was cut out of, pixels of the crop's size.
        middle: (x, y) of the picture's middle, in pixels from the crop's top-left corner; the crop's middle when not
            given (a ball in the middle of the picture).
    """

    fov: float
    frame: float
    middle: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Check the camera.

        Raises:
            OptionError: a field of view or frame out of range.
        """
        if not 0 < self.fov < 180:
            raise OptionError("fov", self.fov, "above 0 and below 180 degrees")
        if not (self.frame > 0 and math.isfinite(self.frame)):
            raise OptionError("frame", self.frame, "the longer side of the picture in pixels, above 0")

    def lens(self, radius: float, centre: tuple[float, float], size: int) -> Lens:
        """The ball's own view.

        Raises:
            OptionError: a ball so large or so far aside that the camera would be inside it or beside its picture.
        """
        focal = self.frame / 2 / math.tan(math.radians(self.fov) / 2)
        middle = (size / 2, size / 2) if self.middle is None else self.middle
        return _Pinhole(focal / radius, ((middle[0] - centre[0]) / radius, (centre[1] - middle[1]) / radius))


ORTHOGRAPHIC: Final = Orthographic()

PROJECTIONS: Final[dict[str, Callable[[float, float, tuple[float, float] | None], Projection]]] = {
    "orthographic": lambda fov, frame, middle: ORTHOGRAPHIC,
    "perspective": Perspective,
}
"""Cameras by name, made of (fov in degrees, frame in pixels, middle of the picture); a new one is a new row."""
