"""Training: the closed-form autoencoder, reproducible pictures, a loop that resumes where it stood."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from diffusers import AutoencoderTiny, DDIMScheduler, DDPMScheduler
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close
from torch import Tensor, nn

from dl_core.backends.diffusers_painter import SAMPLERS, DiffusersPainter
from dl_core.backends.mini import LORA_FILE, MINI_FOLDER, NETWORK_FILES, SCHEDULER_CONFIG, MiniModel, load_mini
from dl_core.ball import disc_mask
from dl_core.errors import OptionError
from dl_core.exposure import decode_display
from dl_core.geometry import latlong_energy
from dl_core.imageio import write_exr
from dl_core.training.mini.autoencoder import block_latents, write_closed_form_encoder, write_thumbnail_decoder
from dl_core.training.mini.control import train_control
from dl_core.training.mini.decoder import train_decoder
from dl_core.training.mini.denoiser import OFF_BALL_WEIGHT, draw_batch
from dl_core.training.mini.drawn_pairs import DrawnPairs
from dl_core.training.mini.export import write_networks
from dl_core.training.mini.feed import Ahead, Feed
from dl_core.training.mini.loop import Budget, train
from dl_core.training.mini.scene_sampler import SceneSampler
from dl_core.training.mini.stages import run_stage
from dl_core.training.panoramas import draw_scenes, load_panoramas, panorama_files, reduce_panorama
from dl_core.training.scenes.procedural import draw_panorama
from dl_core.training.starts import FIRST_START, SDEDIT_BELOW, SDEDIT_SHARE, carried_noise, draw_starts

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def panoramas() -> Tensor:
    return torch.cat([draw_panorama(seed, 32) for seed in range(4)])


@pytest.fixture(scope="module")
def vae() -> AutoencoderTiny:
    torch.manual_seed(0)
    vae = AutoencoderTiny(scaling_factor=1.0).eval()
    write_closed_form_encoder(vae)
    write_thumbnail_decoder(vae)
    return vae


def _pictures() -> Tensor:
    """Noise, flat colours, and a small light in the dark."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand(1, 64, 64, 3, generator=generator)
    flat = torch.rand(1, 1, 1, 3, generator=generator).expand(1, 64, 64, 3)
    spot = torch.zeros(1, 64, 64, 3)
    spot[:, 20:22, 40:43] = 1
    return torch.cat((noise, noise**4, flat, spot))


def test_the_encoder_computes_the_latents_of_the_definition(vae: AutoencoderTiny) -> None:
    pictures = _pictures()
    with torch.no_grad():
        encoded = vae.encode(pictures.permute(0, 3, 1, 2) * 2 - 1).latents
    # Ten layers of fp32 sums of values up to 40: a few hundred units in the last place.
    torch.testing.assert_close(encoded, block_latents(pictures), atol=5e-5, rtol=0)


def test_a_block_rendered_smaller_has_the_same_latent() -> None:
    pictures = _pictures()
    enlarged = pictures.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2)
    torch.testing.assert_close(block_latents(enlarged, 8), block_latents(pictures, 4))


