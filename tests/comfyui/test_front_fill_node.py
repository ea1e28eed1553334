"""FrontFill, and the widgets of EstimateLight that mend around an estimate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from comfy_host import pack_module

Nodes = Callable[[str], Any]
LATLONG = torch.rand(2, 32, 64, 3, generator=torch.Generator().manual_seed(0)) * 4


def test_the_photograph_is_in_front_and_nowhere_else(node: Nodes) -> None:
    photo = torch.full((1, 24, 32, 3), 0.5)
    filled, mask = node("FrontFill").execute(LATLONG, photo, 60.0).args
    assert mask.shape == (1, 32, 64)
    torch.testing.assert_close(filled[:, 15:17, 31:33], torch.full((2, 2, 2, 3), 0.5**2.4))
    assert torch.equal(filled[:, mask[0] == 0], LATLONG[:, mask[0] == 0])
    up, _ = node("FrontFill").execute(LATLONG, photo, 60.0, pitch=45.0).args
    torch.testing.assert_close(up[:, 7:9, 31:33], torch.full((2, 2, 2, 3), 0.5**2.4))


def test_grey_photographs_work(node: Nodes) -> None:
    filled, _ = node("FrontFill").execute(LATLONG, torch.full((1, 8, 8, 1), 0.5), 60.0).args
    assert filled.shape == LATLONG.shape


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"photograph": torch.rand(2, 8, 8, 3)}, "photograph: holds 2 pictures"),
        ({"photograph": torch.full((1, 8, 8, 3), 2.0)}, "photograph: holds values from 2"),
        ({"latlong": torch.rand(1, 8, 8, 3)}, "latlong is"),
        ({"fov": 3.0}, "fov is 3"),
    ],
)
def test_what_it_cannot_use_is_named(node: Nodes, change: dict[str, Any], message: str) -> None:
    wrong = pack_module("dl_core.errors").ProbeError
    with pytest.raises(wrong, match=message):
        node("FrontFill").execute(**{"latlong": LATLONG, "photograph": torch.rand(1, 8, 8, 3), "fov": 60.0, **change})


def test_widgets_of_an_older_workflow_are_off() -> None:
    mending = pack_module("nodes.mending")
    rest = {"cfg": 5.0}
    assert mending.mending_of(rest) == pack_module("dl_core.mending").Mending()
    assert rest == {"cfg": 5.0}
    with pytest.raises(pack_module("dl_core.errors").OptionError, match="fov is None"):
        mending.mending_of({"front_fill": True, "fov": 0.0})
