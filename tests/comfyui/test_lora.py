"""LoRAs on ComfyUI's MODEL: of every naming, in its weights or at run time, they do what merging by hand does."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import comfy_host
import pytest
import torch
from comfy_host import pack_module
from lora_files import CONVENTIONS, RandomLora, attention_layers, merged

OUTPUTS = 2e-5
"""Outputs of order 1; a product added to a layer's output instead of its weight is the same sum in another order."""


def lora_shapes(mini: Any) -> dict[str, tuple[int, ...]]:
    return pack_module("dl_core.backends.diffusers_lora").lora_shapes(mini.unet)


def comfyui_names(model: Any) -> dict[str, str]:
    """ComfyUI's own table of a UNet's layers: diffusers' name -> ComfyUI's."""
    import comfy.utils

    table = comfy.utils.unet_to_diffusers(model.model.model_config.unet_config)
    return {ours.removesuffix(".weight"): theirs.removesuffix(".weight") for ours, theirs in table.items()}


@pytest.fixture(autouse=True)
def _nothing_loaded(pack: Any) -> None:
    """ComfyUI takes the LoRA of the last run off a network only when it loads another; here it is patched directly."""
    import comfy.model_management

    comfy.model_management.unload_all_models()


def random_lora(graph: Any, generator: torch.Generator) -> RandomLora:
    return RandomLora.on(attention_layers(lora_shapes(graph.mini)), generator)


def output(model: Any, timestep: float = 900.0, wrappers: Mapping[str, Any] | None = None) -> torch.Tensor:
    generator = torch.Generator().manual_seed(8)
    latents, tokens = torch.randn(2, 4, 16, 16, generator=generator), torch.randn(2, 77, 64, generator=generator)
    vector = torch.randn(2, 6 * 256 + 32, generator=generator)
    options = {} if wrappers is None else {"transformer_options": {"wrappers": wrappers}}
    network = model.model.diffusion_model
    return network(latents, torch.full((2,), timestep), context=tokens, y=vector, **options)


def output_by_hand(graph: Any, lora: RandomLora, scale: float) -> torch.Tensor:
    """Of a twin whose weights were merged before ComfyUI saw them."""
    from diffusers import UNet2DConditionModel

    config = pack_module("dl_core.backends.mini").UNET_CONFIG
    twin = UNet2DConditionModel(**config)
    twin.load_state_dict(merged(graph.mini.unet.state_dict(), lora, scale))
    return output(pack_module("nodes.mini").to_model(SimpleNamespace(unet=twin, lora=None), 0))


def output_patched(patched: Any) -> torch.Tensor:
    patched.patch_model()
    try:
        return output(patched)
    finally:
        patched.unpatch_model()


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_lora_of_any_naming_gives_what_merging_by_hand_gives(
    graph: Any, generator: torch.Generator, convention: str
) -> None:
    lora = random_lora(graph, generator)
    weights = lora.written(convention, comfyui_names(graph.model))
    found = output_patched(pack_module("nodes.lora").with_lora(graph.model, weights, 0.75, "test"))
    expected, plain = output_by_hand(graph, lora, 0.75), output(graph.model)
    assert (expected - plain).abs().mean() > 100 * OUTPUTS
    assert (found - expected).abs().max() < OUTPUTS


def test_all_layers_take_a_lora(graph: Any, generator: torch.Generator) -> None:
    """Convolutions too, in the weights and at run time."""
    lora = RandomLora.on(lora_shapes(graph.mini), generator)
    module = pack_module("nodes.lora")
    weights = lora.written("ComfyUI", comfyui_names(graph.model))
    expected = output_by_hand(graph, lora, 0.5)
    found = output_patched(module.with_lora(graph.model, weights, 0.5, "test"))
    assert (found - expected).abs().max() < 10 * OUTPUTS  # on ten times as many layers
    swap = pack_module("dl_core.lora").LoraSwap(turbo_scale=0.5)
    swapped = module.with_lora_swap(graph.model, weights, weights, swap)
    assert (output(swapped, wrappers=swapped.wrappers) - expected).abs().max() < 10 * OUTPUTS


