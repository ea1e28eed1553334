"""Training the exposure LoRA: what it sees, what it learns from, and that it can be stopped at any moment."""

from __future__ import annotations

import gc
import json
import math
import os
import resource
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import DDPMScheduler
from foreground import hear_ctrl_c
from lora_training import CANVAS, SETTINGS, Untrained, random_pairs
from safetensors.torch import load_file
from torch import Tensor

from dl_core.backends.mini import SCHEDULER_CONFIG
from dl_core.ball import place_ball
from dl_core.errors import ImageError, ModelError, OptionError, OutputError
from dl_core.exposure_prompts import embedding_at
from dl_core.training.lora import latent_cache
from dl_core.training.lora.batches import LoraBatches
from dl_core.training.lora.checkpoint import CHECKPOINT, read_checkpoint
from dl_core.training.lora.exposure_lora import TrainedLora, train_exposure_loras
from dl_core.training.lora.latent_cache import LatentCache, data_fingerprint, encode_pairs
from dl_core.training.lora.settings import SEPARATE_PROMPT, LoraSettings, parse_evs, parse_timesteps
from dl_core.training.lora.validation import Validation
from dl_core.training.mini.denoiser import weighted_error
from dl_core.training.tensor_files import write_tensors

ROOT = Path(__file__).parents[1]
SIDE = CANVAS // 8


def silent(line: str) -> None:
    pass


def train(work: Path, report: Callable[[str], None] = silent, **changed: Any) -> TrainedLora:
    (trained,) = train_exposure_loras(
        Untrained().base(), random_pairs(), replace(SETTINGS, **changed), work, report=report
    )
    return trained


