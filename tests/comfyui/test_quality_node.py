"""ProbeQuality, and medians that leave balls out."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import torch
from comfy_host import pack_module

Nodes = Callable[[str], Any]


@pytest.fixture(scope="module")
def bracket(pack: Any) -> Any:
    """A canvas with a true ball at two EVs, and where it is."""
    geometry, exposure, ball = (pack_module(f"dl_core.{name}") for name in ("geometry", "exposure", "ball"))
    waves = torch.cos(12 * geometry.latlong_directions(64) @ torch.tensor([[1.0, 0.3], [0.2, 1.0], [0.5, 0.4]])).sum(-1)
    light = (0.4 + 0.15 * waves).clamp(min=0.02)[None, ..., None].expand(-1, -1, -1, 3)
    place = ball.place_ball(128, 64)
    balls = [exposure.expose(geometry.latlong_to_ball(light, 64, samples=4), ev) for ev in (0.0, -2.5)]
    canvas = ball.paste_ball(torch.full((1, 128, 128, 3), 0.5), balls[0], place)
    return balls, canvas, place


def test_a_true_bracket_is_good_and_everything_asked_for_is_checked(node: Nodes, bracket: Any) -> None:
    balls, canvas, place = bracket
    photo = torch.rand(1, 48, 64, 3, generator=torch.Generator().manual_seed(0))
    score, report, text = node("ProbeQuality").execute(balls, [0.0, -2.5], [canvas], [place], [photo]).args
    found = json.loads(text)
    names = {check["name"] for check in found["checks"]}
    assert names == {"place", "whole", "mirror", "gloss", "tint", "rim", "horizon", "exposures", "cue"}
    assert found["score"] == score == pytest.approx(min(c["score"] for c in found["checks"][:4]))
    assert next(check["score"] for check in found["checks"] if check["name"] == "exposures") > 0.9
    assert report.count("\n") == len(names)
    alone = json.loads(node("ProbeQuality").execute(balls[:1]).args[2])
    assert {check["name"] for check in alone["checks"]} == names - {"rim", "exposures", "cue"}


def test_a_flat_disc_is_no_mirror_ball(node: Nodes, bracket: Any) -> None:
    balls, *_ = bracket
    good = node("ProbeQuality").execute(balls[:1]).args[0]
    flat = node("ProbeQuality").execute([torch.full((1, 64, 64, 3), 0.5)]).args[0]
    assert flat < 0.5
    assert flat < good


def test_half_of_a_place_is_refused(node: Nodes, bracket: Any) -> None:
    balls, canvas, place = bracket
    for options in ({"composite": [canvas]}, {"ball": [place]}):
        with pytest.raises(pack_module("dl_core.errors").OptionError, match="not connected"):
            node("ProbeQuality").execute(balls, **options)
