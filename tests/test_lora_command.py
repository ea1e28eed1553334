"""`lightprobe train lora`: from shards to a file, what it refuses, and the memory it says a step takes."""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tarfile
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from diffusers import StableDiffusionXLPipeline, UNet2DConditionModel
from lora_training import random_pairs
from PIL import Image as PILImage
from safetensors import safe_open

from dl_core.backends.mini import UNET_CONFIG, load_mini, read_weights
from dl_core.backends.sdxl_files import SDXL_FOLDER
from dl_core.cli import main
from dl_core.lora import read_lora
from dl_core.training.data.pairs import FORMAT, INDEX, pair_key
from dl_core.training.lora.base import LoraBase
from dl_core.training.lora.command import add_arguments
from dl_core.training.lora.exposure_lora import add_exposure_adapter
from dl_core.training.lora.memory import step_memory
from dl_core.training.lora.run import settings_of
from dl_core.training.lora.settings import LORA_SETTINGS, LoraSettings

ROOT = Path(__file__).parents[1]


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    """A folder as `lightprobe train data` leaves it."""
    folder = tmp_path / "pairs"
    folder.mkdir()
    pairs = random_pairs(3)
    with tarfile.open(folder / "a.tar", "w") as tar:
        for number, pair in enumerate(pairs):
            picture = io.BytesIO()
            codes = (pair.image[0] * 255).round().to(torch.uint8).numpy()
            PILImage.fromarray(codes).save(picture, format="PNG")
            record = json.dumps({"ball": asdict(pair.ball), "ev": pair.ev, "panorama": pair.panorama}).encode()
            for kind, content in (("image.png", picture.getvalue()), ("json", record)):
                member = tarfile.TarInfo(f"{pair_key(number)}.{kind}")
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
    size = (folder / "a.tar").stat().st_size
    shard = {"file": "a.tar", "split": "training", "bytes": size, "pairs": len(pairs)}
    (folder / INDEX).write_text(json.dumps({"format": FORMAT, "shards": [shard]}))
    return folder


def command(shards: Path, *more: str) -> list[str]:
    work, out = shards.parent / "work", shards.parent / "lora.safetensors"
    return [
        *("train", "lora", "--model", "mini", "--data", str(shards), "--work", str(work), "--out", str(out)),
        *("--steps", "2", "--batch", "1", *more),
    ]


def test_from_shards_to_a_file(shards: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command(shards)) == 0
    out = shards.parent / "lora.safetensors"
    assert f"wrote {out}" in capsys.readouterr().out
    with safe_open(out, framework="pt") as file:
        said = file.metadata()
    expected = {"rank": "4", "steps": "2", "batch": "1", "timesteps": "0-999", "ev_min": "-5", "pairs": "3"}
    assert {name: said[name] for name in expected} == expected
    unet = load_mini().unet
    layers = {name.removesuffix(".weight"): tuple(weight.shape) for name, weight in unet.named_parameters()}
    shapes = {name: shape for name, shape in layers.items() if len(shape) > 1}
    assert len(read_lora(read_weights(out), shapes, out)) == sum(".to_" in name for name in shapes)
    # The same command goes on from a finished training; another rank is refused, naming the option.
    assert main(command(shards)) == 0
    assert main(command(shards, "--rank", "8")) == 2
    assert "--rank is '8'" in capsys.readouterr().err


def test_a_folder_in_diffusers_layout_in_half_precision(shards: Path) -> None:
    """In a process of its own: accelerate keeps a process to one precision."""
    parts = LoraBase.from_mini(load_mini()).pipeline.components
    names = ("vae", "text_encoder", "text_encoder_2", "tokenizer", "tokenizer_2", "unet", "scheduler")
    folder = shards.parent / "model"
    StableDiffusionXLPipeline(**{name: parts[name] for name in names}).save_pretrained(folder)
    arguments = command(shards, "--mixed-precision", "bf16", "--validate-every", "1", "--steps", "1")
    arguments[arguments.index("mini")] = str(folder)
    script = "import sys; from dl_core.cli import main; sys.exit(main(sys.argv[1:]))"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", script, *arguments], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    weights = read_weights(shards.parent / "lora.safetensors")
    assert all(torch.isfinite(weight).all() for weight in weights.values())
    assert any(weight.abs().max() > 0 for name, weight in weights.items() if name.endswith("lora_up.weight"))
    assert (shards.parent / "work" / "pictures" / "step-000001.png").is_file()