def logged(work: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (work / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The work folder of a finished training."""
    work = tmp_path_factory.mktemp("finished")
    train(work)
    return work


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> LatentCache:
    return encode_pairs(
        random_pairs(), Untrained().base().encode, tmp_path_factory.mktemp("latents"), {}, report=silent
    )


def batches(cache: LatentCache, **changed: Any) -> LoraBatches:
    schedule = DDPMScheduler(**{**SCHEDULER_CONFIG, "prediction_type": "epsilon"})
    whole = LoraBatches(cache, torch.arange(cache.count), schedule, 3, (900, 999), 1)
    return replace(whole, **changed)


# --- what a step sees --------------------------------------------------------------------------------------------


def test_latents_are_the_encoders_own(cache: LatentCache) -> None:
    pairs, base = random_pairs(), Untrained().base()
    for order in ([0, 1, 2], [4, 2]):
        expected = torch.cat([base.encode(pairs[i].image) for i in order])
        assert torch.equal(cache.latents(torch.tensor(order)), expected)
    assert cache.balls(torch.tensor([3]))[0] == pairs[3].ball
    assert cache.evs.tolist() == [pair.ev for pair in pairs]


def test_the_loss_does_not_hear_of_latents_off_the_ball(cache: LatentCache) -> None:
    batch = batches(cache).batch(0)
    predicted = torch.randn(batch.target.shape, generator=torch.Generator().manual_seed(5), requires_grad=True)
    (gradient,) = torch.autograd.grad(weighted_error(predicted, batch.target, batch.ball), predicted)
    # The ball's disc has radius 13 around (27, 35): a latent is off it if the nearest point of its 8 pixels is.
    edges = torch.arange(SIDE) * 8.0
    across = (edges - 27).clamp(min=0) + (27 - edges - 8).clamp(min=0)
    down = (edges - 35).clamp(min=0) + (35 - edges - 8).clamp(min=0)
    off = torch.hypot(across[None, :], down[:, None]) >= 13
    assert 0 < off.sum() < off.numel()
    assert (gradient[..., off] == 0).all()
    # Pixels count by their centres; a latent that the disc merely grazes may have none of them.
    inside = torch.hypot(across[None, :] + 4, down[:, None] + 4) < 10
    assert inside.any()
    assert (gradient[..., inside] != 0).all()


def test_the_loss_is_the_mean_over_the_ball(cache: LatentCache) -> None:
    batch = batches(cache).batch(0)
    off = batch.target + 0.5
    torch.testing.assert_close(weighted_error(off, batch.target, batch.ball), torch.tensor(0.25))


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction"])
def test_noise_and_target_are_those_of_the_schedule(cache: LatentCache, kind: str) -> None:
    """With ᾱ of SDXL's betas in closed form: z_t = sqrt(ᾱ) z + sqrt(1 - ᾱ) ε, v = sqrt(ᾱ) ε - sqrt(1 - ᾱ) z."""
    schedule = DDPMScheduler(**{**SCHEDULER_CONFIG, "prediction_type": kind})
    drawn = batches(cache, schedule=schedule, size=5)
    batch = drawn.batch(7)
    clean = cache.latents(drawn._places(7))
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    kept = torch.cumprod(1 - betas, 0)[batch.timesteps].view(-1, 1, 1, 1).float()
    noise = (batch.noisy - kept.sqrt() * clean) / (1 - kept).sqrt()
    expected = noise if kind == "epsilon" else kept.sqrt() * noise - (1 - kept).sqrt() * clean
    torch.testing.assert_close(batch.target, expected, atol=1e-5, rtol=1e-4)
    assert 0.8 < float(noise.std()) < 1.2


def test_batches_follow_from_seed_and_number(cache: LatentCache) -> None:
    first, again, other, later = (
        made.batch(number)
        for made, number in (
            (batches(cache), 4),
            (batches(cache), 4),
            (batches(cache, seed=2), 4),
            (batches(cache), 5),
        )
    )
    assert torch.equal(first.noisy, again.noisy)
    assert torch.equal(first.timesteps, again.timesteps)
    assert not torch.equal(first.noisy, other.noisy)
    assert not torch.equal(first.noisy, later.noisy)


def test_every_pair_is_shown_once_before_any_is_shown_again(cache: LatentCache) -> None:
    drawn = batches(cache)
    shown = torch.cat([drawn.batch(number).evs for number in range(5)])  # 15 of 5 pairs
    for epoch in shown.split(cache.count):
        assert sorted(epoch.tolist()) == sorted(cache.evs.tolist())


def test_timesteps_are_uniform_over_the_range_and_reach_both_ends(cache: LatentCache) -> None:
    drawn = batches(cache, timesteps=(990, 993), size=5)
    levels = torch.cat([drawn.batch(number).timesteps for number in range(160)])
    counts = torch.bincount(levels - 990, minlength=4)
    assert len(counts) == 4
    # 800 draws: 200 each, standard deviation sqrt(800 / 4 * 3 / 4) = 12.
    assert ((counts - 200).abs() < 5 * 12).all()


def test_a_model_that_starts_from_noise_sees_a_fainter_ball_and_the_same_photograph(cache: LatentCache) -> None:
    """And what it is to predict leads to the whole ball from there."""
    clean = cache.latents(torch.arange(cache.count))
    for levels in ((820, 999), (300, 800)):
        carried, full = (batches(cache, from_noise=f, timesteps=levels, size=5).batch(0) for f in (True, False))
        differs = (carried.noisy - full.noisy).abs().amax(dim=1, keepdim=True) > 0
        assert not differs[cache.discs(torch.tensor([0]), SIDE, dilated=True).expand_as(differs) == 0].any()
        if levels[0] == 820:
            assert differs[carried.ball == 1].all()
        kept = DDPMScheduler(**SCHEDULER_CONFIG).alphas_cumprod[carried.timesteps].view(-1, 1, 1, 1)
        for batch in (carried, full):
            found = (batch.noisy - (1 - kept).sqrt() * batch.target) / kept.sqrt()
            order = [int((clean - one).abs().amax(dim=(1, 2, 3)).argmin()) for one in found]
            torch.testing.assert_close(found, clean[order], rtol=0, atol=1e-3)


def test_prompts_at_an_exposure() -> None:
    generator = torch.Generator().manual_seed(1)
    original, dark = torch.randn(2, 1, 7, 3, generator=generator)
    found = embedding_at(original, dark, torch.tensor([0.0, -5.0, -2.5]), -5.0)
    assert torch.equal(found[0], original[0])
    assert torch.equal(found[1], dark[0])
    torch.testing.assert_close(found[2], (original[0] + dark[0]) / 2)


def test_pairs_are_encoded_once_and_an_encoding_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latent_cache, "CHUNK", 2)
    pairs, asked = random_pairs(5), list[int]()

    class Reads:
        def __init__(self, until: int) -> None:
            self.until = until

        def __len__(self) -> int:
            return len(pairs)

        def __getitem__(self, index: int, /) -> Any:
            if index >= self.until:
                raise ImageError("pair", "is not there")
            asked.append(index)
            return pairs[index]

    def encode(image: Tensor) -> Tensor:
        return image[:, ::8, ::8].permute(0, 3, 1, 2)

    with pytest.raises(ImageError):
        encode_pairs(Reads(3), encode, tmp_path, {"data": "a"}, report=silent)
    asked.clear()
    cache = encode_pairs(Reads(9), encode, tmp_path, {"data": "a"}, report=silent)
    assert asked == [2, 3, 4]
    assert torch.equal(cache.latents(torch.tensor([4, 0])), encode(torch.cat([pairs[4].image, pairs[0].image])))
    asked.clear()
    encode_pairs(Reads(9), encode, tmp_path, {"data": "b"}, report=silent)
    assert asked == [0, 1, 2, 3, 4]


def test_pairs_of_several_sizes_are_refused(tmp_path: Path) -> None:
    small = random_pairs(2)
    mixed = [small[0], replace(small[1], ball=place_ball(128, 32))]
    with pytest.raises(ImageError, match=r"several sizes \(\[64, 128\] pixels"):
        encode_pairs(mixed, lambda image: torch.zeros(1, 4, 8, 8), tmp_path, {}, report=silent)


def test_fingerprints_tell_data_and_models_apart() -> None:
    assert data_fingerprint(random_pairs()) == data_fingerprint(random_pairs())
    assert len({data_fingerprint(p) for p in (random_pairs(), random_pairs(4), random_pairs(5, seed=4))}) == 3
    assert Untrained().base().fingerprint() == Untrained().base().fingerprint()
    assert Untrained(0).base().fingerprint() != Untrained(1).base().fingerprint()


# --- what comes of it --------------------------------------------------------------------------------------------


def test_the_lora_learns_the_balls_it_is_shown(tmp_path: Path) -> None:
    """Shown two pairs a hundred times at one noise level, its error on them falls well below the base's."""
    (trained,) = train_exposure_loras(
        Untrained().base(),
        random_pairs(2),
        replace(SETTINGS, steps=100, rank=8, timesteps=(999, 999)),
        tmp_path,
        report=silent,
    )
    losses = [line["loss"] for line in logged(tmp_path)]
    assert len(losses) == 100
    assert sum(losses[-10:]) < 0.9 * sum(losses[:10])
    assert all(math.isfinite(float(weight.abs().max())) for weight in trained.weights.values())


def test_only_the_lora_is_trained_and_encoders_are_let_go(tmp_path: Path) -> None:
    base = Untrained().base()
    before = {name: weight.clone() for name, weight in base.pipeline.unet.state_dict().items()}
    gone = [weakref.ref(getattr(base.pipeline, name)) for name in ("text_encoder", "text_encoder_2", "vae")]
    (trained,) = train_exposure_loras(base, random_pairs(), replace(SETTINGS, steps=1), tmp_path, report=silent)
    gc.collect()
    assert [reference() for reference in gone] == [None, None, None]
    after = base.pipeline.unet.state_dict()
    assert after.keys() == before.keys()  # the adapter is taken off again
    assert all(torch.equal(after[name], before[name]) for name in before)
    ups = [weight for name, weight in trained.weights.items() if name.endswith("lora_up.weight")]
    assert all(weight.abs().max() > 0 for weight in ups)
    assert {weight.shape[1] for weight in ups} == {SETTINGS.rank}


def test_a_lora_for_one_exposure_learns_from_pairs_of_that_exposure(tmp_path: Path) -> None:
    pairs = random_pairs(5)  # 0, -1.25, -2.5, -3.75, -5
    changed = [replace(pair, image=1 - pair.image) if pair.ev != -2.5 else pair for pair in pairs]
    loras = {}
    for name, data in (("as it is", pairs), ("others changed", changed)):
        loras[name] = train_exposure_loras(
            Untrained().base(), data, SETTINGS, tmp_path / name, separate=(-2.5, 0.0), report=silent
        )
    (middle, bright), (middle_again, bright_again) = loras.values()
    assert (middle.ev, bright.ev) == (-2.5, 0.0)
    assert middle.metadata["prompt"] == middle.metadata["dark_prompt"] == SEPARATE_PROMPT
    assert middle.metadata["ev"] == "-2.5"
    assert same(middle, middle_again)
    assert not same(bright, bright_again)


def same(one: TrainedLora, other: TrainedLora) -> bool:
    assert one.weights.keys() == other.weights.keys()
    return all(torch.equal(one.weights[name], other.weights[name]) for name in one.weights)


def test_exposures_without_pairs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"--separate is -7.*these pairs span -5 to 0"):
        train_exposure_loras(Untrained().base(), random_pairs(), SETTINGS, tmp_path, separate=(-7.0,), report=silent)
    with pytest.raises(OptionError, match=r"--ev-min is -4.*-5 or below"):
        train(tmp_path, ev_min=-4.0)


