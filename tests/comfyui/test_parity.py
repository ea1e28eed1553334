"""SDXL's true topology and the mini model, in ComfyUI and in diffusers, stage by stage."""

from __future__ import annotations

from typing import Any

from parity import Pair, mini_pair, stages, toy_pair


def faults(pair: Pair, steps: int) -> list[str]:
    return [
        f"{stage.name}: {stage.difference:.2e} {stage.measure}, {stage.tolerance:.0e} allowed"
        for stage in stages(pair, steps)
        if not stage.difference <= stage.tolerance
    ]


def test_sdxls_topology_agrees_with_diffusers_pipeline(pack: Any) -> None:
    assert faults(toy_pair(), steps=4) == []


def test_the_mini_model_agrees_with_diffusers_pipeline(trained: Any) -> None:
    assert faults(mini_pair(trained), steps=4) == []