def test_unevenness_is_nothing_on_flat_blocks_and_grows_with_a_light() -> None:
    latents = block_latents(_pictures())
    assert latents[2, 3].std() < 1e-4
    assert latents[3, 3].argmax() == (20 // 8) * 8 + 40 // 8


def test_the_untrained_decoder_paints_the_blocks_mean_colours(vae: AutoencoderTiny) -> None:
    flat = torch.rand(1, 1, 1, 3, generator=torch.Generator().manual_seed(5)) * 0.4 + 0.3
    latents = block_latents(flat.expand(1, 64, 64, 3).contiguous())
    with torch.no_grad():
        painted = vae.decode(latents).sample / 2 + 0.5
    inner = painted[:, :, 16:-16, 16:-16]
    # tanh(z / 3) * 3 inside the decoder bends latents of order 1 by a few percent; the rest is random weights x 0.05.
    assert (inner.mean(dim=(2, 3)) - flat[:, 0, 0]).abs().max() < 0.06


def test_pictures_follow_from_seed_and_index(panoramas: Tensor) -> None:
    first, again = (SceneSampler(panoramas, 64, 32, seed=7).draw(11) for _ in range(2))
    other = SceneSampler(panoramas, 64, 32, seed=8).draw(11)
    assert torch.equal(first.canvas_ldr, again.canvas_ldr)
    assert first.ball == again.ball
    assert not torch.equal(first.canvas_ldr, other.canvas_ldr)


def test_pictures_are_display_encoded_and_the_bracket_spans_its_evs(panoramas: Tensor) -> None:
    sampler = SceneSampler(panoramas, 64, 32, seed=1, bracket=True)
    pictures = [sampler.draw(index) for index in range(40)]
    values = torch.cat([picture.canvas_ldr for picture in pictures])
    assert values.min() >= 0
    assert values.max() <= 1
    evs = sorted(picture.ev for picture in pictures)
    assert -5 <= evs[0] < -3.5
    assert -1.5 < evs[-1] <= 0


def test_a_darker_picture_shows_the_same_light_less_bright(panoramas: Tensor) -> None:
    """Where neither clips, decoded values at two EVs differ by the factor 2^ΔEV."""
    sampler = SceneSampler(panoramas, 64, 32, seed=2, bracket=True)
    picture = sampler.draw(3)
    sampler._bracket_kind = lambda generator: (  # type: ignore[method-assign]
        "mirror",
        SceneSampler._bracket_kind(sampler, generator)[1] - 1,
        0,
    )
    darker = sampler.draw(3)
    bright, dark = decode_display(picture.canvas_ldr), decode_display(darker.canvas_ldr)
    ball = slice(24, 40)
    unclipped = (picture.canvas_ldr < 1)[:, ball, ball]
    torch.testing.assert_close(
        dark[:, ball, ball][unclipped], bright[:, ball, ball][unclipped] / 2, atol=1e-5, rtol=1e-3
    )


def test_a_batch_mixes_signal_and_noise_as_its_timesteps_say(panoramas: Tensor) -> None:
    batch = draw_batch(SceneSampler(panoramas, 64, 32, seed=1), 5, Feed(6), full_canvas=128)
    again = draw_batch(SceneSampler(panoramas, 64, 32, seed=1), 5, Feed(6), full_canvas=128)
    assert torch.equal(batch.noisy, again.noisy)
    assert batch.noisy.shape == (6, 4, 16, 16)
    assert batch.balls[0].canvas == 128
    assert batch.weights.min() == pytest.approx(OFF_BALL_WEIGHT)
    assert batch.weights.max() == pytest.approx(1.0)


def test_a_picture_shown_at_several_levels_of_noise_is_drawn_once(panoramas: Tensor) -> None:
    sampler = SceneSampler(panoramas, 64, 32, seed=1)
    often, once = (draw_batch(sampler, 5, Feed(size, noises), full_canvas=128) for size, noises in ((6, 3), (2, 1)))
    assert often.balls == tuple(ball for ball in once.balls for _ in range(3))
    assert torch.equal(often.captions, once.captions.repeat_interleave(3))
    assert len(often.timesteps.unique()) == 6
    schedule = DDPMScheduler(**SCHEDULER_CONFIG)
    kept = schedule.alphas_cumprod[often.timesteps].view(-1, 1, 1, 1)
    # z = sqrt(ᾱ) z_t - sqrt(1 - ᾱ) v, whatever the noise was.
    clean = kept.sqrt() * often.noisy - (1 - kept).sqrt() * often.target
    torch.testing.assert_close(clean, clean[::3].repeat_interleave(3, dim=0), atol=1e-5, rtol=0)


@pytest.mark.parametrize("start", [0, 4])
def test_batches_drawn_ahead_are_those_drawn_in_turn(panoramas: Tensor, start: int) -> None:
    sampler = SceneSampler(panoramas, 64, 32, seed=1)
    ahead, in_turn = (Ahead(lambda step: draw_batch(sampler, step, Feed(4, 2), full_canvas=128), n) for n in (2, 0))
    for step in (*range(start, start + 5), start):  # the last as after a restart
        assert torch.equal(ahead(step).noisy, in_turn(step).noisy)


@pytest.mark.parametrize(
    ("feed", "named"), [((0,), "batch"), ((4, 3), "noises"), ((4, 0), "noises"), ((4, 2, -1), "loaders")]
)
def test_feeds_that_make_no_sense_are_refused(feed: tuple[int, ...], named: str) -> None:
    with pytest.raises(OptionError, match=named):
        Feed(*feed)


@pytest.mark.parametrize("steps", [6, 10, 30])
def test_training_sees_what_diffusers_sampler_meets_on_its_way_from_noise(steps: int) -> None:
    """DDIM with a denoiser that always knows the ball, started from noise alone."""
    scheduler = SAMPLERS["ddim"](DDIMScheduler(**SCHEDULER_CONFIG, timestep_spacing="leading", steps_offset=1).config)
    scheduler.set_timesteps(steps)
    generator = torch.Generator().manual_seed(steps)
    ball, latents = torch.randn(2, 1, 4, 8, 8, generator=generator)
    start, kept = int(scheduler.timesteps[0]), scheduler.alphas_cumprod
    assert start >= FIRST_START
    noise, everywhere = latents / (1 - kept[start]).sqrt(), torch.ones(1, 1, 8, 8)
    carried = carried_noise(noise, ball, everywhere, torch.tensor([start]), kept)
    for timestep in scheduler.timesteps:
        expected = scheduler.add_noise(ball, carried, timestep[None])
        torch.testing.assert_close(latents, expected, rtol=0, atol=2e-5)
        velocity = (kept[timestep].sqrt() * latents - ball) / (1 - kept[timestep]).sqrt()
        torch.testing.assert_close(velocity, scheduler_velocity(ball, carried, timestep), rtol=0, atol=2e-4)
        latents = scheduler.step(velocity, timestep, latents).prev_sample
    torch.testing.assert_close(latents, ball, rtol=0, atol=0.2)


def scheduler_velocity(ball: Tensor, noise: Tensor, timestep: Tensor) -> Tensor:
    return DDPMScheduler(**SCHEDULER_CONFIG).get_velocity(ball, noise, timestep[None])


def test_starts_lie_at_or_above_a_picture_and_sdedit_below_its_strength() -> None:
    levels = torch.arange(1000)
    starts = draw_starts(levels, torch.Generator().manual_seed(3))
    sdedit = starts == -1
    assert (starts[~sdedit] >= torch.maximum(levels[~sdedit], torch.tensor(FIRST_START))).all()
    assert not sdedit[SDEDIT_BELOW:].any()
    assert sdedit[:SDEDIT_BELOW].float().mean() == pytest.approx(SDEDIT_SHARE, abs=0.06)
    assert (starts[990:] >= levels[990:]).all()


def test_where_a_sampler_starts_a_ball_is_noise_alone_and_the_photograph_is_not(
    panoramas: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The same draws in two worlds: what differs between the batches comes from the pictures.
    monkeypatch.setattr("dl_core.training.mini.denoiser.draw_starts", lambda levels, generator: levels)
    one, other = (
        draw_batch(SceneSampler(light, 64, 32, seed=1, centred=1.0), 0, Feed(24), full_canvas=128)
        for light in (panoramas, panoramas.flip(-1))
    )
    assert torch.equal(one.timesteps, other.timesteps)
    differs = (one.noisy - other.noisy).abs().amax(dim=1)
    on_ball, beside = differs[:, 7:9, 7:9].amax(dim=(1, 2)), differs[:, 7:9, [1, 14]].amax(dim=(1, 2))
    visible = one.timesteps < 900
    assert visible.sum() >= 3
    assert (on_ball < 1e-5).all()
    assert (beside[visible] > 1e-3).any()


class _Line(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.zeros(2))


def _fit(folder: Path, steps: int, until: int | None = None) -> Tensor:
    line = _Line()

    def loss(step: int) -> Tensor:
        if step == until:
            raise KeyboardInterrupt
        x = torch.randn(8, 2, generator=torch.Generator().manual_seed(step))
        return (x @ (line.slope - torch.tensor([1.0, -2.0]))).square().mean()

    return train({"line": line}, loss, Budget(steps, 0.1, warmup=3), folder, report=lambda text: None)["line"]["slope"]


def test_a_killed_training_resumes_bit_for_bit(tmp_path: Path) -> None:
    from dl_core.errors import Interrupted

    whole = _fit(tmp_path / "whole", 40)
    with pytest.raises(Interrupted, match="step 17"):
        _fit(tmp_path / "parts", 40, until=17)
    assert torch.equal(_fit(tmp_path / "parts", 40), whole)
    assert torch.allclose(whole, torch.tensor([1.0, -2.0]), atol=0.2)
    steps = [json.loads(line)["step"] for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    assert steps[-1] == 40


def test_bfloat16_is_for_the_products_alone(tmp_path: Path) -> None:
    line = _Line()
    seen = set()

    def loss(step: int) -> Tensor:
        product = torch.ones(1, 2) @ line.slope[:, None]
        seen.add(product.dtype)
        return (product.float() - 3).square().mean()

    weights = train({"line": line}, loss, Budget(60, 0.1, warmup=3, bf16=True), tmp_path, report=lambda text: None)
    assert seen == {torch.bfloat16}
    assert weights["line"]["slope"].dtype == torch.float32
    assert float(weights["line"]["slope"].sum()) == pytest.approx(3, abs=0.2)


def test_pairs_drawn_small_have_the_latents_of_large_ones(panoramas: Tensor) -> None:
    sampler = SceneSampler(panoramas, 64, 32, seed=3, bracket=True, centred=0.0)
    pair, picture = DrawnPairs(sampler, 4, scale=2)[2], sampler.draw(2)
    assert pair.ball.canvas == pair.image.shape[1] == 128
    torch.testing.assert_close(block_latents(pair.image, 8), block_latents(picture.canvas_ldr, 4), atol=5e-4, rtol=0)
    assert pair.ball.centre == tuple(2 * length for length in picture.ball.centre)
    assert float(disc_mask(pair.ball).sum() / disc_mask(picture.ball).sum()) == pytest.approx(4, rel=0.02)
    with pytest.raises(IndexError):
        DrawnPairs(sampler, 2)[2]


@pytest.mark.parametrize(("steps", "rate", "named"), [(0, 1e-3, "steps"), (10, 0.0, "learning rate")])
def test_budgets_that_make_no_sense_are_refused(steps: int, rate: float, named: str) -> None:
    with pytest.raises(OptionError, match=named):
        Budget(steps, rate)


def test_decoder_training_lowers_its_loss_and_leaves_the_encoder(panoramas: Tensor, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = MiniModel.untrained()
    sampler = SceneSampler(panoramas, 128, 64, seed=1, bracket=True)
    weights = train_decoder(model, sampler, Budget(2, 1e-3, warmup=1), tmp_path, batch=1, report=lambda text: None)[
        "vae"
    ]
    fresh = AutoencoderTiny(scaling_factor=1.0)
    write_closed_form_encoder(fresh)
    for name, tensor in fresh.encoder.state_dict().items():
        assert torch.equal(weights[f"encoder.{name}"], tensor), name
    assert write_networks(tmp_path, {"vae": weights})[0].stat().st_size < 6e6


def test_the_stage_lora_writes_a_lora_of_attentions_that_loads_into_the_painter(tmp_path: Path) -> None:
    folder, scenes = tmp_path / "mini", tmp_path / "scenes"
    folder.mkdir()
    for name in ("mini.json", "tokenizer", *NETWORK_FILES.values()):
        (folder / name).symlink_to(MINI_FOLDER / name)
    draw_scenes(scenes, "drawn", 1, 128, report=lambda text: None)
    options = argparse.Namespace(
        stage="lora", out=folder, work=tmp_path / "work", panoramas=None, scenes=scenes, steps=2, batch=1
    )
    options.learning_rate, options.seed, options.go_on, options.mixed_precision = 1e-3, 1, False, "no"
    options.noises, options.loaders, options.real_share = 1, 0, 0.5
    assert run_stage(options, lambda text: None) == [folder / LORA_FILE]
    model = load_mini(folder)
    assert model.lora is not None
    assert all("_attn" in name for name in model.lora)
    downs = [weight for name, weight in model.lora.items() if name.endswith("lora_down.weight")]
    ups = [weight for name, weight in model.lora.items() if name.endswith("lora_up.weight")]
    assert {len(down) for down in downs} == {4}
    assert all(up.abs().max() > 0 for up in ups)
    painter = DiffusersPainter.from_mini(model)
    assert painter.pipeline.get_active_adapters() == ["exposure"]


def test_scenes_are_drawn_once_and_read_back(tmp_path: Path) -> None:
    spoken: list[str] = []
    draw_scenes(tmp_path, "drawn", 2, 16, report=spoken.append)
    draw_scenes(tmp_path, "drawn", 3, 16, report=spoken.append)
    assert len(spoken) == 3
    bank = load_panoramas(None, tmp_path, height=16)
    # Half floats keep 11 bits.
    torch.testing.assert_close(bank[2:3], draw_panorama(2, 16), rtol=2**-10, atol=1e-6)


def test_real_maps_are_drawn_as_often_as_asked_for(tmp_path: Path) -> None:
    draw_scenes(tmp_path / "scenes", "drawn", 6, 16, report=lambda text: None)
    real = tmp_path / "real"
    real.mkdir()
    (real / "manifest.json").write_text('[{"file": "a.exr", "split": "training"}]')
    write_exr(real / "a.exr", torch.full((16, 32, 3), 7.0), metadata={})
    for share, maps in ((0.25, 2), (0.5, 6), (0.75, 18)):
        bank = load_panoramas(real, tmp_path / "scenes", height=16, real_share=share)
        assert int((bank == 7).all(dim=3).all(dim=2).all(dim=1).sum()) == maps
    with pytest.raises(OptionError, match="real share"):
        load_panoramas(real, tmp_path / "scenes", height=16, real_share=1.0)


def test_folders_without_panoramas_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="lightprobe train scenes"):
        load_panoramas(None, tmp_path, height=16)
    with pytest.raises(OptionError, match=r"manifest\.json"):
        panorama_files(tmp_path, "training")
    (tmp_path / "manifest.json").write_text('[{"file": "a.exr", "split": "validation"}]')
    with pytest.raises(OptionError, match="validation"):
        panorama_files(tmp_path, "training")


def test_only_base_and_control_go_on_from_weights(tmp_path: Path) -> None:
    options = argparse.Namespace(stage="vae", work=tmp_path, out=tmp_path, seed=1, go_on=True)
    with pytest.raises(OptionError, match="--go-on is 'vae'; accepted: the stages base and control"):
        run_stage(options, lambda line: None)


def test_a_work_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    options = argparse.Namespace(stage="base", work=tmp_path / "file" / "work", out=tmp_path, seed=1)
    with pytest.raises(OptionError) as raised:
        run_stage(options, lambda line: None)
    assert raised.value.name == "--work"


@given(rows=st.integers(1, 32), seed=st.integers(0, 99))
def test_reducing_keeps_the_energy(rows: int, seed: int) -> None:
    latlong = torch.rand(1, 32, 64, 3, generator=torch.Generator().manual_seed(seed)) ** 8
    assert_close(latlong_energy(reduce_panorama(latlong, rows)), latlong_energy(latlong))


def test_reducing_by_whole_blocks_averages_them() -> None:
    columns = torch.rand(1, 1, 64, 3, generator=torch.Generator().manual_seed(0)).expand(-1, 32, -1, -1)
    assert_close(reduce_panorama(columns, 8), columns.unflatten(2, (16, 4)).mean(dim=3)[:, :8])


@pytest.mark.parametrize("seed", range(6))
def test_procedural_panoramas_are_radiance_with_light_above(seed: int) -> None:
    panorama = draw_panorama(seed, 32)
    assert panorama.shape == (1, 32, 64, 3)
    assert torch.isfinite(panorama).all()
    assert panorama.min() >= 0
    assert panorama[:, :16].sum() > panorama[:, 16:].sum()


def test_control_training_wakes_the_controlnet_and_gives_a_whole_one(panoramas: Tensor, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = MiniModel.untrained()
    sampler = SceneSampler(panoramas, 128, 64, seed=1)
    weights = train_control(model, sampler, Budget(3, 1e-3, warmup=1), tmp_path, feed=Feed(1), report=lambda text: None)
    fresh = MiniModel.untrained()
    fresh.controlnet.load_state_dict(weights["controlnet"])
    fresh.unet.load_state_dict(weights["unet"])
    seen = fresh.controlnet.controlnet_cond_embedding.state_dict()
    assert torch.equal(seen["blocks.3.weight"], model.controlnet.controlnet_cond_embedding.blocks[3].weight)
    assert fresh.controlnet.controlnet_mid_block.weight.abs().max() > 0
    # The last look layer starts at zero behind residuals that do: it hears of the loss from the second step on.
    assert seen["conv_out.weight"].abs().max() > 0


SHARED_STEPS = """
import json, sys, torch
from pathlib import Path
from accelerate import PartialState
from dl_core.training.mini.loop import Budget, train

PartialState(cpu=True)
torch.manual_seed(0)
network = torch.nn.Linear(3, 2)


def loss_of_batch(number):
    given = torch.randn(4, 3, generator=torch.Generator().manual_seed(number))
    return (network(given) - given[:, :2]).square().mean()


def loss_of_step(step):
    return loss_of_batch(step) if int(sys.argv[2]) == 1 else (loss_of_batch(2 * step) + loss_of_batch(2 * step + 1)) / 2


weights = train({"net": network}, loss_of_step, Budget(12, 1e-2, warmup=2), Path(sys.argv[1]), report=lambda line: None)
if PartialState().is_main_process:
    Path(sys.argv[1], "weights.json").write_text(json.dumps(weights["net"]["weight"].tolist()))
"""


def test_two_processes_train_as_one_with_batches_twice_as_large(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SHARED_STEPS)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    for launcher, folder, batches in ((torchrun, "two", "1"), ([sys.executable], "one", "2")):
        subprocess.run([*launcher, str(script), str(tmp_path / folder), batches], check=True, env=environment)
    two, one = (torch.tensor(json.loads((tmp_path / name / "weights.json").read_text())) for name in ("two", "one"))
    torch.testing.assert_close(two, one)
    assert len((tmp_path / "two" / "log.jsonl").read_text().splitlines()) == 1  # the second process stays silent
