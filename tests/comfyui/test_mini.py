"""The mini model gives the same numbers in ComfyUI's classes as in diffusers' and transformers'."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from comfy_host import pack_module

EMBEDDINGS = 1e-5  # of order 1, a few dozen float32 operations deep
NETWORKS = 1e-4  # of order 0.3, several hundred operations deep
PIXELS = 1e-5


def step_inputs(generator: torch.Generator, size: int = 16) -> dict[str, torch.Tensor]:
    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    side = float(size * 8)
    return {
        "x": draw(2, 4, size, size),
        "t": torch.tensor([961.0, 33.0]),
        "context": draw(2, 77, 64),
        "pooled": draw(2, 32),
        "ids": torch.tensor([[side, side, 0, 0, side, side]] * 2),
        "hint": torch.rand(2, 3, size * 8, size * 8, generator=generator),
    }


def comfy_vector(graph: Any, inputs: dict[str, torch.Tensor]) -> torch.Tensor:
    embed = graph.model.model.embedder
    sizes = [embed(inputs["ids"][:, i]) for i in range(6)]
    return torch.cat([inputs["pooled"], *sizes], dim=1)


@pytest.mark.parametrize(
    "text", ["a perfect mirrored reflective chrome ball sphere", "", "matte, diffuse, flat, dull", "(ball:1.0) " * 20]
)
def test_text_embeddings(graph: Any, text: str) -> None:
    plain = text.replace("(ball:1.0)", "ball")
    tokens, pooled = graph.clip.encode_from_tokens(graph.clip.tokenize(text), return_pooled=True)
    outputs = []
    for name in ("", "_2"):
        tokenizer, encoder = getattr(graph.mini, f"tokenizer{name}"), getattr(graph.mini, f"text_encoder{name}")
        ids = tokenizer(plain, padding="max_length", max_length=77, truncation=True, return_tensors="pt").input_ids
        outputs.append(encoder(ids, output_hidden_states=True))
    expected = torch.cat([output.hidden_states[-2] for output in outputs], dim=-1)
    assert (tokens - expected).abs().max() < EMBEDDINGS
    assert (pooled - outputs[1].text_embeds).abs().max() < EMBEDDINGS


def test_unet(graph: Any, generator: torch.Generator) -> None:
    inputs = step_inputs(generator)
    network = graph.model.model.diffusion_model
    found = network(inputs["x"], inputs["t"], context=inputs["context"], y=comfy_vector(graph, inputs))
    added = {"text_embeds": inputs["pooled"], "time_ids": inputs["ids"]}
    expected = graph.mini.unet(inputs["x"], inputs["t"], inputs["context"], added_cond_kwargs=added).sample
    assert expected.std() > 0.1
    assert (found - expected).abs().max() < NETWORKS


def test_controlnet(graph: Any, generator: torch.Generator) -> None:
    inputs = step_inputs(generator)
    found = graph.control_net.control_model(
        x=inputs["x"],
        hint=inputs["hint"],
        timesteps=inputs["t"],
        context=inputs["context"],
        y=comfy_vector(graph, inputs),
    )
    added = {"text_embeds": inputs["pooled"], "time_ids": inputs["ids"]}
    down, middle = graph.mini.controlnet(
        inputs["x"], inputs["t"], inputs["context"], inputs["hint"], 1.0, added_cond_kwargs=added, return_dict=False
    )
    assert middle.std() > 0.01
    for ours, theirs in zip([*found["output"], *found["middle"]], [*down, middle], strict=True):
        assert (ours - theirs).abs().max() < NETWORKS


def test_autoencoder(graph: Any, generator: torch.Generator) -> None:
    picture = torch.rand(2, 64, 96, 3, generator=generator)
    latents = graph.vae.encode(picture)
    expected = graph.mini.vae.encode(picture.permute(0, 3, 1, 2) * 2 - 1).latents
    assert (latents - expected).abs().max() < PIXELS
    decoded = (graph.mini.vae.decode(expected).sample / 2 + 0.5).clamp(0, 1).permute(0, 2, 3, 1)
    assert (graph.vae.decode(latents) - decoded).abs().max() < PIXELS


def test_loader_without_weights_says_which_file(mini: Any, tmp_path: Any) -> None:
    library, errors = pack_module("dl_core.backends.mini"), pack_module("dl_core.errors")
    (tmp_path / "tokenizer").symlink_to(library.MINI_FOLDER / "tokenizer")
    (tmp_path / "mini.json").symlink_to(library.MINI_FOLDER / "mini.json")
    with pytest.raises(errors.ModelError, match=r"unet\.safetensors: no such model file"):
        library.load_mini(tmp_path)


def test_model_without_a_lora_is_left_as_it_is(mini: Any) -> None:
    assert pack_module("nodes.mini").to_model(replace(mini, lora=None), 0.75).patches == {}


def test_own_lora_is_loaded_at_its_scale(mini: Any) -> None:
    layer = "unet.down_blocks.2.attentions.0.transformer_blocks.0.attn1.to_q"
    weights = {f"{layer}.lora_A.weight": torch.ones(4, 128), f"{layer}.lora_B.weight": torch.ones(128, 4)}
    (patch,) = pack_module("nodes.mini").to_model(replace(mini, lora=weights), 0.75).patches.values()
    assert patch[0][0] == 0.75
