"""BallGrid: places for balls in rows and columns."""

from __future__ import annotations

import torch
from comfy_api.latest import io

from ..dl_core.ball import photograph_frame
from ..dl_core.ball_grid import ball_grid
from .depth_ball import AUTOMATIC, given, size_inputs
from .sockets import CATEGORY, as_rgb, named_output

__all__ = ["BallGrid"]


class BallGrid(io.ComfyNode):  # type: ignore[misc]
    """Lists places on the canvas."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="BallGrid",
            display_name="Ball Grid",
            category=CATEGORY,
            description="Places for a ball in rows and columns, as lists: nodes that take x and y run once for each "
            "place. The paper looks at nine, to see how light varies over a scene.",
            inputs=[
                io.Image.Input(
                    "image",
                    optional=True,
                    tooltip="The photograph: the places then lie on it, and not on the bars beside it.",
                ),
                *size_inputs(),
                io.Int.Input("rows", default=3, min=1, max=100, tooltip="Rows of places. The paper: 3."),
                io.Int.Input("columns", default=3, min=1, max=100, tooltip="Columns of places. The paper: 3."),
                io.Int.Input(
                    "margin",
                    default=AUTOMATIC,
                    min=AUTOMATIC,
                    max=2048,
                    tooltip="Pixels to keep free around the outermost balls; -1 is how far the inpainted disc reaches "
                    "past the ball, 10 per 1024 pixels of canvas.",
                ),
            ],
            outputs=[
                named_output(io.Int, "x", "Column of the ball's centre at each place.", is_list=True),
                named_output(io.Int, "y", "Row of the ball's centre at each place.", is_list=True),
                named_output(io.String, "name", "Of each place, such as row1_column3, for file names.", is_list=True),
            ],
        )

    @classmethod
    def execute(
        cls,
        canvas: int,
        diameter: int,
        rows: int,
        columns: int,
        margin: int,
        image: torch.Tensor | None = None,
    ) -> io.NodeOutput:
        """Spread the places, from the top left row by row."""
        frame = None
        if image is not None:
            height, width = as_rgb(image, "image").shape[1:3]
            frame = photograph_frame(height, width, canvas)
        places = ball_grid(canvas, diameter, rows, columns, margin=given(margin), frame=frame)
        return io.NodeOutput(
            [place.x for place in places], [place.y for place in places], [place.name for place in places]
        )
