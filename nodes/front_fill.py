"""FrontFill: the photograph as the front of its map."""

from __future__ import annotations

import torch
from comfy_api.latest import io

from ..dl_core.estimate import check_photograph
from ..dl_core.front_fill import FEATHER, FOV_RANGE, front_fill
from .mending import tilt_inputs
from .painting import one_picture
from .sockets import CATEGORY, as_rgb, named_output

__all__ = ["FrontFill"]


class FrontFill(io.ComfyNode):  # type: ignore[misc]
    """Fills the front of a map with the photograph."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        low, high = FOV_RANGE
        return io.Schema(
            node_id="FrontFill",
            display_name="Front Fill",
            category=CATEGORY,
            description="Fills the directions of a map that the photograph shows with the photograph. Where the "
            "photograph clips, the map keeps its radiance; everywhere else it stays as it is.",
            inputs=[
                io.Image.Input("latlong", tooltip="The map in linear radiance, white at EV 0 being 1."),
                io.Image.Input("photograph", tooltip="The photograph that the map was estimated from."),
                io.Float.Input(
                    "fov",
                    default=60.0,
                    min=low,
                    max=high,
                    step=0.1,
                    tooltip="Degrees that the photograph spans along its longer side.",
                ),
                *tilt_inputs(
                    "Degrees up that the camera looks on this map; 0 for a map that is not levelled.",
                    "Degrees clockwise that the camera is turned on this map; 0 for a map that is not levelled.",
                ),
                io.Float.Input(
                    "feather",
                    default=FEATHER,
                    min=0.0,
                    max=45.0,
                    step=0.1,
                    optional=True,
                    tooltip="Degrees inside the photograph's borders over which it takes over from the map.",
                ),
            ],
            outputs=[
                named_output(io.Image, "latlong", "The map with its front filled, in linear radiance."),
                named_output(io.Mask, "filled", "How much of each direction is the photograph's, 0 to 1."),
            ],
        )

    @classmethod
    def execute(
        cls,
        latlong: torch.Tensor,
        photograph: torch.Tensor,
        fov: float,
        pitch: float = 0.0,
        roll: float = 0.0,
        feather: float = FEATHER,
    ) -> io.NodeOutput:
        """Check, fill."""
        photo = check_photograph(one_picture(photograph, "photograph"), "photograph")
        filled = front_fill(as_rgb(latlong, "latlong"), photo, fov, pitch=pitch, roll=roll, feather=feather)
        return io.NodeOutput(filled.latlong_hdr, filled.weight)
