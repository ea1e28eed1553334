"""The LoRA trainer on SDXL's architecture with random weights; what it writes acts alike in every host."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import toy_sdxl
from comfy_host import pack_module
from torch import Tensor

CANVAS = 64
STEPS = 4
OUTPUTS = 2e-5
"""Outputs of order 1; a product added to a layer's output instead of its weight is the same sum in another order."""


@dataclass(frozen=True)
class Trained:
    """A LoRA of a few steps, as a file, and the networks it was trained on, without it."""

    pipeline: Any
    file: Path
    log: list[str]

    def weights(self) -> dict[str, Tensor]:
        from safetensors.torch import load_file

        return load_file(self.file)

    def fresh(self) -> Any:
        return with_own_unet(self.pipeline)


def with_own_unet(pipeline: Any) -> Any:
    """A pipeline of the same networks but for a copy of the UNet."""
    return type(pipeline)(**{**pipeline.components, "unet": copy.deepcopy(pipeline.unet)})


def drawn_pairs(count: int) -> list[Any]:
    generator = torch.Generator().manual_seed(3)
    ball = pack_module("dl_core.ball").place_ball(CANVAS, 32)
    pictures = torch.rand(count, 1, CANVAS, CANVAS, 3, generator=generator)
    evs = torch.linspace(0, -5, count).tolist()
    return [
        SimpleNamespace(image=picture, ball=ball, ev=ev, panorama="noise")
        for picture, ev in zip(pictures, evs, strict=True)
    ]


def train(pipeline: Any, work: Path, steps: int, log: list[str]) -> Any:
    settings = replace(
        pack_module("dl_core.training.lora.settings").LoraSettings(gradient_checkpointing=True),
        steps=steps,
        batch=1,
        learning_rate=1e-2,  # so that a few steps make a difference
    )
    base = pack_module("dl_core.training.lora.base").LoraBase(
        "toy", pipeline, pack_module("dl_core.backends.diffusers_painter").PAPER_DEFAULTS
    )
    (trained,) = pack_module("dl_core.training.lora.exposure_lora").train_exposure_loras(
        base, drawn_pairs(3), settings, work, report=log.append
    )
    return trained


@pytest.fixture(scope="module")
def trained(pack: Any, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """In two runs, the second of which goes on from the first."""
    folder = tmp_path_factory.mktemp("lora")
    log: list[str] = []
    pipeline = toy_sdxl.build_pipeline()
    train(with_own_unet(pipeline), folder, STEPS // 2, log)
    lora = train(with_own_unet(pipeline), folder, STEPS, log)
    file = folder / "lora.safetensors"
    pack_module("dl_core.training.tensor_files").write_tensors(file, lora.weights, lora.metadata)
    return Trained(pipeline, file, log)


def output(unet: Any) -> Tensor:
    generator = torch.Generator().manual_seed(8)
    added = {"text_embeds": torch.randn(1, toy_sdxl.POOLED, generator=generator), "time_ids": torch.full((1, 6), 64.0)}
    latents, tokens = (
        torch.randn(1, 4, 8, 8, generator=generator),
        torch.randn(1, 77, toy_sdxl.TOKENS, generator=generator),
    )
    with torch.no_grad():
        found: Tensor = unet(latents, torch.tensor([900.0]), tokens, added_cond_kwargs=added).sample
    return found


def output_in_comfyui(model: Any) -> Tensor:
    """The same inputs; ComfyUI takes the pooled text and the embedded sizes as one vector."""
    from diffusers.models.embeddings import get_timestep_embedding

    generator = torch.Generator().manual_seed(8)
    pooled = torch.randn(1, toy_sdxl.POOLED, generator=generator)
    latents, tokens = (
        torch.randn(1, 4, 8, 8, generator=generator),
        torch.randn(1, 77, toy_sdxl.TOKENS, generator=generator),
    )
    sizes = get_timestep_embedding(torch.full((6,), 64.0), 256, flip_sin_to_cos=True, downscale_freq_shift=0).flatten()
    model.patch_model()
    try:
        with torch.no_grad():
            found: Tensor = model.model.diffusion_model(
                latents, torch.tensor([900.0]), context=tokens, y=torch.cat((pooled, sizes[None]), dim=1)
            )
        return found
    finally:
        model.unpatch_model()


def merged_by_hand(trained: Trained, scale: float) -> Tensor:
    """Up times down, added to each projection's weight by its place in the network, not by any reader of files."""
    unet, weights = trained.fresh().unet, trained.weights()
    names = pack_module("dl_core.lora_names").comfyui_layers(
        pack_module("dl_core.backends.diffusers_lora").lora_shapes(unet)
    )
    touched = 0
    for name, layer in unet.named_modules():
        if name.endswith((".to_q", ".to_k", ".to_v", ".to_out.0")):
            stem = "lora_unet_" + names[name].replace(".", "_")
            up, down = weights.pop(f"{stem}.lora_up.weight"), weights.pop(f"{stem}.lora_down.weight")
            assert weights.pop(f"{stem}.alpha") == len(down)
            layer.weight.data += scale * up @ down
            touched += 1
    assert not weights
    assert touched == 4 * sum(name.endswith((".attn1", ".attn2")) for name, _ in unet.named_modules())
    return output(unet)


@pytest.mark.parametrize("scale", [1.0, 0.75])
def test_the_file_does_in_diffusers_what_merging_by_hand_does(trained: Trained, scale: float) -> None:
    pipeline = trained.fresh()
    pipeline.load_lora_weights(str(trained.file), adapter_name="exposure")
    pipeline.set_adapters("exposure", scale)
    expected = merged_by_hand(trained, scale)
    assert (expected - output(trained.pipeline.unet)).abs().mean() > 100 * OUTPUTS
    assert (output(pipeline.unet) - expected).abs().max() < OUTPUTS


def test_the_file_does_here_what_merging_by_hand_does(trained: Trained) -> None:
    pipeline = trained.fresh()
    weights = pack_module("dl_core.backends.mini").read_weights(trained.file)
    pack_module("dl_core.backends.diffusers_lora").add_lora(pipeline, weights, "exposure", trained.file)
    pipeline.set_adapters("exposure", 0.75)
    assert (output(pipeline.unet) - merged_by_hand(trained, 0.75)).abs().max() < OUTPUTS


def test_comfyuis_own_loader_does_what_merging_by_hand_does(
    trained: Trained, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import comfy.model_management
    import folder_paths

    from nodes import LoraLoader

    comfy.model_management.unload_all_models()
    monkeypatch.setattr(folder_paths, "get_full_path_or_raise", lambda folder, name: str(trained.file))
    graph = toy_sdxl.comfy_networks(trained.pipeline)
    assert (output_in_comfyui(graph["model"]) - output(trained.pipeline.unet)).abs().max() < OUTPUTS
    model, _ = LoraLoader().load_lora(graph["model"], graph["clip"], trained.file.name, 0.75, 0.75)
    assert "lora key not loaded" not in caplog.text
    assert (output_in_comfyui(model) - merged_by_hand(trained, 0.75)).abs().max() < OUTPUTS


def test_a_training_goes_on_and_says_what_it_made(trained: Trained) -> None:
    from safetensors import safe_open

    assert "going on from step 2" in trained.log
    with safe_open(trained.file, framework="pt") as file:
        said = file.metadata()
    assert said["base"].startswith("toy ")
    expected = {"rank": "4", "ev_min": "-5", "steps": str(STEPS), "timesteps": "900-999", "pairs": "3", "batch": "1"}
    assert {name: said[name] for name in expected} == expected
    assert said["prompt"] == "a perfect mirrored reflective chrome ball sphere"
