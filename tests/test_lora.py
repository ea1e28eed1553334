"""LoRA files of every naming act alike, and those that do not fit are refused by name."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest
import torch
from diffusers import StableDiffusionXLControlNetInpaintPipeline, UNet2DConditionModel, UniPCMultistepScheduler
from lora_files import ALPHA, CONVENTIONS, RANK, RandomLora, attention_layers, merged
from torch import Tensor

from dl_core.backends.diffusers_lora import add_lora, lora_shapes
from dl_core.backends.mini import SCHEDULER_CONFIG, UNET_CONFIG, MiniModel
from dl_core.errors import ModelError, OptionError
from dl_core.lora import LoraSwap, LowRank, read_lora
from dl_core.lora_names import WeightName, comfyui_layers, known_names, parse_weight_name

OUTPUTS = 1e-5
"""Outputs of order 1; a product added to a layer's output instead of its weight is the same sum in another order."""


@pytest.fixture(autouse=True)
def _no_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


@pytest.fixture(scope="module")
def mini() -> MiniModel:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return MiniModel.untrained()


def pipeline_of(unet: UNet2DConditionModel, mini: MiniModel) -> StableDiffusionXLControlNetInpaintPipeline:
    return StableDiffusionXLControlNetInpaintPipeline(
        vae=mini.vae,
        text_encoder=mini.text_encoder,
        text_encoder_2=mini.text_encoder_2,
        tokenizer=mini.tokenizer,
        tokenizer_2=mini.tokenizer_2,
        unet=unet,
        controlnet=mini.controlnet,
        scheduler=UniPCMultistepScheduler(**SCHEDULER_CONFIG),
    )


def copy_of(unet: UNet2DConditionModel, weights: dict[str, Tensor]) -> UNet2DConditionModel:
    twin = UNet2DConditionModel(**UNET_CONFIG).eval()
    twin.load_state_dict(weights)
    return twin


def output(unet: UNet2DConditionModel) -> Tensor:
    generator = torch.Generator().manual_seed(8)
    added = {"text_embeds": torch.randn(2, 32, generator=generator), "time_ids": torch.full((2, 6), 64.0)}
    latents = torch.randn(2, 4, 16, 16, generator=generator)
    tokens = torch.randn(2, 77, 64, generator=generator)
    found: Tensor = unet(latents, torch.tensor([900.0, 100.0]), tokens, added_cond_kwargs=added).sample
    return found


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_lora_of_any_naming_gives_what_merging_by_hand_gives(
    mini: MiniModel, generator: torch.Generator, convention: str
) -> None:
    weights = mini.unet.state_dict()
    shapes = lora_shapes(mini.unet)
    lora = RandomLora.on(attention_layers(shapes), generator)
    pipeline = pipeline_of(copy_of(mini.unet, weights), mini)
    add_lora(pipeline, lora.written(convention, comfyui_layers(shapes)), "test", "a LoRA")
    plain = output(mini.unet)
    for scale in (0.75, 2.0):
        pipeline.set_adapters("test", scale)
        expected = output(copy_of(mini.unet, merged(weights, lora, scale)))
        assert (expected - plain).abs().mean() > 100 * OUTPUTS
        assert (output(pipeline.unet) - expected).abs().max() < OUTPUTS


def test_convolutions_and_all_other_layers_take_a_lora(mini: MiniModel, generator: torch.Generator) -> None:
    weights, shapes = mini.unet.state_dict(), lora_shapes(mini.unet)
    lora = RandomLora.on(shapes, generator)
    assert any(len(shape) == 4 and shape[-1] == 3 for shape in shapes.values())
    pipeline = pipeline_of(copy_of(mini.unet, weights), mini)
    add_lora(pipeline, lora.written("ComfyUI", comfyui_layers(shapes)), "test", "a LoRA")
    pipeline.set_adapters("test", 0.5)
    expected = output(copy_of(mini.unet, merged(weights, lora, 0.5)))
    assert (output(pipeline.unet) - expected).abs().max() < 10 * OUTPUTS  # on ten times as many layers


def test_a_second_lora_sees_the_same_layers(mini: MiniModel, generator: torch.Generator) -> None:
    pipeline = pipeline_of(copy_of(mini.unet, mini.unet.state_dict()), mini)
    before = lora_shapes(pipeline.unet)
    lora = RandomLora.on(attention_layers(before), generator)
    add_lora(pipeline, lora.written("peft", comfyui_layers(before)), "first", "a LoRA")
    assert lora_shapes(pipeline.unet) == before


