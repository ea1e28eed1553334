"""EstimateDepth: depth of the photograph through a depth model of transformers'."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final

import comfy.model_management
import folder_paths
import torch
from comfy_api.latest import io

from ..dl_core.depth import FOLDER, DepthModel, load_depth_model
from ..dl_core.errors import ModelError
from .sockets import CATEGORY, DepthModelSocket, as_rgb, named_output

__all__ = ["EstimateDepth"]

MODELS: Final = "depth_estimation"
"""ComfyUI's folder of depth models, one folder each; extra_model_paths.yaml can add to it under this name."""

HUB: Final = "by hub_id"
"""Choice that leaves it to the id."""

folder_paths.add_model_folder_path(MODELS, str(Path(folder_paths.models_dir) / MODELS))


class EstimateDepth(io.ComfyNode):  # type: ignore[misc]
    """Estimates depth, and hands on the model that does."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="EstimateDepth",
            display_name="Estimate Depth",
            category=CATEGORY,
            description="Estimates how far away everything in a photograph is, near bright, with a depth model of "
            "transformers' such as Depth Anything V2 or DPT. Depth maps of other nodes serve Depth Ball Mask as well.",
            inputs=[
                io.Image.Input("image", tooltip="The photograph, any size."),
                io.Combo.Input(
                    "model",
                    options=[*_folders(), HUB],
                    tooltip=f"A folder in ComfyUI's models/{MODELS} that holds {FOLDER}.",
                ),
                io.String.Input(
                    "hub_id",
                    default="depth-anything/Depth-Anything-V2-Small-hf",
                    tooltip=f"With {HUB}: an id on the hub, from its cache on this machine. The paper's authors: "
                    "Intel/dpt-hybrid-midas.",
                ),
                io.Boolean.Input(
                    "download",
                    default=False,
                    tooltip="Fetch an id that is not in the cache; nothing is downloaded otherwise.",
                ),
            ],
            outputs=[
                named_output(io.Image, "depth", "Depth in [0, 1] at the photograph's size, near is bright."),
                named_output(
                    DepthModelSocket, "depth_model", "The model, for Iterative Median to estimate depth every round."
                ),
            ],
        )

    @classmethod
    def execute(cls, image: torch.Tensor, model: str, hub_id: str, download: bool) -> io.NodeOutput:
        """Load and estimate."""
        loaded = _loaded(hub_id.strip(), download) if model == HUB else _loaded(_path(model), False)
        return io.NodeOutput(loaded(as_rgb(image, "image")).expand(-1, -1, -1, 3), loaded)


def _folders() -> list[str]:
    """Names of the folders that hold a model."""
    return sorted({path.parent.name for root in _roots() for path in root.glob("*/config.json")})


def _roots() -> list[Path]:
    return [Path(root) for root in folder_paths.get_folder_paths(MODELS)]


def _path(name: str) -> str:
    for root in _roots():
        if (root / name / "config.json").is_file():
            return str(root / name)
    raise ModelError(name, f"no such folder in {' or '.join(map(str, _roots()))}; it would hold {FOLDER}")


@lru_cache(maxsize=1)
def _loaded(source: str, download: bool) -> DepthModel:
    """The last model used stays loaded: it is small, and ComfyUI runs a node again for every photograph."""
    if not source:
        roots = " or ".join(map(str, _roots()))
        raise ModelError("hub_id", f"is empty; name an id, or put a folder with {FOLDER}, into {roots} and choose it")
    try:
        return load_depth_model(source, download=download, device=comfy.model_management.get_torch_device())
    except ModelError as error:
        roots = " or ".join(map(str, _roots()))
        raise ModelError(error.model, f"{error.reason}. This node lists the folders in {roots}") from error
