"""`bench full-size`: the trainer and the painter it measures are the real ones, at the mini model's size here."""

from __future__ import annotations

import json

import pytest
import torch

from dl_core.bench.full_size import SIZES, bench_full_size
from dl_core.cli import main
from dl_core.training.lora.memory import step_memory
from dl_core.training.lora.settings import LoraSettings


def test_training_and_painting_are_measured_beside_what_is_computed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "full-size", "--size", "mini", "--steps", "2", "--evaluations", "3", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["protocol"]["weights"] == "random"
    training, painting = report["rows"][:2], report["rows"][2:]
    assert [row["batch"] for row in painting] == [1, 4]
    assert all(row["seconds"] > 0 for row in report["rows"])
    settings = LoraSettings(precision="no", gradient_checkpointing=True)
    pipeline = SIZES["mini"].build(torch.device("cpu"), torch.float32)
    computed = step_memory(dict(pipeline.unet.config), settings, 256, 32).total / 1e9
    assert [row["computed_gb"] for row in training] == pytest.approx([computed, computed])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU to measure memory on")
def test_a_step_on_a_gpu_takes_what_was_computed() -> None:
    """The allocator's peak holds the optimizer's temporaries and kernels' workspaces beside the tensors counted."""
    further = bench_full_size(SIZES["sdxl"], torch.device("cuda"), steps=3, evaluations=2)[1]
    assert 0.9 * further["computed_gb"] < further["peak_gb"] < 24


@pytest.mark.parametrize("option", ["--steps", "--evaluations"])
def test_too_few_to_time_are_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "full-size", "--size", "mini", option, "1"]) == 2
    assert f"{option} is 1" in capsys.readouterr().err
