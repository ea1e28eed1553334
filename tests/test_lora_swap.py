"""The Turbo LoRA and the exposure LoRA share a pass of DiffusersPainter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diffusers import StableDiffusionXLPipeline
from lora_files import RandomLora, attention_layers
from safetensors.torch import save_file
from torch import Tensor

from dl_core.backends.diffusers_lora import EXPOSURE, TURBO, add_lora, lora_shapes
from dl_core.backends.diffusers_painter import DiffusersPainter
from dl_core.backends.loading import BACKENDS, ModelFiles
from dl_core.backends.mini import MiniModel
from dl_core.ball import paint_depth, place_ball
from dl_core.errors import ModelError, OptionError
from dl_core.iterative import iterative_inpaint
from dl_core.lora import LoraSwap
from dl_core.lora_names import comfyui_layers
from dl_core.painter import PaintRequest, SilentObserver
from dl_core.presets import preset

SIDE = 64
STEPS = 5
"""They visit 831, 665 ...: one before the swap at 800."""

Call = tuple[float, Tensor, Tensor]
"""Timestep, latents and prediction of one evaluation."""


@pytest.fixture(scope="module")
def model() -> MiniModel:
    with torch.random.fork_rng():
        torch.manual_seed(5)
        return MiniModel.untrained()


@pytest.fixture(scope="module")
def loras(model: MiniModel) -> dict[str, dict[str, Tensor]]:
    """Weights of two random LoRAs, written differently."""
    generator = torch.Generator().manual_seed(6)
    layers = lora_shapes(model.unet)
    shapes, names = attention_layers(layers), comfyui_layers(layers)
    conventions = {EXPOSURE: "diffusers, attention processors", TURBO: "ComfyUI"}
    return {name: RandomLora.on(shapes, generator).written(kind, names) for name, kind in conventions.items()}


def painter_with(
    model: MiniModel, loras: dict[str, dict[str, Tensor]], swap: LoraSwap | None, sampler: str = "unipc"
) -> DiffusersPainter:
    unet = type(model.unet).from_config(model.unet.config).eval()
    unet.load_state_dict(model.unet.state_dict())  # adapters stay on a UNet, so each painter has its own
    painter = DiffusersPainter.from_mini(replace(model, unet=unet), sampler=sampler, lora_swap=swap)
    for name, weights in loras.items():
        add_lora(painter.pipeline, weights, name, name)
    return painter


@pytest.fixture(scope="module")
def request_() -> PaintRequest:
    ball = place_ball(SIDE, 32)
    canvas = torch.rand(1, SIDE, SIDE, 3, generator=torch.Generator().manual_seed(9))
    return PaintRequest(canvas, paint_depth(None, ball), ball, 0.0, (0,), steps=STEPS)


def calls_of(painter: DiffusersPainter, request: PaintRequest) -> list[Call]:
    """Every evaluation of a pass."""
    seen: list[Call] = []
    hook = painter.pipeline.unet.register_forward_hook(
        lambda module, inputs, output: seen.append((float(inputs[1]), inputs[0].clone(), output[0].clone()))
    )
    try:
        painter.paint(request, SilentObserver())
    finally:
        hook.remove()
    return seen


def alone(
    model: MiniModel, loras: dict[str, dict[str, Tensor]], name: str, scale: float, sampler: str
) -> DiffusersPainter:
    painter = painter_with(model, {name: loras[name]}, None, sampler)
    painter.pipeline.set_adapters(name, scale)
    return painter


@pytest.mark.parametrize("sampler", ["unipc", "ddim"])
def test_turbo_acts_alone_before_the_swap_and_the_exposure_lora_alone_after(
    model: MiniModel, loras: dict[str, dict[str, Tensor]], request_: PaintRequest, sampler: str
) -> None:
    painter = painter_with(model, loras, LoraSwap(), sampler)
    seen, again = (calls_of(painter, request_) for _ in range(2))
    before = [timestep >= 800 for timestep, _, _ in seen]
    assert before == sorted(before, reverse=True)
    swap = sum(before)
    assert 0 < swap < STEPS
    turbo = calls_of(alone(model, loras, TURBO, 1.0, sampler), request_)
    # The same sums of products up to the swap, whose first latents are still Turbo's; its prediction is not.
    for i in range(swap + 1):
        torch.testing.assert_close(seen[i][1], turbo[i][1], rtol=0, atol=1e-5)
    assert (seen[swap][2] - turbo[swap][2]).abs().max() > 1e-3
    exposure = alone(model, loras, EXPOSURE, 0.75, sampler)
    with torch.no_grad(), exposure._hint(request_.depth) as hint:
        denoise = exposure._denoiser(request_, hint, 1)
        for timestep, latents, prediction in seen[swap:]:
            unwanted, wanted = prediction.chunk(2)
            guided = unwanted + model.defaults.guidance * (wanted - unwanted)
            found = denoise(latents[:1], torch.tensor(timestep))
            torch.testing.assert_close(found, guided, rtol=0, atol=1e-4)
    # The next ball begins with the Turbo LoRA again.
    assert all(torch.equal(one[2], two[2]) for one, two in zip(seen, again, strict=True))


def test_the_preset_is_one_pass_an_exposure(
    model: MiniModel, loras: dict[str, dict[str, Tensor]], request_: PaintRequest
) -> None:
    """30 steps, the negative prompt beside the prompt: 60 evaluations of the UNet, of which 12 with the Turbo LoRA."""
    row = preset("turbo")
    painter = painter_with(model, loras, LoraSwap())
    evaluations: list[tuple[float, int]] = []
    hook = painter.pipeline.unet.register_forward_hook(
        lambda module, inputs, output: evaluations.append((float(inputs[1]), len(inputs[0])))
    )
    result = iterative_inpaint(painter, request_, row.rounds)
    hook.remove()
    assert result.evaluations == sum(count for _, count in evaluations) == 60
    assert sum(count for timestep, count in evaluations if timestep >= 800) == 12
    assert row.guided_steps == 90
    assert row.evs == (0.0, -2.5, -5.0)


@pytest.fixture(scope="module")
def folder(model: MiniModel, loras: dict[str, dict[str, Tensor]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model's files as users have SDXL's: a pipeline, a ControlNet, two LoRAs."""
    folder = tmp_path_factory.mktemp("files")
    painter = DiffusersPainter.from_mini(model)
    parts = {name: part for name, part in painter.pipeline.components.items() if name != "controlnet"}
    StableDiffusionXLPipeline(**parts).save_pretrained(folder / "sdxl")
    model.controlnet.save_pretrained(folder / "depth")
    for name, weights in loras.items():
        save_file({key: value.contiguous() for key, value in weights.items()}, folder / f"{name}.safetensors")
    return folder