def test_gradient_checkpointing_changes_nothing_of_the_result(tmp_path: Path, finished: Path) -> None:
    plain = train(finished)
    checkpointed = train(tmp_path, gradient_checkpointing=True)
    for name, weight in plain.weights.items():
        # The same sums in the same order but for what a recomputation may reorder; Adam divides by small moments.
        torch.testing.assert_close(checkpointed.weights[name], weight, atol=1e-4, rtol=1e-3)


# --- stopping and going on ---------------------------------------------------------------------------------------

SCRIPT = """
import sys
from dataclasses import replace
from pathlib import Path
import torch
sys.path.insert(0, {tests!r})
from foreground import hear_ctrl_c
from lora_training import SETTINGS, Untrained, random_pairs
from dl_core.training.lora.exposure_lora import train_exposure_loras
from dl_core.training.tensor_files import write_tensors

work, steps, accumulation, minutes = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
settings = replace(SETTINGS, steps=steps, accumulation=accumulation, checkpoint_minutes=minutes)
(lora,) = train_exposure_loras(Untrained().base(), random_pairs(), settings, work, report=print)
write_tensors(work / "lora.safetensors", lora.weights, lora.metadata)
"""


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("script") / "script.py"
    path.write_text(SCRIPT.format(tests=str(ROOT / "tests")))
    return path


