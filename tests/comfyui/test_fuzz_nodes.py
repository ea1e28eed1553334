"""Every node under inputs of all kinds: it gives outputs that can be used, or an error that says what is wrong.

Widgets take values that ComfyUI lets through (it checks ranges and choices), sockets whatever another node may give:
pictures of odd sizes, channels and batches, empty, not finite, far outside [0, 1]. Sizes that only cost time are kept
small. An output with NaN, or another error than the library's own, is a mistake of the node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from comfy_host import installed, pack_module
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

# ruff: noqa: PT017  errors are one of two outcomes here

MOST = {
    "canvas": 96,
    "diameter": 64,
    "x": 96,
    "y": 96,
    "dilation": 40,
    "height": 24,
    "steps": 2,
    "balls": 3,
    "min_balls": 3,
    "count": 3,
    "light_balls": 2,
    "rounds": 1,
    "samples": 2,
    "rows": 2,
    "columns": 2,
    "kept_side": 256,
    "batch_size": 2,
}
"""Largest values of widgets that would only cost time."""
LISTS = {
    "HDRMerge": ("balls", "ev", "light_balls"),
    "ConfidenceMap": ("balls", "ev"),
    "ProbeQuality": ("balls",),
    "FitBall": ("balls",),
}
SHAPES = (
    (1, 48, 64, 3),
    (1, 64, 64, 3),
    (2, 64, 64, 3),
    (1, 32, 64, 3),
    (1, 32, 32, 3),
    (1, 1, 1, 3),
    (1, 2, 500, 3),
    (1, 64, 64, 1),
    (1, 64, 64, 4),
    (1, 64, 64, 2),
    (0, 64, 64, 3),
    (1, 0, 64, 3),
    (64, 64, 3),
)
CONTENTS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "plain": lambda values: values,
    "black": lambda values: values * 0,
    "white": lambda values: values * 0 + 1,
    "bright": lambda values: values * 1e4,
    "vast": lambda values: values * 3e38,
    "negative": lambda values: values - 0.5,
    "one NaN": lambda values: _with(values, float("nan")),
    "one infinite": lambda values: _with(values, float("inf")),
    "half": lambda values: values.half(),
}


def _with(values: torch.Tensor, value: float) -> torch.Tensor:
    if values.numel():
        values.view(-1)[values.numel() // 2] = value
    return values


def _picture(shape: tuple[int, ...], content: str) -> torch.Tensor:
    return CONTENTS[content](torch.rand(shape, generator=torch.Generator().manual_seed(0)))


# A picture that fits comes half of the time, or nothing would get past the first check.
PICTURES = st.one_of(
    st.builds(_picture, st.sampled_from(SHAPES[:4]), st.just("plain")),
    st.builds(_picture, st.sampled_from(SHAPES), st.sampled_from(tuple(CONTENTS))),
)
MASKS = st.one_of(
    st.just(torch.ones(1, 64, 64)),
    st.sampled_from(
        [torch.zeros(1, 64, 64), torch.ones(1, 5, 9), torch.full((1, 64, 64), float("nan")), torch.ones(64)]
    ),
)
TEXTS = st.one_of(
    st.text(max_size=20), st.sampled_from(["0", "0, -2.5, -5", "0,-1,", "a ball", "../x", "/x", "x" * 300])
)


def _number(entry: Any) -> st.SearchStrategy[Any]:
    most = MOST.get(entry.id)
    low = -1e3 if entry.min is None else entry.min
    high = 1e3 if entry.max is None else entry.max
    high = high if most is None else min(high, most)
    if entry.io_type == "INT":
        return st.integers(int(low), int(high))
    return st.one_of(st.floats(low, high), st.just(entry.default if entry.default is not None else 0.0))


def _values(entry: Any, sockets: dict[str, Any]) -> st.SearchStrategy[Any]:
    if entry.io_type in sockets:
        return st.just(sockets[entry.io_type])
    if entry.io_type in ("INT", "FLOAT"):
        return _number(entry)
    if entry.io_type == "COMBO":
        return st.sampled_from(entry.options) if entry.options else st.just("none")
    return {"IMAGE": PICTURES, "MASK": MASKS, "STRING": TEXTS, "BOOLEAN": st.booleans()}[entry.io_type]


@pytest.fixture
def sockets(graph: Any, scene: Any) -> dict[str, Any]:
    """What other nodes give by the type of the socket; those that are left out are optional."""
    return {
        "MODEL": graph.model,
        "CLIP": graph.clip,
        "VAE": graph.vae,
        "CONTROL_NET": graph.control_net,
        "CONDITIONING": graph.positive,
        "BALL": scene.ball,
    }


def _all_nodes() -> list[str]:
    """All but one, whose choices are files that are not there."""
    names = [kind.GET_SCHEMA().node_id for kind in pack_module("nodes").NODES] if installed() else ["none"]
    return [name for name in names if name != "TurboLoRASwap"]


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _tensors(item)


@pytest.mark.parametrize("name", _all_nodes())
@given(data=st.data())
@settings(
    max_examples=12,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)
def test_a_node_gives_something_sound_or_says_what_is_wrong(
    name: str, data: st.DataObject, node: Callable[[str], Any], sockets: dict[str, Any], folders: Path
) -> None:
    kind, errors = node(name), pack_module("dl_core.errors")
    inputs = {}
    for entry in kind.GET_SCHEMA().inputs:
        can_be_had = entry.io_type in sockets or entry.io_type in (
            "INT",
            "FLOAT",
            "COMBO",
            "IMAGE",
            "MASK",
            "STRING",
            "BOOLEAN",
        )
        if entry.optional and (not can_be_had or data.draw(st.booleans(), label=f"{entry.id} is left out")):
            continue
        value = data.draw(_values(entry, sockets), label=entry.id)
        inputs[entry.id] = [value] if kind.GET_SCHEMA().is_input_list else value
    for listed in (socket for socket in LISTS.get(name, ()) if socket in inputs):
        inputs[listed] = inputs[listed] * data.draw(st.integers(1, 3), label=f"length of {listed}")
    before = {path for path in folders.parent.rglob("*") if not path.is_relative_to(folders)}
    try:
        output = kind.execute(**inputs)
    except errors.ProbeError as error:
        assert str(error)
        return
    finally:
        assert {path for path in folders.parent.rglob("*") if not path.is_relative_to(folders)} == before
    for tensor in _tensors(output.args):
        assert not torch.isnan(tensor).any()