def test_both_loras_load_from_files(
    model: MiniModel, loras: dict[str, dict[str, Tensor]], request_: PaintRequest, folder: Path
) -> None:
    files = ModelFiles(folder / "sdxl", folder / "depth", folder / f"{EXPOSURE}.safetensors")
    defaults = BACKENDS["diffusers"].load(files, "initial").painter.defaults  # type: ignore[attr-defined]
    swapped = BACKENDS["diffusers"].load(replace(files, turbo_lora=folder / f"{TURBO}.safetensors"), "initial").painter
    assert isinstance(swapped, DiffusersPainter)
    assert swapped.lora_swap == LoraSwap(800, 1.0, 0.75)
    expected = painter_with(replace(model, defaults=defaults), loras, LoraSwap()).paint(request_, SilentObserver())
    found = swapped.paint(request_, SilentObserver())
    torch.testing.assert_close(found.balls, expected.balls, rtol=0, atol=1e-5)


def test_lora_files_that_do_not_serve_are_named(folder: Path, tmp_path: Path) -> None:
    files = (folder / "sdxl", folder / "depth")
    with pytest.raises(
        OptionError, match=r"turbo_lora is .*turbo\.safetensors'; accepted: none without an exposure LoRA"
    ):
        DiffusersPainter.from_files(*files, turbo_lora=folder / "turbo.safetensors")
    with pytest.raises(ModelError, match=r"none\.safetensors: no such model file"):
        DiffusersPainter.from_files(*files, tmp_path / "none.safetensors")
    save_file({"unet.nowhere.lora_A.weight": torch.ones(4, 4)}, tmp_path / "other.safetensors")
    with pytest.raises(ModelError, match=r"other\.safetensors: 1 of 1 weights have no place.*unet\.nowhere"):
        DiffusersPainter.from_files(*files, tmp_path / "other.safetensors")