def test_names_of_layers_are_comfyuis(graph: Any) -> None:
    shapes, table = lora_shapes(graph.mini), comfyui_names(graph.model)
    ours = pack_module("dl_core.lora_names").comfyui_layers(shapes)
    assert ours == {layer: table[layer] for layer in shapes}


def test_names_of_sdxls_layers_are_comfyuis(pack: Any) -> None:
    """By the table ComfyUI makes of SDXL's own configuration, for every layer it knows."""
    import comfy.supported_models
    import comfy.utils

    config = comfy.supported_models.SDXL.unet_config | {
        "channel_mult": [1, 2, 4],
        "num_res_blocks": [2, 2, 2],
        "transformer_depth_middle": 10,
        "transformer_depth_output": [0, 0, 0, 2, 2, 2, 10, 10, 10],
    }
    table = comfy.utils.unet_to_diffusers(config)
    layers = {
        ours.removesuffix(".weight"): theirs.removesuffix(".weight")
        for ours, theirs in table.items()
        # ComfyUI's table lists a resampler for the last level, which has none, and gives the label embedding two names.
        if ours.endswith(".weight")
        and "norm" not in ours
        and not ours.startswith(("class_", "down_blocks.2.downsamplers", "up_blocks.2.upsamplers"))
    }
    assert len(layers) > 700
    assert pack_module("dl_core.lora_names").comfyui_layers(layers) == layers


def test_a_lora_for_another_model_is_refused(graph: Any) -> None:
    errors, module = pack_module("dl_core.errors"), pack_module("nodes.lora")
    stranger = {"transformer.blocks.0.lora_A.weight": torch.ones(1)}
    with pytest.raises(errors.ModelError, match=r"lora x: 1 of 1 weights have no place in this UNet: transformer"):
        module.with_lora(graph.model, stranger, 1, "lora x")


def test_a_lora_on_another_model_is_refused_by_socket(pack: Any) -> None:
    errors, module = pack_module("dl_core.errors"), pack_module("nodes.lora")
    with pytest.raises(errors.ModelError, match="socket model: holds Identity; a model of SDXL's architecture"):
        module.with_lora(SimpleNamespace(model=torch.nn.Identity()), {}, 1, "lora x")


# --- the swap ----------------------------------------------------------------------------------------------------


@pytest.fixture
def loras(graph: Any, generator: torch.Generator) -> tuple[RandomLora, RandomLora]:
    return random_lora(graph, generator), random_lora(graph, generator)


def files(graph: Any, loras: tuple[RandomLora, RandomLora]) -> tuple[dict[str, torch.Tensor], ...]:
    names = comfyui_names(graph.model)
    return loras[0].written("kohya for SDXL", names), loras[1].written("diffusers, attention processors", names)


@pytest.mark.parametrize(("timestep", "which", "scale"), [(961.0, 0, 1.0), (800.0, 0, 1.0), (799.0, 1, 0.75)])
def test_one_lora_acts_by_the_timestep(graph: Any, loras: Any, timestep: float, which: int, scale: float) -> None:
    swap = pack_module("dl_core.lora").LoraSwap()
    swapped = pack_module("nodes.lora").with_lora_swap(graph.model, *files(graph, loras), swap)
    found = output(swapped, timestep, swapped.wrappers)
    alone = pack_module("nodes.lora").with_lora(graph.model, files(graph, loras)[which], scale, "alone")
    alone.patch_model()
    expected = output(alone, timestep)
    alone.unpatch_model()
    assert (found - expected).abs().max() < OUTPUTS


