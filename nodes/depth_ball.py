"""DepthBallMask: the photograph on its canvas, and where the ball goes."""

from __future__ import annotations

import torch
from comfy_api.latest import io

from ..dl_core.ball import disc_mask, fit_canvas, paint_depth, place_ball
from ..dl_core.estimate import check_photograph
from .sockets import CATEGORY, BallSocket, as_rgb, named_output

__all__ = ["DepthBallMask"]

AUTOMATIC = -1
"""Widget value that stands for "not given": ComfyUI's number widgets cannot be empty."""


class DepthBallMask(io.ComfyNode):  # type: ignore[misc]
    """Fits a photograph on the canvas and places a ball on it."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="DepthBallMask",
            display_name="Depth Ball Mask",
            category=CATEGORY,
            description="Fits the photograph into a square canvas (black bars, aspect kept) and places the ball on it: "
            "a white disc on the depth map, since the ball is nearest, and a slightly larger disc to inpaint.",
            inputs=[
                io.Image.Input("image", tooltip="One photograph, any size."),
                io.Image.Input(
                    "depth",
                    optional=True,
                    tooltip="Depth of the photograph with near bright, such as MiDaS or Depth Anything give it. "
                    "Without one the scene counts as far away.",
                ),
                io.Int.Input(
                    "canvas",
                    default=1024,
                    min=64,
                    max=4096,
                    step=8,
                    tooltip="Side of the canvas in pixels: 1024 for SDXL, 256 for the mini model.",
                ),
                io.Int.Input(
                    "diameter",
                    default=256,
                    min=16,
                    max=4096,
                    tooltip="Of the ball in pixels: 256 on SDXL's canvas, 128 on the mini model's.",
                ),
                io.Int.Input(
                    "x",
                    default=AUTOMATIC,
                    min=AUTOMATIC,
                    max=4096,
                    tooltip="Column of the ball's centre on the canvas; -1 is the middle.",
                ),
                io.Int.Input(
                    "y",
                    default=AUTOMATIC,
                    min=AUTOMATIC,
                    max=4096,
                    tooltip="Row of the ball's centre on the canvas; -1 is the middle.",
                ),
                io.Int.Input(
                    "dilation",
                    default=AUTOMATIC,
                    min=AUTOMATIC,
                    max=2048,
                    tooltip="Pixels that the inpainted disc reaches past the ball on each side; -1 is the paper's 10 "
                    "per 1024 pixels of canvas.",
                ),
            ],
            outputs=[
                named_output(io.Image, "canvas_image", "The photograph on its canvas."),
                named_output(io.Image, "control_depth", "The depth map with the ball painted nearest, for ControlNet."),
                named_output(io.Mask, "mask", "The disc to inpaint."),
                named_output(BallSocket, "ball", "Where the ball sits."),
            ],
        )

    @classmethod
    def execute(
        cls,
        image: torch.Tensor,
        canvas: int,
        diameter: int,
        x: int,
        y: int,
        dilation: int,
        depth: torch.Tensor | None = None,
    ) -> io.NodeOutput:
        """Fit, place, paint."""
        photo = check_photograph(as_rgb(image, "image"))
        ball = place_ball(canvas, diameter, x=_given(x), y=_given(y), dilation=_given(dilation))
        mask = disc_mask(ball, grow=ball.dilation)
        return io.NodeOutput(fit_canvas(photo, canvas), paint_depth(depth, ball), mask, ball)


def _given(value: int) -> int | None:
    return None if value == AUTOMATIC else value