def test_a_lora_an_exposure(shards: Path) -> None:
    assert main(command(shards, "--separate", "0,-2.5")) == 0
    names = sorted(path.name for path in shards.parent.glob("*.safetensors"))
    assert names == ["lora.ev-2.5.safetensors", "lora.ev0.safetensors"]


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (("--timesteps", "999"), "--timesteps"),
        (("--mixed-precision", "fp16"), "--mixed-precision"),
        (("--controlnet", "x"), "--controlnet"),
        (("--separate", "a"), "--separate"),
        (("--out", "lora.pt"), "--out"),
    ],
)
def test_options_that_make_no_sense_are_named(
    shards: Path, more: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if more[0] == "--mixed-precision" and torch.cuda.is_available():
        pytest.skip("a GPU computes in half precision")
    assert main(command(shards, *more)) == 2
    assert named in capsys.readouterr().err


def test_what_is_missing_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "lora", "--model", "mini"]) == 2
    assert "--data is None" in capsys.readouterr().err


def test_defaults_are_the_papers_for_sdxl_and_the_minis_for_mini() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    sdxl, mini = (settings_of(parser.parse_args(["--model", name])) for name in ("sdxl.safetensors", "mini"))
    assert mini == LORA_SETTINGS["mini"]
    assert (sdxl.rank, sdxl.steps, sdxl.batch, sdxl.learning_rate) == (4, 2500, 4, 1e-5)
    assert (sdxl.timesteps, sdxl.ev_min, sdxl.schedule) == ((900, 999), -5.0, "constant")


# --- memory ------------------------------------------------------------------------------------------------------


def sdxl_config() -> dict[str, object]:
    config: dict[str, object] = json.loads((SDXL_FOLDER / "unet" / "config.json").read_text())
    return config


def test_sdxls_weights_and_lora_are_counted() -> None:
    """SDXL's UNet has 2,567,463,684 parameters; a LoRA has rank x (inputs + outputs) a layer."""
    settings = replace(LoraSettings(), precision="fp16", gradient_checkpointing=True, batch=1)
    memory = step_memory(sdxl_config(), settings, 512)
    assert memory.weights == 2 * 2_567_463_684
    with torch.device("meta"):
        unet = UNet2DConditionModel.from_config(sdxl_config())
    ends = (".to_q.weight", ".to_k.weight", ".to_v.weight", ".to_out.0.weight")
    lora = sum(4 * sum(weight.shape) for name, weight in unet.named_parameters() if name.endswith(ends))
    assert memory.lora == memory.gradients == 4 * lora
    assert memory.optimizer == 8 * lora
    assert memory.total < 24e9


def test_activations_counted_without_storage_are_those_of_a_real_step() -> None:
    """In single precision, where no casts come in; the CPU's attention keeps what fused attention does."""
    settings = replace(LoraSettings(), batch=2)
    computed = step_memory(UNET_CONFIG, settings, 64, text_width=32).activations
    unet = UNet2DConditionModel(**UNET_CONFIG)
    add_exposure_adapter(unet, settings)
    weights = {parameter.untyped_storage().data_ptr() for parameter in unet.parameters()}
    kept: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in weights:
            kept[storage.data_ptr()] = storage
        return tensor

    added = {"text_embeds": torch.zeros(2, 32), "time_ids": torch.zeros(2, 6)}
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        unet(torch.zeros(2, 4, 8, 8), torch.zeros(2), torch.zeros(2, 77, 64), added_cond_kwargs=added)
    measured = sum(storage.nbytes() for storage in kept.values())
    assert computed == pytest.approx(measured, rel=0.03)


def test_activations_grow_with_the_batch_and_checkpointing_saves_most_of_them() -> None:
    sizes = [step_memory(UNET_CONFIG, replace(LoraSettings(), batch=n), 64, text_width=32).activations for n in (2, 4)]
    assert sizes[1] == pytest.approx(2 * sizes[0], rel=0.05)
    checkpointed = step_memory(
        UNET_CONFIG, replace(LoraSettings(), batch=4, gradient_checkpointing=True), 64, text_width=32
    )
    assert 0 < checkpointed.recomputed < checkpointed.activations + checkpointed.recomputed < sizes[1]


def test_memory_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "lora", "--model", "mini", "--memory"]) == 0
    out = capsys.readouterr().out
    assert "computed, not measured" in out
    assert "activations" in out
