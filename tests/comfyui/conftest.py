"""Fixtures over a ComfyUI in this process. Everything here is skipped, loudly, where there is none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from comfy_host import NO_COMFYUI, Server, installed, load_pack, pack_module, serve

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if not installed():
        for item in items:
            if HERE in item.path.parents:
                item.add_marker(pytest.mark.skip(reason=NO_COMFYUI))


@dataclass(frozen=True)
class Graph:
    """The mini model both ways, and the values nodes pass on: what a graph holds before painting."""

    mini: Any
    model: Any
    clip: Any
    vae: Any
    control_net: Any
    positive: Any
    negative: Any

    def sockets(self) -> dict[str, Any]:
        """The networks by the sockets of nodes that paint."""
        return {name: getattr(self, name) for name in ("model", "positive", "negative", "vae", "control_net")}


@pytest.fixture(scope="session")
def pack() -> ModuleType:
    return load_pack()


@pytest.fixture(scope="session")
def node(pack: ModuleType) -> Callable[[str], Any]:
    """A node class by its id."""
    classes = {kind.GET_SCHEMA().node_id: kind for kind in pack_module("nodes").NODES}
    return lambda name: classes[name]


def _lively(mini: Any) -> Any:
    """Untrained networks, except that the ControlNet's output layers are not zero, as they start."""
    for name, parameter in mini.controlnet.named_parameters():
        if name.startswith(("controlnet_down_blocks", "controlnet_mid_block")):
            torch.nn.init.normal_(parameter, std=0.02)
    return mini


@pytest.fixture(scope="session")
def mini(pack: ModuleType) -> Any:
    """The mini model's architecture with fixed random weights."""
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        return _lively(pack_module("dl_core.backends.mini").MiniModel.untrained())


@pytest.fixture(scope="session")
def trained(pack: ModuleType) -> Any:
    """The mini model as shipped; tests that need it are skipped while its weights are not there."""
    library = pack_module("dl_core.backends.mini")
    missing = [name for name in library.NETWORK_FILES.values() if not (library.MINI_FOLDER / name).is_file()]
    if missing:
        pytest.skip(f"NO TRAINED MINI MODEL: {', '.join(missing)} missing in {library.MINI_FOLDER}")
    return library.load_mini()


def graph_of(mini: Any) -> Graph:
    """The graph of a mini model, without its LoRA, prompts encoded."""
    convert = pack_module("nodes.mini")
    clip = convert.to_clip(mini)

    def encode(text: str) -> Any:
        return clip.encode_from_tokens_scheduled(clip.tokenize(text))

    prompts = mini.defaults
    return Graph(
        mini,
        convert.to_model(mini, 0),
        clip,
        convert.to_vae(mini),
        convert.to_controlnet(mini),
        encode(prompts.prompt),
        encode(prompts.negative_prompt),
    )


@pytest.fixture(scope="session")
def graph(mini: Any) -> Graph:
    return graph_of(mini)


@pytest.fixture(scope="session")
def trained_graph(trained: Any) -> Graph:
    return graph_of(replace(trained, lora=None))


@pytest.fixture(scope="session")
def heeding_graph(trained_graph: Graph, mini: Any) -> Graph:
    """Trained networks, since untrained ones paint nearly black balls, with a ControlNet that heeds the whole depth."""
    awake = replace(mini, controlnet=deepcopy(mini.controlnet))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        awake.controlnet.controlnet_cond_embedding.conv_out.weight.normal_(std=3.0, generator=generator)
    return replace(trained_graph, control_net=pack_module("nodes.mini").to_controlnet(awake))


@dataclass(frozen=True)
class Scene:
    """A small canvas with a ball: what Depth Ball Mask gives."""

    canvas: torch.Tensor
    depth: torch.Tensor
    mask: torch.Tensor
    ball: Any


@pytest.fixture(scope="session")
def scene(node: Callable[[str], Any]) -> Scene:
    photo = torch.rand(1, 48, 64, 3, generator=torch.Generator().manual_seed(1))
    return Scene(*node("DepthBallMask").execute(photo, canvas=64, diameter=32, x=-1, y=-1, dilation=-1).args)


@pytest.fixture(scope="session")
def mini_scene(node: Callable[[str], Any], mini: Any) -> Scene:
    """The canvas and ball the mini model is made for, under a smooth picture."""
    coarse = torch.rand(1, 3, 20, 30, generator=torch.Generator().manual_seed(1))
    photo = torch.nn.functional.interpolate(coarse, (200, 300), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)
    sizes = {"canvas": mini.defaults.canvas, "diameter": mini.defaults.diameter}
    return Scene(*node("DepthBallMask").execute(photo, **sizes, x=-1, y=-1, dilation=-1).args)


@pytest.fixture
def folders(pack: ModuleType, tmp_path: Path) -> Iterator[Path]:
    """ComfyUI's output, input and temp folders in a temporary place."""
    import folder_paths

    names = ("output", "input", "temp")
    before = {name: getattr(folder_paths, f"get_{name}_directory")() for name in names}
    for name in names:
        (tmp_path / name).mkdir()
        getattr(folder_paths, f"set_{name}_directory")(str(tmp_path / name))
    yield tmp_path
    for name, folder in before.items():
        getattr(folder_paths, f"set_{name}_directory")(folder)


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A real server, shared by the tests of this folder."""
    with serve(tmp_path_factory.mktemp("server") / "base") as running:
        yield running


@pytest.fixture(autouse=True)
def _no_gradients() -> Iterator[None]:
    """Nodes run without gradients, as in ComfyUI."""
    with torch.no_grad():
        yield


@pytest.fixture(autouse=True)
def _no_finished_balls() -> None:
    """Every test starts with nothing painted, as after a start of ComfyUI."""
    if installed():
        pack_module("nodes.painting").FINISHED.clear()
