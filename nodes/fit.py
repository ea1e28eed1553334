"""FitBall: where a painted ball really is."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from comfy_api.latest import io

from ..dl_core.ball import Ball, require_canvas
from ..dl_core.ball_fit import BallFit, fit_ball
from ..dl_core.errors import ImageError
from ..dl_core.projection import PROJECTIONS
from .equirect import camera_inputs
from .sockets import CATEGORY, BallFitSocket, BallSocket, as_rgb, named_output

__all__ = ["FitBall"]


class FitBall(io.ComfyNode):  # type: ignore[misc]
    """Fits radius and centre of a painted ball."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="FitBall",
            display_name="Fit Ball",
            category=CATEGORY,
            description="Measures radius and centre of a painted ball by what its rim mirrors of the photograph. Half "
            "a pixel of radius moves a light near the rim by degrees. Where the rim does not tell, the circle asked "
            "for is kept, and the report says why.",
            is_input_list=True,
            inputs=[
                io.Image.Input(
                    "balls", tooltip="Balls as they were painted, cut out; of a list of exposures the first, EV 0."
                ),
                io.Image.Input("photograph", tooltip="The canvas image of Depth Ball Mask."),
                BallSocket.Input("ball", tooltip="Where the ball was to be painted."),
                *camera_inputs(None, fov="Degrees that the canvas spans, whatever the projection."),
            ],
            outputs=[
                named_output(BallFitSocket, "fit", "Radius and centre, for Ball To Equirect."),
                named_output(io.String, "report", "What was measured, and how well."),
            ],
        )

    @classmethod
    def execute(
        cls,
        balls: Sequence[torch.Tensor],
        photograph: Sequence[torch.Tensor],
        ball: Sequence[Ball],
        projection: Sequence[str] = ("orthographic",),
        fov: Sequence[float] = (60.0,),
    ) -> io.NodeOutput:
        """Fit the first ball; every input is a list."""
        place = ball[0]
        canvas = require_canvas(as_rgb(photograph[0], "photograph")[:1], place)
        camera = PROJECTIONS[projection[0]](fov[0], float(place.canvas), None)
        painted = _on_canvas(as_rgb(balls[0], "balls")[:1], canvas, place)
        found = fit_ball(painted, place, fov=fov[0], projection=camera, photograph_ldr=canvas)
        return io.NodeOutput(found, _report(found))


def _on_canvas(crop: torch.Tensor, canvas: torch.Tensor, ball: Ball) -> torch.Tensor:
    """The canvas with the whole square of a ball crop in it: the disc would cut off what is beyond the circle."""
    if crop.shape[1:3] != (ball.diameter, ball.diameter):
        raise ImageError(
            "balls", f"are {crop.shape[2]} x {crop.shape[1]} pixels; the ball's are {ball.diameter} x {ball.diameter}"
        )
    painted = canvas.clone()
    painted[:, ball.top : ball.top + ball.diameter, ball.left : ball.left + ball.diameter] = crop
    return painted


def _report(found: BallFit) -> str:
    circle = f"radius {found.radius:.2f} px, centre ({found.centre[0]:.2f}, {found.centre[1]:.2f})"
    if not found.clear:
        return f"Kept the circle asked for, {circle}: {found.reason}."
    return f"Fitted {circle}; standard deviations {', '.join(f'{sigma:.3f}' for sigma in found.sigma)} px."
