"""BallToEquirect: the ball unwrapped to an environment map."""

from __future__ import annotations

import torch
from comfy_api.latest import io

from ..dl_core.ball import Ball, crop_ball, require_canvas
from ..dl_core.errors import ImageError
from ..dl_core.geometry import ball_to_latlong, camera_rotation, disc_coordinates, latlong_directions, rotate_latlong
from .sockets import CATEGORY, BallSocket, as_rgb, named_output

__all__ = ["BallToEquirect"]


class BallToEquirect(io.ComfyNode):  # type: ignore[misc]
    """Unwraps a mirror ball."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="BallToEquirect",
            display_name="Ball To Equirect",
            category=CATEGORY,
            description="Unwraps a mirror ball to an equirectangular map: up is up, the centre is where the camera "
            "looked, the right of the photograph is right of the centre.",
            inputs=[
                io.Image.Input("image", tooltip="A ball, cut out; or whole canvas images, with the ball connected."),
                BallSocket.Input("ball", optional=True, tooltip="Where the ball sits, to cut it out of canvas images."),
                io.Int.Input("height", default=256, min=2, max=4096, tooltip="Rows of the map; it is twice as wide."),
                io.Float.Input(
                    "yaw",
                    default=0.0,
                    min=-360.0,
                    max=360.0,
                    step=1.0,
                    tooltip="Degrees that the world is turned to the right on the map.",
                ),
                io.Int.Input(
                    "samples",
                    default=4,
                    min=1,
                    max=64,
                    tooltip="Samples along each side of a pixel of the map: more is smoother where the ball is thin.",
                ),
            ],
            outputs=[
                named_output(io.Image, "latlong", "The map, in the encoding of the image."),
                named_output(
                    io.Mask,
                    "coverage",
                    "1 where the ball shows a direction; 0 straight ahead, within half a pixel of its rim.",
                ),
            ],
        )

    @classmethod
    def execute(
        cls, image: torch.Tensor, height: int, yaw: float, samples: int, ball: Ball | None = None
    ) -> io.NodeOutput:
        """Cut out, unwrap, turn."""
        crop = _cut_out(as_rgb(image, "image"), ball)
        latlong = ball_to_latlong(crop, height, samples=samples, painted=True)
        coverage = _coverage(height, crop.shape[1])
        if yaw % 360:
            rotation = camera_rotation(yaw=yaw)
            latlong, coverage = (rotate_latlong(item, rotation) for item in (latlong, coverage))
        return io.NodeOutput(latlong, coverage[..., 0])


def _cut_out(image: torch.Tensor, ball: Ball | None) -> torch.Tensor:
    """The ball crop: the image as it is if it is no larger than the ball, cut out of the canvas otherwise."""
    if ball is not None and image.shape[1:3] != (ball.diameter, ball.diameter):
        return crop_ball(require_canvas(image, ball), ball)
    if image.shape[1] != image.shape[2]:
        raise ImageError("image", f"is {image.shape[2]} x {image.shape[1]} pixels; a square ball crop is accepted")
    return image


def _coverage(height: int, diameter: int) -> torch.Tensor:
    """Where a ball of a diameter holds samples: (1, height, 2 height, 1)."""
    radius = torch.linalg.norm(disc_coordinates(latlong_directions(height)), dim=-1)
    return (radius <= 1 - 1 / diameter).float()[None, :, :, None]
