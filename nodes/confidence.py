"""ConfidenceMap: how far the balls agree, unwrapped, and what error of the map to expect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from comfy_api.latest import io

from ..dl_core.confidence import bracket_spread, confidence_of
from ..dl_core.errors import OptionError
from .painting import one_picture
from .sockets import CATEGORY, as_rgb, named_output

__all__ = ["CONFIDENCE_TOOLTIP", "ConfidenceMap"]

CONFIDENCE_TOOLTIP = (
    "By direction, the ratio of the smaller to the larger of estimate and truth to expect: 1 sure, 0.5 a stop off."
)


class ConfidenceMap(io.ComfyNode):  # type: ignore[misc]
    """Says where a map can be trusted."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="ConfidenceMap",
            display_name="Confidence Map",
            category=CATEGORY,
            description="Where the balls of a bracket disagree, the light is not known: their spread, how far each "
            "direction is from what the photograph shows, and what error of the map follows, as measured.",
            is_input_list=True,
            inputs=[
                io.Image.Input("balls", tooltip="All balls of the last round at each EV, as a list of batches."),
                io.Float.Input("ev", force_input=True, tooltip="The EVs of the balls, as a list: 0 first, descending."),
                io.Image.Input("latlong", tooltip="The map made of them, as it was unwrapped: not turned by yaw."),
            ],
            outputs=[
                named_output(io.Mask, "confidence", CONFIDENCE_TOOLTIP),
                named_output(io.Image, "picture", "The same as a picture: white is sure."),
                named_output(io.Float, "expected_error", "Stops, the mean over the sphere."),
                named_output(io.String, "report", "The number, and how it was calibrated."),
            ],
        )

    @classmethod
    def execute(
        cls, balls: Sequence[torch.Tensor], ev: Sequence[float], latlong: Sequence[torch.Tensor]
    ) -> io.NodeOutput:
        """Judge one bracket; every input is a list."""
        if len(latlong) != 1:
            raise OptionError("latlong", f"{len(latlong)} maps", "one map, of the balls of one photograph")
        opinions: list[Any] = [as_rgb(batch, "balls") for batch in balls]
        spread = bracket_spread(opinions, ev)
        found = confidence_of(spread, one_picture(latlong[0], "latlong"))
        trusted = found.map[..., 0]
        return io.NodeOutput(trusted, trusted[..., None].expand(-1, -1, -1, 3), found.expected_error, found.line())
