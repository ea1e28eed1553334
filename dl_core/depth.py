"""Depth of a photograph through transformers' models for it, near is bright.

The conventions of the models differ. Those that predict inverse depth up to scale and shift (DPT, Depth Anything) or
inverse depth itself (Depth Pro) show what is near bright already; those that predict distance (GLPN, Depth Anything's
metric models) are inverted. Either way the map is stretched to [0, 1], which is all a depth ControlNet sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from .errors import ImageError, ModelError
from .shapes import Image

__all__ = ["CONVENTIONS", "DepthModel", "load_depth_model"]

CONVENTIONS: Final[dict[str, bool]] = {"dpt": True, "depth_anything": True, "depth_pro": True, "glpn": False}
"""Transformers' kinds of model, and whether their prediction is larger where it is nearer, unless a model of that kind
says that it is a metric one."""

NEAREST: Final = 0.01
"""Metres: a smaller distance counts as this, so that one wrong pixel does not make all others look far."""

LONGEST: Final = 8
"""How many times longer than wide a picture may be: the processors scale its short side to what the network wants."""

FOLDER: Final = "config.json, preprocessor_config.json and model.safetensors, as transformers saves them"

_UNUSED: Final = "fusion_stage.layers.0.residual_layer1."
"""Part of every DPT head that has nothing to add to; published weights leave it out."""


@dataclass(frozen=True)
class DepthModel:
    """A network that estimates depth. Call it with a picture.

    Attributes:
        name: of its folder or on the hub.
        network: transformers' model.
        processor: transformers' image processor that belongs to it.
        nearer_is_larger: whether its prediction is inverse depth; it is distance otherwise.
        device: where it runs. Between calls it waits in main memory and leaves the device to the painter.
    """

    name: str
    network: Any
    processor: Any
    nearer_is_larger: bool
    device: str | torch.device = "cpu"

    @torch.no_grad()
    def __call__(self, image_ldr: Image) -> Float[Tensor, "b h w 1"]:
        """Estimate depth.

        Args:
            image_ldr: (B, H, W, 3) display-encoded in [0, 1].

        Returns:
            (B, H, W, 1) in [0, 1], near is bright: each picture's nearest pixel 1, its farthest 0. Where all is at one
            depth it is 0 throughout.

        Raises:
            ImageError: an empty picture, one that is not finite, or one more than eight times as long as wide.
            ModelError: the network gave values that are not finite.
        """
        codes = _codes(image_ldr)
        inputs = self.processor(images=list(codes), return_tensors="pt")
        try:
            network = self.network.to(self.device)
            predicted = network(inputs["pixel_values"].to(self.device, network.dtype)).predicted_depth.float().cpu()
        finally:
            self.network.to("cpu")
        if not torch.isfinite(predicted).all():
            raise ModelError(self.name, "estimated a depth of NaN or infinity: its weights are damaged or half precise")
        nearness = predicted if self.nearer_is_larger else 1 / predicted.clamp(min=NEAREST)
        size = (codes.shape[1], codes.shape[2])
        nearness = F.interpolate(nearness[:, None], size=size, mode="bicubic", align_corners=False)
        low, high = nearness.amin(dim=(1, 2, 3), keepdim=True), nearness.amax(dim=(1, 2, 3), keepdim=True)
        return ((nearness - low) / (high - low).clamp(min=1e-8)).permute(0, 2, 3, 1).to(image_ldr.device)


def _codes(image_ldr: Image) -> Any:
    """(B, H, W, 3) 8-bit codes, which is what image processors are made for and what the authors' code gives theirs."""
    height, width = image_ldr.shape[1:3]
    if image_ldr.numel() == 0:
        raise ImageError("image", f"is empty ({width} x {height})")
    if max(height, width) > LONGEST * min(height, width):
        raise ImageError("image", f"is {width} x {height} pixels; up to {LONGEST} times as long as wide is accepted")
    if not torch.isfinite(image_ldr).all():
        raise ImageError("image", "holds NaN or infinite values")
    return (image_ldr.detach().cpu().float().clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def load_depth_model(source: str | Path, *, download: bool = False, device: str | torch.device = "cpu") -> DepthModel:
    """Load a depth model from a local folder, or by its id from the hub's cache.

    Args:
        source: a folder, or an id such as "depth-anything/Depth-Anything-V2-Small-hf" or "Intel/dpt-hybrid-midas" (the
            authors').
        download: whether an id that is not in the cache is fetched; nothing is without it.
        device: where the model runs.

    Raises:
        ModelError: nothing there, nothing that loads, or a model of another kind than `CONVENTIONS` knows.
    """
    folder = Path(source)
    try:
        is_folder = folder.is_dir()
    except (OSError, ValueError) as error:  # no file system takes such a name, and no hub such an id
        raise ModelError(repr(str(source)), "names neither a folder nor a model of the hub") from error
    if is_folder and not (folder / "config.json").is_file():
        raise ModelError(folder, f"holds no config.json; a folder with {FOLDER}, is accepted")
    options = {"local_files_only": is_folder or not download}
    # Late: it takes seconds to import.
    from transformers import AutoConfig, AutoImageProcessor, AutoModelForDepthEstimation

    try:
        config = AutoConfig.from_pretrained(source, **options)
        if config.model_type not in CONVENTIONS:
            raise ModelError(source, f"is a {config.model_type} model; accepted: {', '.join(CONVENTIONS)}")
        processor = AutoImageProcessor.from_pretrained(source, **options)
        network, info = AutoModelForDepthEstimation.from_pretrained(source, output_loading_info=True, **options)
    except ModelError:
        raise
    except Exception as error:  # transformers raises whatever its parts do; all of it means the same to the user
        raise ModelError(source, _why_not(folder, download, error)) from error
    missing = [name for name in info["missing_keys"] if _UNUSED not in name]
    if missing:
        raise ModelError(source, f"lacks {len(missing)} of its weights, such as {sorted(missing)[0]}")
    metric = getattr(config, "depth_estimation_type", "relative") == "metric"
    return DepthModel(str(source), network.eval(), processor, CONVENTIONS[config.model_type] and not metric, device)


def _why_not(folder: Path, download: bool, error: Exception) -> str:
    if folder.is_dir():
        return f"cannot be loaded ({type(error).__name__}: {error}); a folder with {FOLDER}, is accepted"
    if download:
        return f"is no folder, and fetching it failed ({type(error).__name__}: {error})"
    from huggingface_hub.constants import HF_HUB_CACHE

    return (
        f"is no folder, and no complete model of that id is in the hub's cache {HF_HUB_CACHE}: name a folder with "
        f"{FOLDER}, or allow the download"
    )