@pytest.fixture
def one_thread() -> Iterator[None]:
    """As the script's processes have it: more threads would add up the same numbers in another order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def started(script: Path, work: Path, steps: int) -> subprocess.Popen[str]:
    command = [sys.executable, str(script), str(work), str(steps), "1", "0"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=environment(), preexec_fn=hear_ctrl_c, text=True, **pipes)


def wait_for_step(process: subprocess.Popen[str], work: Path, step: int) -> None:
    log, until = work / "log.jsonl", time.monotonic() + 120
    while not (log.is_file() and f'"step": {step}' in log.read_text()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.01)


def test_killed_and_interrupted_and_resumed_it_gives_the_same_lora_bit_for_bit(
    script: Path, tmp_path: Path, one_thread: None
) -> None:
    steps, parts, said = 40, tmp_path / "parts", list[str]()
    process = started(script, parts, steps)
    wait_for_step(process, parts, 5)
    process.kill()
    process.communicate()
    killed = read_checkpoint(parts)
    assert killed is not None
    assert 4 <= killed.step < steps
    process = started(script, parts, steps)
    wait_for_step(process, parts, killed.step + 5)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    stopped = read_checkpoint(parts)
    assert stopped is not None
    assert killed.step < stopped.step < steps
    assert f"going on from step {killed.step}" in out
    assert f"training stopped at step {stopped.step}" in err
    resumed = train(parts, said.append, steps=steps)
    assert said[0] == f"going on from step {stopped.step}"
    assert same(resumed, train(tmp_path / "whole", steps=steps))


def test_two_processes_train_as_one_that_accumulates_two_batches(
    script: Path, tmp_path: Path, one_thread: None
) -> None:
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*torchrun, str(script), str(tmp_path / "two"), "4", "1", "10"]
    subprocess.run(command, check=True, env=environment(), capture_output=True)
    one = train(tmp_path / "one", steps=4, accumulation=2).weights
    two = load_file(tmp_path / "two" / "lora.safetensors")
    assert two.keys() == one.keys()
    # Gradients are summed in another order. Adam divides them by their size, so a matrix whose gradient is next to
    # nothing may come out as another one; the others, which are most, must not. Those that start at 0 tell best.
    ups = [key for key in one if key.endswith("lora_up.weight")]
    apart = sorted(float((two[key] - one[key]).norm() / one[key].norm()) for key in ups)
    assert apart[len(apart) * 3 // 4] < 0.01
    shared, alone = logged(tmp_path / "two"), logged(tmp_path / "one")
    assert [line["step"] for line in shared] == [1, 2, 3, 4]  # the second process stays silent
    assert [line["loss"] for line in shared] == pytest.approx([line["loss"] for line in alone], rel=1e-3)


def test_a_full_disk_costs_the_new_checkpoint_and_not_the_old_one(tmp_path: Path) -> None:
    train(tmp_path, steps=2)
    before = (tmp_path / CHECKPOINT).read_bytes()
    said: list[str] = []
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        trained = train(tmp_path, said.append, steps=4)
        with pytest.raises(OutputError):
            write_tensors(tmp_path / "lora.safetensors", {"x": torch.zeros(len(before))}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert any("checkpoint of step 4 was not written" in line and "step 2 is kept" in line for line in said)
    assert (tmp_path / CHECKPOINT).read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} <= {CHECKPOINT, "latents", "log.jsonl", "tensorboard"}
    assert same(trained, train(tmp_path, steps=4))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"rank": 3}, r"--rank is '3'.*--rank 2"),
        ({"timesteps": (800, 999)}, r"--timesteps is '800-999'.*--timesteps 900-999"),
        ({"ev_min": -6.0}, r"--ev-min is '-6.0'"),
        ({"seed": 9, "batch": 4}, r"--batch is '4'.*--batch 2, --seed 1 \(and --seed differ as well\)"),
        ({"schedule": "cosine"}, "--schedule is 'cosine'"),
    ],
)
def test_a_checkpoint_of_other_settings_is_refused(finished: Path, changed: dict[str, Any], named: str) -> None:
    with pytest.raises(OptionError, match=named):
        train(finished, **changed)


def test_a_checkpoint_of_another_model_or_of_other_data_is_refused(finished: Path) -> None:
    latents = (finished / "latents").stat().st_mtime_ns
    with pytest.raises(OptionError, match="the base model is"):
        train_exposure_loras(Untrained(1).base(), random_pairs(), SETTINGS, finished, report=silent)
    with pytest.raises(OptionError, match="the data is"):
        train_exposure_loras(Untrained().base(), random_pairs(4), SETTINGS, finished, report=silent)
    assert (finished / "latents").stat().st_mtime_ns == latents


def test_more_steps_may_be_asked_for(tmp_path: Path) -> None:
    train(tmp_path, steps=3)
    said: list[str] = []
    assert same(train(tmp_path, said.append, steps=5), train(tmp_path / "at once", steps=5))
    assert said[0] == "going on from step 3"


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT).write_bytes(b"not a checkpoint")
    with pytest.raises(ModelError, match=r"checkpoint\.pt: is no whole checkpoint"):
        train(tmp_path)


# --- what is left to look at -------------------------------------------------------------------------------------


def test_pictures_of_validation_show_a_ball_an_exposure(tmp_path: Path) -> None:
    from PIL import Image as PILImage

    with_pictures = train(tmp_path, validate_every=2, steps=3)
    sheets = sorted((tmp_path / "pictures").iterdir())
    assert [sheet.name for sheet in sheets] == ["step-000002.png", "step-000003.png"]
    diameter = CANVAS // 2  # as large on the canvas as the mini model has it
    with PILImage.open(sheets[0]) as sheet:
        assert sheet.size == (3 * diameter, diameter)
        thirds = torch.tensor(list(sheet.convert("L").tobytes())).view(diameter, 3, diameter)
    assert not torch.equal(thirds[:, 0], thirds[:, 2])
    assert same(with_pictures, train(tmp_path / "without", steps=3))  # painting leaves no trace in training


def test_validation_paints_without_a_controlnet_too() -> None:
    from peft import LoraConfig

    from dl_core.backends.diffusers_painter import DiffusersPainter

    base = Untrained().base()
    base.pipeline.register_modules(controlnet=None)
    base.pipeline.unet.add_adapter(LoraConfig(r=2, target_modules=["to_q"]), adapter_name="exposure")
    sheet = Validation.of(DiffusersPainter(base.pipeline, base.defaults), CANVAS, (0.0,)).sheet()
    assert sheet.shape == (1, 32, 32, 3)
    assert torch.isfinite(sheet).all()


def test_tensorboard_shows_loss_rate_seconds_and_pictures(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="NO TENSORBOARD: the extra train is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(tmp_path, steps=2)
    train(tmp_path, steps=4, validate_every=4)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert set(events.Tags()["scalars"]) == {"train/loss", "train/learning rate", "train/seconds"}
    assert [event.step for event in events.Scalars("train/loss")] == [1, 2, 3, 4]
    assert events.Tags()["images"] == ["balls at EV 0, -2.5, -5"]


# --- settings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"rank": 0}, "--rank"),
        ({"steps": 0}, "--steps"),
        ({"accumulation": 0}, "--gradient-accumulation"),
        ({"learning_rate": math.nan}, "--learning-rate"),
        ({"ev_min": 0.0}, "--ev-min"),
        ({"timesteps": (999, 900)}, "--timesteps"),
        ({"timesteps": (0, 1000)}, "--timesteps"),
        ({"precision": "fp8"}, "--mixed-precision"),
        ({"checkpoint_minutes": -1.0}, "--checkpoint-minutes"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changed: dict[str, Any], named: str) -> None:
    with pytest.raises(OptionError) as raised:
        replace(SETTINGS, **changed)
    assert raised.value.name == named


def test_ranges_and_exposures_are_read() -> None:
    assert parse_timesteps("900-999") == (900, 999)
    assert parse_evs("0,-2.5,-5") == (0.0, -2.5, -5.0)
    for wrong in ("900", "a-b", "-1-5", "900:999"):
        with pytest.raises(OptionError, match="--timesteps"):
            parse_timesteps(wrong)
    for wrong in ("", "1", "0,0", "0,x", "nan"):
        with pytest.raises(OptionError, match="--separate"):
            parse_evs(wrong)


def test_rates() -> None:
    assert LoraSettings().rate(0) == LoraSettings().rate(2499) == 1e-5
    cosine = LoraSettings(schedule="cosine", learning_rate=1.0, steps=1050)
    assert cosine.rate(49) == 1.0
    assert cosine.rate(550) == pytest.approx(0.5)
    assert cosine.rate(1049) < 1e-5