def test_nothing_stays_behind_on_the_network(graph: Any, loras: Any) -> None:
    """Weights untouched, hooks gone, also after an evaluation that failed."""
    before = {name: value.clone() for name, value in graph.model.model.diffusion_model.state_dict().items()}
    plain = output(graph.model)
    swap = pack_module("dl_core.lora").LoraSwap()
    swapped = pack_module("nodes.lora").with_lora_swap(graph.model, *files(graph, loras), swap)
    output(swapped, wrappers=swapped.wrappers)
    with pytest.raises(RuntimeError):
        swapped.model.diffusion_model(
            torch.ones(1, 3, 8, 8),
            torch.ones(1),
            context=torch.ones(1, 77, 64),
            y=torch.ones(1, 1568),
            transformer_options={"wrappers": swapped.wrappers},
        )
    assert torch.equal(output(graph.model), plain)
    assert all(not module._forward_hooks for module in graph.model.model.diffusion_model.modules())
    after = graph.model.model.diffusion_model.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert swapped.patches == {}  # so ComfyUI has nothing to merge or to take out


class Recorder:
    """An observer that does nothing."""

    def evaluated(self, count: int) -> None:
        pass


@pytest.fixture
def seen(graph: Any) -> Iterator[list[tuple[float, torch.Tensor, torch.Tensor]]]:
    """Timestep, input and output of every evaluation of the network."""
    calls: list[tuple[float, torch.Tensor, torch.Tensor]] = []
    hook = graph.model.model.diffusion_model.register_forward_hook(
        lambda module, arguments, result: calls.append((float(arguments[1][0]), arguments[0].clone(), result.clone()))
    )
    yield calls
    hook.remove()


def paint(graph: Any, scene: Any, model: Any, **options: Any) -> Any:
    module, ports = pack_module("nodes.painter"), pack_module("dl_core.painter")
    options = {"sampler": "euler", "cfg": 3.0, "batch_size": 2} | options
    networks = module.Networks(**(graph.sockets() | {"model": model}))
    asked = ports.PaintRequest(scene.canvas, scene.depth, scene.ball, 0.0, (0, 1), steps=10)
    return module.ComfyPainter(networks, module.Guidance(**options)).paint(asked, Recorder())


@pytest.mark.parametrize("sampler", ["euler", "uni_pc"])
def test_within_a_pass_turbo_acts_before_the_swap_alone_and_the_exposure_lora_after(
    graph: Any, scene: Any, loras: Any, seen: Any, sampler: str
) -> None:
    """Up to the swap the pass is the one of the Turbo LoRA alone; from there on it departs from it.

    Ten steps visit 901, 811, 721 ...: two lie before the swap, and the latents of the third are theirs.
    """
    module, kind = pack_module("nodes.lora"), pack_module("dl_core.lora").LoraSwap
    turbo, exposure = files(graph, loras)
    result = paint(graph, scene, module.with_lora_swap(graph.model, turbo, exposure, kind()), sampler=sampler)
    both = list(seen)
    seen.clear()
    assert result.evaluations == sum(len(latents) for _, latents, _ in both) == 2 * 2 * 10
    assert [timestep >= 800 for timestep, _, _ in both] == [True] * 2 + [False] * 8
    paint(graph, scene, module.with_lora(graph.model, turbo, 1.0, "turbo"), sampler=sampler)
    differences = [float((ours[1] - theirs[1]).abs().max()) for ours, theirs in zip(both, seen, strict=True)]
    assert max(differences[:3]) < 1e-4 < differences[3]
    assert (both[2][2] - seen[2][2]).abs().max() > 1e-3
    seen.clear()
    # From the exposure LoRA's first step on: what it gives alone for the same latents, which the swap at 1000 shows.
    paint(graph, scene, module.with_lora_swap(graph.model, turbo, exposure, kind(timestep=1000)), sampler=sampler)
    late = list(seen)
    seen.clear()
    paint(graph, scene, module.with_lora(graph.model, exposure, 0.75, "exposure"), sampler=sampler)
    assert max(float((ours[2] - theirs[2]).abs().max()) for ours, theirs in zip(late, seen, strict=True)) < 1e-3


