"""BallToEquirect and EquirectToBall: between the ball and an environment map."""

from __future__ import annotations

from typing import Any

import torch
from comfy_api.latest import io

from ..dl_core.ball import Ball, crop_ball, require_canvas
from ..dl_core.ball_fit import BallFit
from ..dl_core.errors import ImageError, OptionError
from ..dl_core.geometry import ball_to_latlong, camera_rotation, latlong_coverage, latlong_to_ball, rotate_latlong
from ..dl_core.projection import PROJECTIONS
from .sockets import CATEGORY, BallFitSocket, BallSocket, as_finite_rgb, as_rgb, named_output

__all__ = ["BallToEquirect", "EquirectToBall", "camera_inputs"]


def _yaw_input(turned: str) -> io.Input:
    return io.Float.Input(
        "yaw",
        default=0.0,
        min=-360.0,
        max=360.0,
        step=1.0,
        tooltip=f"Degrees that the world is turned to the right {turned}.",
    )


def camera_inputs(
    frame: str | None,
    *,
    fov: str = "Degrees that the whole picture spans along its longer side; used by perspective.",
) -> list[io.Input]:
    """Widgets for how the camera sees the ball, the same on all nodes; appended, so that saved workflows load.

    Args:
        frame: tooltip of the width of the whole picture; None where a node knows it.
        fov: tooltip of the field of view.
    """
    inputs = [
        io.Combo.Input(
            "projection",
            options=list(PROJECTIONS),
            optional=True,
            tooltip="orthographic as in the paper, or perspective with the field of view below.",
        ),
        io.Float.Input(
            "fov",
            default=60.0,
            min=1.0,
            max=179.0,
            step=1.0,
            optional=True,
            tooltip=fov,
        ),
    ]
    if frame is not None:
        inputs.append(io.Float.Input("frame", default=4.0, min=1.0, max=64.0, step=0.1, optional=True, tooltip=frame))
    return inputs


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
                _yaw_input("on the map"),
                io.Int.Input(
                    "samples",
                    default=1,
                    min=1,
                    max=8,
                    tooltip="Samples along each side of a ball pixel; the footprint of each pixel of the map is always "
                    "covered, so 1 is enough.",
                ),
                *camera_inputs(
                    "Ball crops without a ball connected: how many ball diameters the whole picture is wide; "
                    "used by perspective."
                ),
                BallFitSocket.Input(
                    "fit",
                    optional=True,
                    tooltip="Radius and centre as Fit Ball found them; the ball has to be connected too.",
                ),
                io.Float.Input(
                    "inset",
                    default=0.0,
                    min=-16.0,
                    max=16.0,
                    step=0.25,
                    optional=True,
                    tooltip="Pixels of the crop that the ball's edge lies inside the crop's, without a fit. The "
                    "authors' unwrap takes 0.5 of a ball of 256.",
                ),
            ],
            outputs=[
                named_output(io.Image, "latlong", "The map, in the encoding of the image."),
                named_output(
                    io.Mask,
                    "coverage",
                    "1 where the ball shows a direction; 0 straight ahead, within half a pixel of its rim, and in the "
                    "cone behind a ball in perspective.",
                ),
            ],
        )

    @classmethod
    def execute(
        cls,
        image: torch.Tensor,
        height: int,
        yaw: float,
        samples: int,
        ball: Ball | None = None,
        projection: str = "orthographic",
        fov: float = 60.0,
        frame: float = 4.0,
        fit: BallFit | None = None,
        inset: float = 0.0,
    ) -> io.NodeOutput:
        """Cut out, unwrap, turn."""
        crop = _cut_out(as_finite_rgb(image, "image"), ball)
        size = crop.shape[1]
        circle = _circle(fit, ball, size / 2 - inset)
        camera = PROJECTIONS[projection](fov, *_picture(size, frame, ball))
        latlong = ball_to_latlong(crop, height, samples=samples, painted=True, projection=camera, **circle)
        coverage = latlong_coverage(height, size, projection=camera, **circle)[..., None]
        if yaw % 360:
            rotation = camera_rotation(yaw=yaw)
            latlong, coverage = (rotate_latlong(item, rotation) for item in (latlong, coverage))
        return io.NodeOutput(latlong, coverage[..., 0])


def _circle(fit: BallFit | None, ball: Ball | None, radius: float) -> dict[str, Any]:
    """Radius and centre of a fitted ball in its crop; without a fit the radius given, in the middle.

    Raises:
        OptionError: a fit without the ball it belongs to.
    """
    if fit is None:
        return {"radius": radius}
    if ball is None:
        raise OptionError("ball", None, "the ball that was fitted, whose crop the image is")
    return {"radius": fit.radius, "centre": (fit.centre[0] - ball.left, fit.centre[1] - ball.top)}


def _picture(size: int, frame: float, ball: Ball | None) -> tuple[float, tuple[float, float]]:
    """Side and middle of the whole picture, in pixels of a ball crop of a size, from its top-left corner."""
    if ball is None:
        return frame * size, (size / 2, size / 2)
    return float(ball.canvas), (ball.canvas / 2 - ball.left, ball.canvas / 2 - ball.top)


class EquirectToBall(io.ComfyNode):  # type: ignore[misc]
    """Shows a map on a mirror ball."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="EquirectToBall",
            display_name="Equirect To Ball",
            category=CATEGORY,
            description="The mirror ball that a camera sees in the light of an equirectangular map: the inverse of "
            "Ball To Equirect.",
            inputs=[
                io.Image.Input("latlong", tooltip="A map, twice as wide as high; normally linear radiance."),
                io.Int.Input("diameter", default=256, min=8, max=4096, tooltip="Side of the ball's picture, pixels."),
                _yaw_input("before it is shown"),
                *camera_inputs("How many ball diameters the whole picture is wide; used by perspective."),
            ],
            outputs=[named_output(io.Image, "ball_image", "The ball, black around it, in the encoding of the map.")],
        )

    @classmethod
    def execute(
        cls,
        latlong: torch.Tensor,
        diameter: int,
        yaw: float,
        projection: str = "orthographic",
        fov: float = 60.0,
        frame: float = 4.0,
    ) -> io.NodeOutput:
        """Turn, reflect."""
        latlong = as_rgb(latlong, "latlong")
        if yaw % 360:
            latlong = rotate_latlong(latlong, camera_rotation(yaw=yaw))
        camera = PROJECTIONS[projection](fov, *_picture(diameter, frame, None))
        return io.NodeOutput(latlong_to_ball(latlong, diameter, projection=camera))


def _cut_out(image: torch.Tensor, ball: Ball | None) -> torch.Tensor:
    """The ball crop: the image as it is if it is no larger than the ball, cut out of the canvas otherwise."""
    if ball is not None and image.shape[1:3] != (ball.diameter, ball.diameter):
        return crop_ball(require_canvas(image, ball), ball)
    if image.shape[1] != image.shape[2]:
        raise ImageError("image", f"is {image.shape[2]} x {image.shape[1]} pixels; a square ball crop is accepted")
    return image
