"""What the queued graph tells of the ControlNet that a node paints with."""

from __future__ import annotations

from typing import Any

import pytest
from comfy_host import pack_module


def graph(name: str) -> dict[str, Any]:
    return {
        "1": {"class_type": "ControlNetLoader", "inputs": {"control_net_name": name}},
        "2": {"class_type": "SetUnionControlNetType", "inputs": {"control_net": ["1", 0], "type": "auto"}},
        "3": {"class_type": "IterativeMedian", "inputs": {"control_net": ["2", 0], "steps": 30}},
    }


def doubt(prompt: dict[str, Any], node: str = "3") -> str | None:
    found: str | None = pack_module("nodes.provenance").control_net_doubt(prompt, node)
    return found


@pytest.mark.parametrize(
    "name",
    ["control-lora-canny-rank256.safetensors", "SDXL/controlnet_canny_sdxl.safetensors", "xl-CANNY.safetensors"],
)
def test_a_canny_controlnet_is_doubted_by_its_file(pack: Any, name: str) -> None:
    assert doubt(graph(name)) == (
        f"socket control_net: {name} looks like a ControlNet for canny; one for depth is wanted"
    )


@pytest.mark.parametrize(
    "name",
    [
        "controlnet-depth-sdxl-1.0.safetensors",
        "diffusion_pytorch_model.fp16.safetensors",
        "controlnet-union-canny-depth.safetensors",
        "promax_union_canny.safetensors",
        "cannyon.safetensors",
    ],
)
def test_others_are_not(pack: Any, name: str) -> None:
    assert doubt(graph(name)) is None


def test_a_file_that_cannot_be_found_is_not_doubted(pack: Any) -> None:
    loop = {"1": {"inputs": {"control_net": ["2", 0]}}, "2": {"inputs": {"control_net": ["1", 0]}}}
    for prompt, node in ((loop, "1"), ({}, "1"), ({"1": {"class_type": "MiniProbeLoader", "inputs": {}}}, "1")):
        assert doubt(prompt, node) is None
