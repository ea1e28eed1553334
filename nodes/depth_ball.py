"""DepthBallMask and CanvasToImage: the photograph on its canvas, where the ball goes, and the way back."""

from __future__ import annotations

from typing import Any

import torch
from comfy_api.latest import io

from ..dl_core.ball import (
    DEPTH_DISCS,
    Ball,
    disc_mask,
    fit_canvas,
    paint_depth,
    paste_on_photograph,
    photograph_disc,
    place_ball,
    require_canvas,
    unfit_canvas,
)
from ..dl_core.estimate import check_photograph
from .sockets import CATEGORY, BallSocket, as_finite_rgb, as_rgb, named_output

__all__ = ["AUTOMATIC", "CanvasToImage", "DepthBallMask", "depth_input", "given", "place_inputs", "size_inputs"]

AUTOMATIC = -1
"""Widget value that stands for "not given": ComfyUI's number widgets cannot be empty."""


def given(value: int) -> int | None:
    """The value of a widget that may stand for "not given"."""
    return None if value == AUTOMATIC else value


def depth_input(otherwise: str) -> Any:
    """Depth of the photograph.

    Args:
        otherwise: sentence on what is done without it.
    """
    return io.Image.Input(
        "depth",
        optional=True,
        tooltip=f"Depth of the photograph with near bright, such as MiDaS or Depth Anything give it. {otherwise}",
    )


def size_inputs() -> list[Any]:
    """Sizes of canvas and ball."""
    return [
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
    ]


def place_inputs() -> list[Any]:
    """Sizes of canvas and ball, and where the ball goes."""
    return [
        *size_inputs(),
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
    ]


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
                depth_input("Without one the scene counts as far away."),
                *place_inputs(),
                io.Int.Input(
                    "dilation",
                    default=AUTOMATIC,
                    min=AUTOMATIC,
                    max=2048,
                    tooltip="Pixels that the inpainted disc reaches past the ball on each side; -1 is the paper's 10 "
                    "per 1024 pixels of canvas.",
                ),
                io.Combo.Input(
                    "depth_disc",
                    options=list(DEPTH_DISCS),
                    default="ball",
                    optional=True,
                    tooltip="What the depth map shows of the ball. ball: the ball itself. authors: a disc of one pixel "
                    "more to the right and below, as the paper's code draws it.",
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
        depth_disc: str = "ball",
    ) -> io.NodeOutput:
        """Fit, place, paint."""
        photo = check_photograph(as_rgb(image, "image"))
        ball = place_ball(canvas, diameter, x=given(x), y=given(y), dilation=given(dilation), depth_disc=depth_disc)
        mask = disc_mask(ball, grow=ball.dilation)
        return io.NodeOutput(fit_canvas(photo, canvas), paint_depth(depth, ball), mask, ball)


class CanvasToImage(io.ComfyNode):  # type: ignore[misc]
    """Undoes the fitting of a photograph on its canvas."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="CanvasToImage",
            display_name="Canvas To Image",
            category=CATEGORY,
            description="Undoes Depth Ball Mask: brings what was painted on the canvas back to the photograph's frame "
            "and size. Outside the ball every pixel is the photograph's own.",
            inputs=[
                io.Image.Input("canvas_image", tooltip="A canvas with the ball: the composite of a node that paints."),
                io.Image.Input("image", tooltip="The photograph, as it went into Depth Ball Mask."),
                BallSocket.Input("ball", tooltip="Where the ball sits on the canvas."),
            ],
            outputs=[
                named_output(io.Image, "image", "The photograph at its own size, with the ball pasted in."),
                named_output(io.Image, "framed", "The canvas without its bars at the photograph's size, resampled."),
                named_output(io.Mask, "mask", "The ball's disc in the photograph's frame, with a soft edge."),
            ],
        )

    @classmethod
    def execute(cls, canvas_image: torch.Tensor, image: torch.Tensor, ball: Ball) -> io.NodeOutput:
        """Cut, resize, paste."""
        photo = check_photograph(as_rgb(image, "image"))
        composite = require_canvas(as_finite_rgb(canvas_image, "canvas_image"), ball)
        height, width = photo.shape[1:3]
        pasted = paste_on_photograph(photo, composite, ball)
        return io.NodeOutput(pasted, unfit_canvas(composite, height, width), photograph_disc(ball, height, width))