def test_layers_with_names_known_from_files_of_sdxl() -> None:
    """Pairs read off the two layouts of SDXL's UNet: levels of 320, 640, 1280, two blocks each."""
    layers = sdxl_layers()
    found = comfyui_layers(layers)
    block = "transformer_blocks.0.attn1.to_q"
    expected = {
        f"down_blocks.1.attentions.0.{block}": f"input_blocks.4.1.{block}",
        f"down_blocks.1.attentions.1.{block}": f"input_blocks.5.1.{block}",
        f"down_blocks.2.attentions.1.{block}": f"input_blocks.8.1.{block}",
        f"mid_block.attentions.0.{block}": f"middle_block.1.{block}",
        f"up_blocks.0.attentions.2.{block}": f"output_blocks.2.1.{block}",
        f"up_blocks.1.attentions.0.{block}": f"output_blocks.3.1.{block}",
        "down_blocks.0.downsamplers.0.conv": "input_blocks.3.0.op",
        "up_blocks.0.upsamplers.0.conv": "output_blocks.2.2.conv",
        "up_blocks.2.resnets.2.conv_shortcut": "output_blocks.8.0.skip_connection",
        "conv_in": "input_blocks.0.0",
    }
    assert {layer: found[layer] for layer in expected} == expected
    assert found.keys() == layers.keys()


def sdxl_layers() -> dict[str, tuple[int, ...]]:
    """Layers of SDXL's UNet at full depth and a tenth of the width; no memory is taken."""
    with torch.device("meta"):
        return lora_shapes(
            UNet2DConditionModel(
                down_block_types=("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
                up_block_types=("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
                block_out_channels=(32, 64, 128),
                transformer_layers_per_block=(1, 2, 10),
                attention_head_dim=(1, 1, 2),
                cross_attention_dim=64,
                use_linear_projection=True,
                addition_embed_type="text_time",
                addition_time_embed_dim=256,
                projection_class_embeddings_input_dim=6 * 256 + 32,
            )
        )


def test_no_name_stands_for_two_layers() -> None:
    """Underscores for dots lose where one name ends; on SDXL's layers nothing comes to coincide."""
    layers = sdxl_layers()
    comfyui = comfyui_layers(layers)
    assert len(set(comfyui.values())) == len(layers)
    outs = sum(layer.endswith(".to_out.0") for layer in layers)
    # conv_in and the like aside, the two names of a layer differ; to_out.0 has two more, without its place.
    same = sum(layer == comfyui[layer] for layer in layers)
    assert len(known_names(layers)) == 2 * len(layers) - same + 2 * outs


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("unet.a.b.processor.to_q_lora.down.weight", WeightName("a_b_to_q", "down")),
        ("base_model.model.unet.a.b.lora_B.my-adapter.weight", WeightName("a_b", "up")),
        ("model.diffusion_model.a.b.lora_A.weight", WeightName("a_b", "down")),
        ("lora_unet_a_b.alpha", WeightName("a_b", "alpha")),
        ("unet.a.processor.to_q_lora.alpha", WeightName("a_to_q", "alpha")),
        ("text_encoder_2.text_model.encoder.layers.0.q.lora_A.weight", "text encoder"),
        ("lora_te1_text_model_encoder_layers_0_mlp_fc1.alpha", "text encoder"),
        ("lora_unet_a_b.dora_scale", None),
        ("lora_unet_a_b.hada_w1_a", None),
        ("a.b.weight", None),
    ],
)
def test_names_are_taken_apart(name: str, expected: WeightName | str | None) -> None:
    assert parse_weight_name(name) == expected


# --- files that do not fit ---------------------------------------------------------------------------------------

SHAPES = {"down_blocks.0.attentions.0.to_q": (8, 6), "down_blocks.0.attentions.0.to_k": (8, 6)}


def pair(layer: str, down: tuple[int, ...] = (RANK, 6), up: tuple[int, ...] = (8, RANK)) -> dict[str, Tensor]:
    return {f"unet.{layer}.lora_A.weight": torch.ones(down), f"unet.{layer}.lora_B.weight": torch.ones(up)}


GOOD = pair("down_blocks.0.attentions.0.to_q")


def test_alpha_scales_and_is_the_rank_without() -> None:
    alpha = {"lora_unet_down_blocks_0_attentions_0_to_q.alpha": torch.tensor(ALPHA)}
    (with_alpha,), (without,) = (read_lora(file, SHAPES, "x").values() for file in (GOOD | alpha, GOOD))
    assert (with_alpha.scale, without.scale) == (ALPHA / RANK, 1.0)


