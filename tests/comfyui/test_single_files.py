"""SDXL from single files: what ComfyUI writes, the diffusers path loads, and the description it ships is SDXL's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import toy_sdxl
from comfy_host import pack_module
from safetensors.torch import save_file


def described(network: str) -> dict[str, Any]:
    folder = pack_module("dl_core.backends.sdxl_files").SDXL_FOLDER
    config: dict[str, Any] = json.loads((folder / network / "config.json").read_text())
    return config


def shapes(module: torch.nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


def test_the_unet_described_is_the_one_comfyui_knows(pack: Any) -> None:
    """Layer by layer, by ComfyUI's own table of names."""
    import comfy.utils
    from comfy.model_detection import model_config_from_diffusers_unet
    from diffusers import UNet2DConditionModel

    with torch.device("meta"):
        ours = UNet2DConditionModel.from_config(described("unet"))
    detected = model_config_from_diffusers_unet(ours.state_dict())
    assert type(detected).__name__ == "SDXL"
    theirs = shapes(detected.get_model({}, device="meta").diffusion_model)
    table = comfy.utils.unet_to_diffusers(detected.unet_config)
    assert {table[name]: shape for name, shape in shapes(ours).items()} == theirs


@pytest.mark.parametrize(("network", "name"), [("text_encoder", "clip_l"), ("text_encoder_2", "clip_g")])
def test_the_text_encoders_described_are_those_comfyui_has(pack: Any, network: str, name: str) -> None:
    from comfy import sd1_clip, sdxl_clip
    from transformers import CLIPTextConfig, CLIPTextModelWithProjection

    with torch.device("meta"):
        ours = CLIPTextModelWithProjection(CLIPTextConfig(**described(network)))
        kind = {"clip_l": sd1_clip.SDClipModel, "clip_g": sdxl_clip.SDXLClipG}[name]
        theirs = shapes(kind(device="meta", dtype=torch.float32, model_options={}).transformer)
    ours = {key: shape for key, shape in shapes(ours).items() if "position_ids" not in key}
    assert {f"text_model.{key}" if not key.startswith("text_") else key: ours[key] for key in ours} == theirs


def test_the_autoencoder_described_is_the_one_comfyui_makes(pack: Any) -> None:
    import comfy.diffusers_convert
    import comfy.sd
    from diffusers import AutoencoderKL

    with torch.device("meta"):
        weights = AutoencoderKL.from_config(described("vae")).state_dict()
    named = comfy.diffusers_convert.convert_vae_state_dict(dict(weights))
    zeros = {name: torch.zeros(1).expand(tensor.shape) for name, tensor in named.items()}
    theirs = shapes(comfy.sd.VAE(sd=zeros, dtype=torch.float32).first_stage_model)
    # The attention's linear layers are written as convolutions of one pixel there.
    squeezed = {name: tuple(size for size in tensor.shape) for name, tensor in named.items()}
    assert squeezed == theirs


@pytest.fixture
def toy_description(pack: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The toy pipeline, and its description in the place of SDXL's."""
    pipeline = toy_sdxl.build_pipeline()
    module = pack_module("dl_core.backends.sdxl_files")
    folder = tmp_path / "description"
    folder.mkdir()
    (folder / "model_index.json").write_text((module.SDXL_FOLDER / "model_index.json").read_text())
    for name in ("unet", "controlnet", "vae"):
        getattr(pipeline, name).save_config(folder / name)
    for name in ("text_encoder", "text_encoder_2"):
        getattr(pipeline, name).config.save_pretrained(folder / name)
    pipeline.scheduler.save_config(folder / "scheduler")
    monkeypatch.setattr(module, "SDXL_FOLDER", folder)
    return pipeline


def test_a_checkpoint_of_comfyuis_loads_whole(toy_description: Any, tmp_path: Path) -> None:
    """ComfyUI writes checkpoints under the original names, as SDXL's are distributed; every weight must come back."""
    import comfy.sd

    networks = toy_sdxl.comfy_networks(toy_description)
    path = tmp_path / "checkpoint.safetensors"
    comfy.sd.save_checkpoint(str(path), networks["model"], networks["clip"], networks["vae"])
    module = pack_module("dl_core.backends.sdxl_files")
    loaded = module.load_base(path, torch.float32)
    for name in ("unet", "vae", "text_encoder", "text_encoder_2"):
        expected, found = getattr(toy_description, name).state_dict(), getattr(loaded, name).state_dict()
        assert expected.keys() == found.keys()
        for key in expected:
            torch.testing.assert_close(found[key], expected[key], rtol=0, atol=0, msg=f"{name} {key}")
    assert loaded.scheduler.config.timestep_spacing == "leading"
    text = "a perfect mirrored reflective chrome ball sphere"
    for name in ("tokenizer", "tokenizer_2"):
        ours, theirs = (getattr(side, name)(text, padding="max_length").input_ids for side in (loaded, toy_description))
        assert ours == theirs


def test_a_controlnet_of_one_file_loads_whole(toy_description: Any, tmp_path: Path) -> None:
    path = tmp_path / "depth.safetensors"
    save_file(dict(toy_description.controlnet.state_dict()), path)
    module = pack_module("dl_core.backends.sdxl_files")
    loaded = module.load_controlnet(path, toy_description, torch.float32)
    for key, expected in toy_description.controlnet.state_dict().items():
        assert torch.equal(loaded.state_dict()[key], expected)


def test_checkpoints_that_are_not_sdxl_are_named(toy_description: Any, tmp_path: Path) -> None:
    module, errors = pack_module("dl_core.backends.sdxl_files"), pack_module("dl_core.errors")
    path = tmp_path / "other.safetensors"
    save_file({"model.diffusion_model.input_blocks.0.0.weight": torch.zeros(64, 4, 3, 3)}, path)
    with pytest.raises(errors.ModelError, match=r"other\.safetensors: cannot be loaded as StableDiffusionXLPipeline"):
        module.load_base(path, torch.float32)
    with pytest.raises(errors.ModelError, match=r"other\.safetensors: cannot be loaded as ControlNetModel"):
        module.load_controlnet(path, toy_description, torch.float32)