def test_both_prompts_are_evaluated_with_the_same_lora_and_in_one_batch(
    graph: Any, scene: Any, loras: Any, seen: Any
) -> None:
    swap = pack_module("dl_core.lora").LoraSwap()
    paint(graph, scene, pack_module("nodes.lora").with_lora_swap(graph.model, *files(graph, loras), swap))
    assert [len(latents) for _, latents, _ in seen] == [4] * 10


def test_copies_of_the_loras_are_released_after_a_pass(graph: Any, scene: Any, loras: Any) -> None:
    swap = pack_module("dl_core.lora").LoraSwap()
    swapped = pack_module("nodes.lora").with_lora_swap(graph.model, *files(graph, loras), swap)
    ((evaluate,),) = [list(kept) for kind in swapped.wrappers.values() for kept in kind.values() if kept]
    (held,) = [cell.cell_contents for cell in evaluate.__closure__ if isinstance(cell.cell_contents, dict)]
    output(swapped, wrappers=swapped.wrappers)
    assert held[True]._resident
    paint(graph, scene, swapped)
    assert not held[True]._resident
    assert not held[False]._resident


@pytest.mark.parametrize(("strength", "timestep"), [(1.0, 800), (0.8, 500)])
def test_swap_agrees_with_diffusers(
    trained_graph: Any,
    mini_scene: Any,
    generator: torch.Generator,
    monkeypatch: pytest.MonkeyPatch,
    strength: float,
    timestep: int,
) -> None:
    """Balls of both painters on trained weights, by Euler on the same timesteps.

    Six steps visit 853, 711, 569 ...: at strength 0.8 the last four. One of them lies before the swap.
    """
    backend, adapters = (pack_module(f"dl_core.backends.{name}") for name in ("diffusers_painter", "diffusers_lora"))
    monkeypatch.setitem(backend.SAMPLERS, "leading_euler", comfy_host.leading_euler)
    mini = trained_graph.mini
    shapes = attention_layers(lora_shapes(mini))
    # As large as the weights themselves, so that one step with the wrong LoRA is seen in the ball.
    loras = RandomLora.on(shapes, generator, size=1.0), RandomLora.on(shapes, generator, size=1.0)
    turbo, exposure = files(trained_graph, loras)
    swap = pack_module("dl_core.lora").LoraSwap(timestep)

    mini = replace(mini, defaults=replace(mini.defaults, guidance=3.0, control_scale=0.5))
    unet = type(mini.unet).from_config(mini.unet.config).eval()
    unet.load_state_dict(mini.unet.state_dict())  # adapters stay on a UNet
    theirs = backend.DiffusersPainter.from_mini(replace(mini, unet=unet), sampler="leading_euler", lora_swap=swap)
    adapters.add_lora(theirs.pipeline, exposure, adapters.EXPOSURE, "exposure")
    adapters.add_lora(theirs.pipeline, turbo, adapters.TURBO, "turbo")
    painting, ports, module = (pack_module(name) for name in ("nodes.painter", "dl_core.painter", "nodes.lora"))

    def painter(model: Any) -> Any:
        networks = painting.Networks(**(trained_graph.sockets() | {"model": model}))
        return painting.ComfyPainter(networks, painting.Guidance(cfg=3.0, sampler="euler"))

    ours = painter(module.with_lora_swap(trained_graph.model, turbo, exposure, swap))
    unswapped = painter(module.with_lora(trained_graph.model, exposure, 0.75, "exposure"))
    asked = ports.PaintRequest(
        mini_scene.canvas, mini_scene.depth, mini_scene.ball, 0.0, (0,), steps=6, strength=strength
    )
    expected, found, other = (brush.paint(asked, Recorder()) for brush in (theirs, ours, unswapped))
    assert expected.balls.std() > 0.05
    # The painters differ by about as much without LoRAs (bench_parity.py), for what nodes/painter.py says of cells
    # the mask covers partly.
    apart, wrong = (float((brush.balls - expected.balls).abs().mean()) for brush in (found, other))
    assert apart < 1e-3
    assert 3 * apart < wrong
    assert found.evaluations == expected.evaluations == ours.evaluations(1, 6, strength) == {1.0: 12, 0.8: 8}[strength]