def test_unmatched_weights_are_counted_and_the_first_named() -> None:
    strangers = {f"unet.up_blocks.{i}.to_q.lora_A.weight": torch.ones(RANK, 6) for i in range(5)}
    with pytest.raises(
        ModelError, match=r"x\.st: 5 of 7 weights have no place.*up_blocks\.0\.to_q.*up_blocks\.2\.to_q.*\.\.\."
    ) as caught:
        read_lora(GOOD | strangers, SHAPES, "x.st")
    assert "up_blocks.3" not in str(caught.value)


@pytest.mark.parametrize(
    ("extra", "named"),
    [
        ({"lora_unet_down_blocks_0_attentions_0_to_q.dora_scale": torch.ones(1)}, "dora_scale"),
        ({"unet.down_blocks.0.attentions.0.to_k.lora_A.weight": torch.ones(RANK, 6)}, r"to_k\.lora_A"),
        ({"lora_unet_down_blocks_0_attentions_0_to_k.alpha": torch.ones(())}, r"to_k\.alpha"),
        ({"lora_unet_down_blocks_0_attentions_0_to_q.lora_up.weight": torch.ones(8, RANK)}, r"to_q\.lora_up"),
    ],
    ids=["of another kind", "half a pair", "alpha alone", "twice"],
)
def test_weights_that_are_no_whole_product_are_named(extra: dict[str, Tensor], named: str) -> None:
    with pytest.raises(ModelError, match=f"1 of 3 weights have no place.*{named}"):
        read_lora(GOOD | extra, SHAPES, "x")


@pytest.mark.parametrize(
    ("down", "up"),
    [((RANK, 7), (8, RANK)), ((RANK, 6), (9, RANK)), ((RANK, 6), (8, 3)), ((RANK, 6, 1, 1), (8, RANK, 1, 1))],
)
def test_a_lora_for_another_base_is_refused_with_both_shapes(down: tuple[int, ...], up: tuple[int, ...]) -> None:
    with pytest.raises(ModelError, match=r"another model: down_blocks\.0\.attentions\.0\.to_q is \(8, 6\) here"):
        read_lora(pair("down_blocks.0.attentions.0.to_q", down, up), SHAPES, "x")


def test_a_product_fits_the_weight_it_makes() -> None:
    assert LowRank(torch.ones(2, 3, 5, 5), torch.ones(7, 2, 1, 1)).fits((7, 3, 5, 5))
    assert not LowRank(torch.ones(2, 3, 5, 5), torch.ones(7, 2, 1, 1)).fits((7, 3, 3, 3))


def test_weights_for_text_encoders_are_left_out_with_a_note(caplog: pytest.LogCaptureFixture) -> None:
    text = {"lora_te1_text_model_encoder_layers_0_mlp_fc1.lora_down.weight": torch.ones(4, 4)}
    with caplog.at_level(logging.WARNING):
        assert read_lora(GOOD | text, SHAPES, "x.st").keys() == {"down_blocks.0.attentions.0.to_q"}
    assert "x.st: its 1 weights for text encoders are left out: lora_te1" in caplog.text


def test_a_lora_without_weights_for_a_unet_is_refused() -> None:
    text = {"text_encoder.layers.0.lora_A.weight": torch.ones(4, 4)}
    with pytest.raises(ModelError, match="no weights for a UNet; it holds text_encoder"):
        read_lora(text, SHAPES, "x")
    with pytest.raises(ModelError, match="no weights for a UNet"):
        read_lora({}, SHAPES, "x")


# --- the swap ----------------------------------------------------------------------------------------------------


def test_turbo_acts_at_six_of_the_papers_thirty_steps() -> None:
    scheduler = UniPCMultistepScheduler(**SCHEDULER_CONFIG, timestep_spacing="leading", steps_offset=1)
    scheduler.set_timesteps(30)
    swap = LoraSwap()
    acting = [swap.turbo_at(float(timestep)) for timestep in scheduler.timesteps]
    assert acting == [True] * 6 + [False] * 24
    assert (swap.turbo_at(800), swap.turbo_at(799.9)) == (True, False)
    assert (swap.turbo_scale, swap.exposure_scale) == (1.0, 0.75)


@pytest.mark.parametrize("timestep", [-1, 1001, float("nan")])
def test_a_swap_outside_the_schedule_is_refused(timestep: float) -> None:
    with pytest.raises(OptionError, match=r"timestep is .*0 to 1000"):
        LoraSwap(timestep=timestep)
