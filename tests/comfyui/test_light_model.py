"""LightModel: what it passes on for one map and for several, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import torch
from comfy_host import pack_module

Nodes = Callable[[str], Any]
DIFFUSE = {"diffuse": True, "matte": False, "mirror": False}


@pytest.fixture(scope="module")
def even() -> torch.Tensor:
    return torch.ones(1, 16, 32, 3) * torch.tensor([1.0, 0.5, 0.25])


def test_an_even_map_is_ambient_light(node: Nodes, even: torch.Tensor) -> None:
    everything = {"diffuse": True, "matte": True, "mirror": True}
    latlong, report, picture = node("LightModel").execute(even, 0.01, **everything).args
    facts = json.loads(report)
    assert (facts["model"], facts["parameters"], facts["lights"]) == ("ambient", 3, [])
    assert facts["relative_error"] < 0.001
    torch.testing.assert_close(latlong, even, rtol=1e-5, atol=0)
    assert picture.ndim == 4
    assert picture.shape[0] == 1
    assert picture.shape[-1] == 3
    assert picture.max() <= 1


def test_every_map_of_a_batch_is_decided(node: Nodes, even: torch.Tensor) -> None:
    lamp = even.clone()
    lamp[0, 4, 20] = 300.0
    latlong, report, picture = node("LightModel").execute(torch.cat((even, lamp)), 0.05, **DIFFUSE).args
    first, second = json.loads(report)
    assert first["model"] == "ambient"
    assert second["model"] == "sh2 + 1 directional"
    assert len(latlong) == len(picture) == 2
    assert latlong[1].max() > 10 * latlong[0].max()
    assert (picture[0] != picture[1]).any()


def test_where_the_full_map_is_needed_it_is_passed_on(node: Nodes, generator: torch.Generator) -> None:
    busy = torch.rand(1, 32, 64, 3, generator=generator) ** 8
    latlong, report, _ = node("LightModel").execute(busy, 0.01, diffuse=False, matte=False, mirror=True).args
    assert json.loads(report)["model"] == "full map"
    assert torch.equal(latlong, busy)


def test_no_material_at_all_is_refused(node: Nodes, even: torch.Tensor) -> None:
    with pytest.raises(pack_module("dl_core.errors").OptionError, match="one or more of diffuse, matte, mirror"):
        node("LightModel").execute(even, 0.05, diffuse=False, matte=False, mirror=False)


def test_a_picture_that_is_no_map_is_refused(node: Nodes) -> None:
    with pytest.raises(pack_module("dl_core.errors").OptionError, match="2 x height"):
        node("LightModel").execute(torch.ones(1, 16, 16, 3), 0.05, **DIFFUSE)
