"""EstimateDepth: the folders it lists, what it loads once, and its model in IterativeMedian."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from comfy_host import pack_module
from depth_models import save_depth_anything

ROUNDS = {"preset": "custom", "balls": 2, "rounds": 2, "final": True}
SAMPLING = {"seed": 0, "steps": 2, "cfg": 5.0, "sampler": "uni_pc", "scheduler": "leading (paper)", "strength": 1.0}
SAMPLING |= {"control_strength": 1.0, "batch_size": 2}
PHOTO = torch.rand(1, 40, 60, 3, generator=torch.Generator().manual_seed(0))

Nodes = Callable[[str], Any]


@pytest.fixture(scope="module")
def graph(heeding_graph: Any) -> Any:
    return heeding_graph


@pytest.fixture
def models(pack: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """ComfyUI's folder of depth models, empty."""
    import folder_paths

    monkeypatch.setitem(folder_paths.folder_names_and_paths, "depth_estimation", ([str(tmp_path)], set()))
    module = pack_module("nodes.depth_model")
    module._loaded.cache_clear()
    yield tmp_path
    module._loaded.cache_clear()


def options(node: Nodes) -> list[str]:
    (combo,) = [item for item in node("EstimateDepth").define_schema().inputs if item.id == "model"]
    return combo.options


def test_folders_that_hold_a_model_are_listed(node: Nodes, models: Path) -> None:
    assert options(node) == ["by hub_id"]
    (models / "empty").mkdir()
    save_depth_anything(models / "toy")
    assert options(node) == ["toy", "by hub_id"]


def test_depth_goes_into_depth_ball_mask(node: Nodes, models: Path) -> None:
    save_depth_anything(models / "toy")
    depth, model = node("EstimateDepth").execute(PHOTO, "toy", "", False).args
    assert depth.shape == PHOTO.shape
    assert (float(depth.min()), float(depth.max())) == (0, 1)
    assert torch.equal(depth[..., :1], model(PHOTO))
    again = node("EstimateDepth").execute(PHOTO, "toy", "", False).args[1]
    assert again is model
    place = {"canvas": 64, "diameter": 32, "x": -1, "y": -1, "dilation": -1}
    control = node("DepthBallMask").execute(PHOTO, depth=depth, **place).args[1]
    assert control.shape == (1, 64, 64, 3)


@pytest.mark.parametrize(
    ("model", "hub_id", "message"),
    [
        ("gone", "", r"gone: no such folder in .*model\.safetensors"),
        ("by hub_id", "", r"hub_id: is empty.*put a folder with config\.json"),
        ("by hub_id", "nobody/no-such-depth-model", r"no complete model of that id.*lists the folders in "),
    ],
)
def test_where_no_model_is_it_says_where_to_put_one(
    node: Nodes, models: Path, model: str, hub_id: str, message: str
) -> None:
    with pytest.raises(pack_module("dl_core.errors").ModelError, match=message) as raised:
        node("EstimateDepth").execute(PHOTO, model, hub_id, False)
    assert str(models) in str(raised.value)


def test_every_round_sees_the_depth_of_its_own_canvas(node: Nodes, graph: Any, scene: Any) -> None:
    """Held against the same rounds by hand, and against the rounds that keep the first depth."""

    def depth_model(canvas: torch.Tensor) -> torch.Tensor:
        return 1 - canvas.mean(dim=-1, keepdim=True)

    places = {"image": scene.canvas, "depth": scene.depth, "ball": scene.ball, "mask": scene.mask}
    inputs = {**graph.sockets(), **places, **ROUNDS, **SAMPLING}
    with torch.no_grad():
        answer = node("IterativeMedian").execute(**inputs, depth_model=depth_model).args[0]
        fixed = node("IterativeMedian").execute(**inputs).args[0]
        balls, canvas, depth = pack_module("dl_core.ball"), scene.canvas, scene.depth
        for count in (2, 2, 1):
            common = {**graph.sockets(), **places, **SAMPLING, "image": canvas, "depth": depth}
            painted = node("ChromeBallInpaint").execute(**common, count=count).args[0]
            median = painted.sort(dim=0).values.mean(dim=0, keepdim=True)
            canvas = balls.paste_ball(scene.canvas, median, scene.ball)
            depth = balls.paint_depth(depth_model(canvas), scene.ball)
    assert torch.equal(answer, painted)
    assert (answer - fixed).abs().max() > 1e-4  # the two equal ones are so to the bit
