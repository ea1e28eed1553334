"""LightModel: the smallest light that stands for an environment map."""

from __future__ import annotations

import json
from typing import Any

import torch
from comfy_api.latest import io

from ..dl_core.lights.choose import Decision, choose_light
from ..dl_core.lights.describe import describe
from ..dl_core.lights.picture import decision_picture
from ..dl_core.spheres import MATERIALS
from .sockets import CATEGORY, as_rgb, named_output

__all__ = ["LightModel"]


class LightModel(io.ComfyNode):  # type: ignore[misc]
    """Chooses harmonics and lights for a map."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="LightModel",
            display_name="Light Model",
            category=CATEGORY,
            description="Finds the smallest light that stands for a map: ambient light, spherical harmonics, harmonics "
            "with a few directional or area lights, or the map itself. Its spheres match the map's within a tolerance.",
            inputs=[
                io.Image.Input("latlong", tooltip="A map in linear radiance, twice as wide as high."),
                io.Float.Input(
                    "tolerance",
                    default=0.05,
                    min=0.001,
                    max=0.99,
                    step=0.001,
                    tooltip="Accepted difference of the worst sphere: its RMS relative to the RMS under the full map.",
                ),
                *(
                    io.Boolean.Input(
                        name, default=name == "diffuse", tooltip=f"Whether the {name} sphere has to match."
                    )
                    for name in MATERIALS
                ),
            ],
            outputs=[
                named_output(
                    io.Image,
                    "latlong",
                    "The map of the light that was chosen, in linear radiance; its harmonics are raised to 0 where "
                    "they are negative.",
                ),
                named_output(
                    io.String,
                    "report",
                    "What was chosen, as JSON: model, price, errors, lights, harmonics; a list for several maps.",
                ),
                named_output(
                    io.Image, "picture", "Spheres under the full map and under the light chosen, and a chart of errors."
                ),
            ],
        )

    @classmethod
    def execute(cls, latlong: torch.Tensor, tolerance: float, **materials: bool) -> io.NodeOutput:
        """Decide for every map of the batch."""
        maps = as_rgb(latlong, "latlong").float().split(1)
        wanted = tuple(name for name, asked in materials.items() if asked)
        decisions = [choose_light(one, tolerance, wanted) for one in maps]
        pairs = list(zip(maps, decisions, strict=True))
        return io.NodeOutput(
            torch.cat([_rebuilt(*pair) for pair in pairs]),
            _report(decisions),
            torch.stack([decision_picture(*pair) for pair in pairs]),
        )


def _rebuilt(latlong: torch.Tensor, decision: Decision) -> torch.Tensor:
    """The map of the chosen light, of the same size; the map itself where that was chosen."""
    model = decision.chosen.model
    return latlong if model is None else model.radiance_map(latlong.shape[1]).to(latlong)


def _report(decisions: list[Decision]) -> str:
    facts: list[dict[str, Any]] = [describe(decision) for decision in decisions]
    return json.dumps(facts[0] if len(facts) == 1 else facts, indent=1)
