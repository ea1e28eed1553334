"""Real architectures at full size, weightless: detected by ComfyUI from their state dicts, then accepted or refused."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from comfy_host import REPOSITORY, pack_module

SD15: dict[str, Any] = {"cross_attention_dim": 768, "attention_head_dim": 8}
"""Stable Diffusion 1.5's UNet where it departs from diffusers' defaults."""

SDXL: dict[str, Any] = json.loads((REPOSITORY / "dl_core/data/sdxl/unet/config.json").read_text())
CONTROL: dict[str, Any] = json.loads((REPOSITORY / "dl_core/data/sdxl/controlnet/config.json").read_text())

REFINER: dict[str, Any] = SDXL | {
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
    "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
    "block_out_channels": (384, 768, 1536, 1536),
    "transformer_layers_per_block": 4,
    "attention_head_dim": (6, 12, 24, 24),
    "cross_attention_dim": 1280,
    "projection_class_embeddings_input_dim": 2560,
}


def unet_model(config: dict[str, Any]) -> Any:
    """A UNet's weights without values, through ComfyUI's own detection, as a MODEL holds them."""
    from comfy.model_detection import model_config_from_diffusers_unet
    from diffusers import UNet2DConditionModel

    with torch.device("meta"):
        weights = UNet2DConditionModel.from_config(config).state_dict()
    detected = model_config_from_diffusers_unet(weights)
    detected.set_inference_dtype(torch.float32, None)
    return SimpleNamespace(model=detected.get_model({}, device="meta"))


def flux_model() -> Any:
    import comfy.model_base
    import comfy.supported_models

    # The real class of network and model; two blocks of it, as no weights are read.
    sizes = {
        "image_model": "flux", "in_channels": 16, "out_channels": 16, "vec_in_dim": 8, "context_in_dim": 8,
        "hidden_size": 64, "mlp_ratio": 4.0, "num_heads": 2, "depth": 1, "depth_single_blocks": 1,
        "axes_dim": [8, 12, 12], "theta": 10000, "patch_size": 2, "qkv_bias": True, "guidance_embed": True,
    }  # fmt: skip
    config = comfy.supported_models.Flux(sizes)
    config.set_inference_dtype(torch.float32, None)
    return SimpleNamespace(model=config.get_model({}, device="meta"))


def test_the_base_model_is_accepted(pack: Any) -> None:
    pack_module("nodes.architecture").require_sdxl(unet_model(SDXL))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (SD15, "socket model: holds SD15; a model of SDXL's architecture is accepted"),
        (REFINER, "socket model: holds SDXLRefiner; a model of SDXL's architecture is accepted"),
        (SDXL | {"in_channels": 9}, "socket model: holds an SDXL of 9 input channels"),
        (SDXL | {"in_channels": 8}, "socket model: holds an SDXL of 8 input channels"),
    ],
    ids=["sd15", "refiner", "inpainting", "instruct-pix2pix"],
)
def test_unets_of_other_models_are_refused(pack: Any, config: dict[str, Any], message: str) -> None:
    with pytest.raises(pack_module("dl_core.errors").ModelError, match=message):
        pack_module("nodes.architecture").require_sdxl(unet_model(config))


def test_flux_is_refused(pack: Any) -> None:
    with pytest.raises(pack_module("dl_core.errors").ModelError, match="socket model: holds Flux; a model of SDXL"):
        pack_module("nodes.architecture").require_sdxl(flux_model())


@pytest.mark.parametrize(("config", "accepted"), [(CONTROL, True), (SD15, False)], ids=["sdxl", "sd15"])
@pytest.mark.filterwarnings("ignore:.*copying from a non-meta parameter.*:UserWarning")
def test_control_nets(pack: Any, monkeypatch: pytest.MonkeyPatch, config: dict[str, Any], accepted: bool) -> None:
    """A ControlNet's file as diffusers writes it, loaded by ComfyUI's loader, again without values."""
    import comfy.controlnet
    import comfy.model_management
    from diffusers import ControlNetModel

    with torch.device("meta"):
        weights = ControlNetModel.from_config(config).state_dict()
    monkeypatch.setattr(comfy.model_management, "unet_offload_device", lambda: torch.device("meta"))
    loaded = comfy.controlnet.load_controlnet_state_dict(dict(weights))
    require = pack_module("nodes.architecture").require_control_net
    if accepted:
        require(loaded)
    else:
        with pytest.raises(pack_module("dl_core.errors").ModelError, match="a ControlNet of another architecture"):
            require(loaded)
