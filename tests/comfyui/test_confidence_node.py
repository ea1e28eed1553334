"""ConfidenceMap, and the layer's way from the balls to the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import OpenEXR
import pytest
import torch
from comfy_host import pack_module

Nodes = Callable[[str], Any]
LATLONG = torch.rand(1, 32, 64, 3, generator=torch.Generator().manual_seed(0))


def balls(spread: float, count: int = 9) -> torch.Tensor:
    return 0.4 + spread * torch.rand(count, 24, 24, 1, generator=torch.Generator().manual_seed(1)).expand(-1, -1, -1, 3)


def test_balls_that_differ_more_are_trusted_less(node: Nodes) -> None:
    found = [node("ConfidenceMap").execute([balls(s)], [0.0], [LATLONG]).args for s in (0.02, 0.2)]
    (sure, picture, low, report), (unsure, _, high, _) = found
    assert sure.shape == (1, 32, 64)
    assert picture.shape == (1, 32, 64, 3)
    assert (sure >= unsure).all()
    assert low < high
    assert f"{low:.2f} stops" in report


def test_what_it_cannot_judge_is_named(node: Nodes) -> None:
    wrong = pack_module("dl_core.errors").OptionError
    with pytest.raises(wrong, match="3 or more"):
        node("ConfidenceMap").execute([balls(0.1, 2)], [0.0], [LATLONG])
    with pytest.raises(wrong, match="one map"):
        node("ConfidenceMap").execute([balls(0.1)], [0.0], [LATLONG, LATLONG])
    with pytest.raises(wrong, match="one batch"):
        node("ConfidenceMap").execute([balls(0.1)], [0.0, -2.5], [LATLONG])


def test_the_layer_arrives_in_the_file(node: Nodes, folders: Path) -> None:
    trusted, *_ = node("ConfidenceMap").execute([balls(0.1)], [0.0], [LATLONG]).args
    path = node("SaveEnvMap").execute(LATLONG, "probe", "float", False, confidence=trusted).args[0]
    kept = OpenEXR.File(path, separate_channels=True).channels()["confidence.Y"].pixels
    assert torch.equal(torch.from_numpy(kept), trusted[0])
    with pytest.raises(pack_module("dl_core.errors").OptionError, match="one for each map"):
        node("SaveEnvMap").execute(LATLONG, "probe", "float", False, confidence=trusted.expand(2, -1, -1))
