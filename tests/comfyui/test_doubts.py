"""What a report says of choices that hardly give what was wanted."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from comfy_host import pack_module
from lora_files import RandomLora, attention_layers


def queued(name: str) -> dict[str, Any]:
    return {
        "1": {"class_type": "ControlNetLoader", "inputs": {"control_net_name": name}},
        "2": {"class_type": "SetUnionControlNetType", "inputs": {"control_net": ["1", 0], "type": "auto"}},
        "3": {"class_type": "IterativeMedian", "inputs": {"control_net": ["2", 0], "steps": 30}},
    }


def doubt(prompt: dict[str, Any], node: str = "3") -> str | None:
    found: str | None = pack_module("nodes.doubts").control_net_doubt(prompt, node)
    return found


@pytest.mark.parametrize(
    "name",
    ["control-lora-canny-rank256.safetensors", "SDXL/controlnet_canny_sdxl.safetensors", "xl-CANNY.safetensors"],
)
def test_a_canny_controlnet_is_doubted_by_its_file(pack: Any, name: str) -> None:
    assert doubt(queued(name)) == (
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
    assert doubt(queued(name)) is None


def test_a_file_that_cannot_be_found_is_not_doubted(pack: Any) -> None:
    loop = {"1": {"inputs": {"control_net": ["2", 0]}}, "2": {"inputs": {"control_net": ["1", 0]}}}
    for prompt, node in ((loop, "1"), ({}, "1"), ({"1": {"class_type": "MiniProbeLoader", "inputs": {}}}, "1")):
        assert doubt(prompt, node) is None


def report_of(node: Any, graph: Any, scene: Any, preset: str, **change: Any) -> str:
    options = {"preset": preset, "balls": 1, "rounds": 0, "strength": 0.8, "final": False, "steps": 2, "seed": 0}
    options |= {"cfg": 1.0, "sampler": "euler", "scheduler": "leading (paper)", "control_strength": 0.5}
    sockets = {**graph.sockets(), "image": scene.canvas, "depth": scene.depth, "ball": scene.ball, "batch_size": 1}
    report: str = node("IterativeMedian").execute(**{**sockets, **options, **change}).args[4]
    return report


def test_turbo_without_its_swap_is_remarked(node: Any, graph: Any, scene: Any, generator: torch.Generator) -> None:
    swap = "preset turbo without Turbo LoRA Swap"
    assert swap in report_of(node, graph, scene, "turbo")
    assert swap not in report_of(node, graph, scene, "turbo", ev=-2.5)  # once a bracket
    assert swap not in report_of(node, graph, scene, "custom")
    layers = attention_layers(pack_module("dl_core.backends.diffusers_lora").lora_shapes(graph.mini.unet))
    names = pack_module("dl_core.lora_names").comfyui_layers(layers)
    lora = RandomLora.on(layers, generator).written("peft", names)
    swapped = pack_module("nodes.lora").with_lora_swap(graph.model, lora, lora, pack_module("dl_core.lora").LoraSwap())
    assert swap not in report_of(node, graph, scene, "turbo", model=swapped)


def test_a_doubted_controlnet_is_in_the_report(
    node: Any, graph: Any, scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from comfy_api.latest import io

    hidden = io.HiddenHolder.from_dict({io.Hidden.prompt: queued("canny.x"), io.Hidden.unique_id: "3"})
    monkeypatch.setattr(node("IterativeMedian"), "hidden", hidden)
    assert "canny.x looks like a ControlNet for canny" in report_of(node, graph, scene, "custom")
