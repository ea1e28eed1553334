"""DiffusersPainter against diffusers' own inpainting pipeline on the same networks, noise and schedule."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from reference_pipeline import pipeline_canvases
from tolerances import assert_close
from torch import Tensor

from dl_core.backends.diffusers_painter import SAMPLERS, DiffusersPainter, ball_latent_mask
from dl_core.backends.loading import BACKENDS, ModelFiles
from dl_core.backends.mini import MiniModel, read_weights
from dl_core.ball import Ball, crop_ball, paint_depth, place_ball
from dl_core.errors import ImageError, Interrupted, ModelError, OptionError
from dl_core.iterative import Rounds, rounds_evaluations
from dl_core.painter import IMPUTINGS, Imputing, PaintRequest, SilentObserver, steps_run
from dl_core.training.mini.autoencoder import write_closed_form_encoder, write_thumbnail_decoder

SIDE = 128


@pytest.fixture(scope="module")
def model() -> MiniModel:
    """The mini model's architecture with random weights, every residual of the ControlNet awake."""
    torch.manual_seed(1)
    model = MiniModel.untrained()
    write_closed_form_encoder(model.vae)
    write_thumbnail_decoder(model.vae)
    with torch.no_grad():
        for parameter in model.controlnet.parameters():
            if not parameter.any():
                parameter.normal_(std=0.02)
    return model


@pytest.fixture(scope="module")
def painter(model: MiniModel) -> DiffusersPainter:
    return DiffusersPainter.from_mini(model, batch=2)


@pytest.fixture(scope="module")
def ball() -> Ball:
    """A ball whose latent mask is binary: diffusers' pipeline rounds masks, ours keeps the soft edge."""
    for diameter in range(48, 72, 2):
        for dilation in range(8):
            ball = place_ball(SIDE, diameter, dilation=dilation)
            mask = ball_latent_mask(ball)
            if bool(((mask == 0) | (mask == 1)).all()):
                return ball
    raise AssertionError("no ball of a binary latent mask")


@pytest.fixture(scope="module")
def request_(ball: Ball) -> PaintRequest:
    canvas = torch.rand(1, SIDE, SIDE, 3, generator=torch.Generator().manual_seed(9))
    # 8-bit values, since the pipeline is given pictures.
    canvas = (canvas * 255).round() / 255
    return PaintRequest(canvas, paint_depth(None, ball), ball, -2.5, (11, 12), strength=1.0, steps=4)


def _pipeline_balls(painter: DiffusersPainter, request: PaintRequest, sampler: str) -> Tensor:
    """What diffusers' pipeline paints for a request."""
    pipeline = painter.pipeline
    scheduler = SAMPLERS[sampler](pipeline.scheduler.config)
    guidance, mask = painter.guidance_at(request.ev), ball_latent_mask(request.ball)
    canvases = pipeline_canvases(pipeline, scheduler, request, guidance, painter.defaults, mask)
    return crop_ball(canvases, request.ball)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_balls_equal_those_of_the_pipeline(
    model: MiniModel, request_: PaintRequest, sampler: str, strength: float
) -> None:
    painter = DiffusersPainter.from_mini(model, batch=2, sampler=sampler)
    asked = replace(request_, strength=strength)
    painted = painter.paint(asked, SilentObserver()).balls
    # The pipeline's 8-bit mask and depth are exact here; what remains is rounding over four steps.
    assert (painted - _pipeline_balls(painter, asked, sampler)).abs().max() < 1e-3
    assert painted.std() > 0.02


def _clean_estimates(build: Callable[[Any], Any], found: list[Tensor]) -> Callable[[Any], Any]:
    """A row of `SAMPLERS` whose scheduler keeps the clean latents that it takes every prediction for, by itself."""

    def recording(config: Any) -> Any:
        scheduler = build(config)
        if hasattr(scheduler, "convert_model_output"):
            convert = scheduler.convert_model_output
            scheduler.convert_model_output = lambda *given, **options: _kept(convert(*given, **options), found)
        else:
            step = scheduler.step

            def keep(*given: Any, return_dict: bool, **options: Any) -> tuple[Tensor]:
                output = step(*given, **options)
                found.append(output.pred_original_sample)
                return (output.prev_sample,)

            scheduler.step = keep
        return scheduler

    return recording


def _kept(estimate: Tensor, found: list[Tensor]) -> Tensor:
    found.append(estimate.clone())
    return estimate


SAMPLED = [
    (sampler, impute) for sampler in SAMPLERS for impute in IMPUTINGS if (sampler, impute) != ("euler", "predicted")
]


@pytest.mark.parametrize(("sampler", "impute"), SAMPLED)
@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize(("strength", "until", "last"), [(1.0, 0.75, 2), (0.5, 0.75, 0)])
def test_an_early_answer_is_the_schedulers_own_clean_estimate(
    model: MiniModel,
    request_: PaintRequest,
    monkeypatch: pytest.MonkeyPatch,
    sampler: str,
    impute: Imputing,
    prediction: str,
    strength: float,
    until: float,
    last: int,
) -> None:
    """At that step of a run to the end, with the photograph around the disc, decoded as a whole canvas."""
    painter = DiffusersPainter.from_mini(model, batch=2, sampler=sampler, impute=impute)
    settings = {**painter.pipeline.scheduler.config, "prediction_type": prediction}
    painter.pipeline.scheduler = type(painter.pipeline.scheduler).from_config(settings)
    asked = replace(request_, strength=strength)
    early = painter.paint(replace(asked, until=until), SilentObserver()).balls

    estimates: list[Tensor] = []
    monkeypatch.setitem(SAMPLERS, sampler, _clean_estimates(SAMPLERS[sampler], estimates))
    painter.paint(asked, SilentObserver())
    assert len(estimates) == len(steps_run(asked.steps, strength))
    with torch.no_grad():
        photograph = model.vae.encode(request_.canvas.permute(0, 3, 1, 2) * 2 - 1).latents
        expected = torch.lerp(photograph, estimates[last], ball_latent_mask(request_.ball))
        canvas = (model.vae.decode(expected).sample / 2 + 0.5).clamp(0, 1).permute(0, 2, 3, 1)
    # Half an 8-bit code for the cut of the decoding, and rounding.
    assert (early - crop_ball(canvas, request_.ball)).abs().max() < 0.5 / 255 + 1e-4
    assert (estimates[last] - estimates[-1]).abs().max() > 1e-3


class _Count(SilentObserver):
    def __init__(self, stop_at: int | None = None) -> None:
        self.total = 0
        self.stop_at = stop_at

    def evaluated(self, count: int) -> None:
        self.total += count
        if self.stop_at is not None and self.total >= self.stop_at:
            raise Interrupted("stop")


class _CountedUNet:
    """Counts the pictures a UNet really evaluates."""

    def __init__(self, unet: torch.nn.Module) -> None:
        self.evaluated = 0
        self.handle = unet.register_forward_pre_hook(self._count)

    def _count(self, unet: torch.nn.Module, arguments: tuple[Tensor, ...]) -> None:
        self.evaluated += len(arguments[0])


@pytest.mark.parametrize(
    ("guidance", "strength", "until", "steps"),
    [(1.0, 1.0, 1.0, 4), (3.0, 1.0, 1.0, 4), (3.0, 0.5, 1.0, 2), (3.0, 1.0, 0.5, 2), (1.0, 0.5, 0.75, 1)],
)
def test_the_cost_told_planned_and_reported_is_what_the_unet_does(
    model: MiniModel, request_: PaintRequest, guidance: float, strength: float, until: float, steps: int
) -> None:
    painter = DiffusersPainter.from_mini(model, batch=2)
    painter.defaults = replace(painter.defaults, guidance=guidance)
    asked = replace(request_, strength=strength, until=until, seeds=(1, 2, 3))
    counted, observer = _CountedUNet(model.unet), _Count()
    try:
        result = painter.paint(asked, observer)
    finally:
        counted.handle.remove()
    planned = painter.evaluations(3, asked.steps, strength, until)
    assert counted.evaluated == result.evaluations == observer.total == planned
    assert planned == 3 * steps * (1 if guidance == 1 else 2)


def test_the_paper_costs_9864_evaluations(painter: DiffusersPainter) -> None:
    assert 3 * rounds_evaluations(painter, Rounds(balls=30, rounds=2, strength=0.8, steps=30)) == 2 * 4932


def test_a_ball_does_not_depend_on_its_batch(
    model: MiniModel, painter: DiffusersPainter, request_: PaintRequest
) -> None:
    alone = DiffusersPainter.from_mini(model, batch=1).paint(request_, SilentObserver()).balls
    assert (alone - painter.paint(request_, SilentObserver()).balls).abs().max() < 1e-4


def test_a_seed_fixes_its_ball_and_another_gives_another(painter: DiffusersPainter, request_: PaintRequest) -> None:
    first, again = (painter.paint(request_, SilentObserver()).balls for _ in range(2))
    assert torch.equal(first, again)
    assert (first[0] - first[1]).abs().mean() > 1e-3


@pytest.mark.parametrize("stop_at", [1, 9, 16])
def test_interruption_at_any_step_leaves_the_painter_usable(
    painter: DiffusersPainter, request_: PaintRequest, stop_at: int
) -> None:
    before = painter.paint(request_, SilentObserver()).balls
    with pytest.raises(Interrupted):
        painter.paint(request_, _Count(stop_at))
    assert torch.equal(painter.paint(request_, SilentObserver()).balls, before)


def shortage(model: MiniModel, most: int) -> Any:
    """Makes the UNet run out of memory with more than so many pictures at once; a handle to end it."""

    def refuse(unet: torch.nn.Module, arguments: tuple[Tensor, ...]) -> None:
        if len(arguments[0]) > most:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    return model.unet.register_forward_pre_hook(refuse)


def test_a_shortage_halves_the_batch_for_good_and_is_noted(model: MiniModel, request_: PaintRequest) -> None:
    painter = DiffusersPainter.from_mini(model, batch=4)
    asked = replace(request_, seeds=(1, 2, 3, 4))
    counted, observer = _CountedUNet(model.unet), _Count()
    handle = shortage(model, 4)  # two balls, with and without the prompt
    try:
        first, second = painter.paint(asked, observer), painter.paint(asked, SilentObserver())
    finally:
        handle.remove()
        counted.handle.remove()
    assert first.notes == ("out of memory with 4 balls at once: went on with 2",)
    assert second.notes == ()
    assert first.evaluations == observer.total == painter.evaluations(4, asked.steps, 1.0)
    in_pairs = DiffusersPainter.from_mini(model, batch=2).paint(asked, SilentObserver()).balls
    assert torch.equal(first.balls, in_pairs)
    assert torch.equal(second.balls, in_pairs)


def test_one_ball_that_does_not_fit_is_a_clear_error(model: MiniModel, request_: PaintRequest) -> None:
    handle = shortage(model, 0)
    try:
        with pytest.raises(ModelError, match="does not fit in the memory of cpu with one ball"):
            DiffusersPainter.from_mini(model, batch=2).paint(request_, SilentObserver())
    finally:
        handle.remove()


def test_guidance_is_on_the_line_between_the_two_original_prompts(painter: DiffusersPainter) -> None:
    bright, middle, dark = (painter.guidance_at(ev) for ev in (0.0, -1.25, -5.0))
    assert_close(middle.tokens, bright.tokens * 0.75 + dark.tokens * 0.25)
    assert_close(middle.pooled, bright.pooled * 0.75 + dark.pooled * 0.25)
    assert (bright.pooled - dark.pooled).abs().max() > 1e-4


def test_imputing_with_the_predicted_noise_is_the_paper_s_listing(model: MiniModel, request_: PaintRequest) -> None:
    """With DDIM an update of the clean photograph's own noise is what the listing imputes; the two ways differ."""
    listing = DiffusersPainter.from_mini(model, sampler="ddim", impute="predicted")
    code = DiffusersPainter.from_mini(model, sampler="ddim")
    balls = [painter.paint(request_, SilentObserver()).balls for painter in (listing, code)]
    assert (balls[0] - balls[1]).abs().mean() > 1e-4


@pytest.mark.parametrize("impute", ["initial", "predicted"])
def test_networks_in_half_precision_paint_the_same_ball(
    model: MiniModel, request_: PaintRequest, impute: Imputing
) -> None:
    """As on a GPU: networks in half precision, the autoencoder and all that is summed up over steps in single."""
    whole = DiffusersPainter.from_mini(model, impute=impute).paint(request_, SilentObserver()).balls
    halved = deepcopy(model)
    for network in (halved.unet, halved.controlnet, halved.text_encoder, halved.text_encoder_2):
        network.to(torch.bfloat16)
    painter = DiffusersPainter.from_mini(halved, impute=impute)
    halves = painter.paint(request_, SilentObserver()).balls
    assert halves.dtype == torch.float32
    difference = (halves - whole).abs().mean()
    assert 0 < difference < 0.02  # bfloat16 keeps 8 bits


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"sampler": "heun"}, "unipc, ddim, euler, ddpm"),
        ({"walk": 1}, "walk"),
        ({"batch": 0}, "batch"),
        ({"impute": "predicted", "sampler": "euler"}, "euler"),
    ],
)
def test_options_out_of_range_are_named(model: MiniModel, options: dict[str, object], named: str) -> None:
    with pytest.raises(OptionError, match=named):
        DiffusersPainter.from_mini(model, **options)


def test_a_canvas_of_another_size_is_refused(painter: DiffusersPainter, request_: PaintRequest) -> None:
    small = torch.zeros(1, 64, 64, 3)
    with pytest.raises(ImageError, match="128 x 128"):
        painter.paint(replace(request_, canvas=small, depth=small), SilentObserver())


def test_missing_and_foreign_model_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such file"):
        DiffusersPainter.from_files(tmp_path / "sdxl.safetensors", tmp_path / "depth.safetensors")
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"not a model")
    with pytest.raises(ModelError, match=r"broken\.safetensors"):
        DiffusersPainter.from_files(broken, broken)
    with pytest.raises(ModelError, match=r"broken\.safetensors"):
        read_weights(broken)


def test_a_depth_map_is_seen_once_and_the_controlnet_is_left_as_it_was(
    painter: DiffusersPainter, request_: PaintRequest
) -> None:
    looking, looked = painter.pipeline.controlnet.controlnet_cond_embedding, list[int]()
    hook = looking.register_forward_hook(lambda module, inputs, output: looked.append(len(inputs[0])))
    painter.paint(replace(request_, seeds=(1, 2, 3)), SilentObserver())
    assert looked == [1]
    with pytest.raises(Interrupted):
        painter.paint(request_, _Stopping())
    hook.remove()
    assert painter.pipeline.controlnet.controlnet_cond_embedding is looking


class _Stopping(SilentObserver):
    def evaluated(self, count: int) -> None:
        raise Interrupted("stopped")


def test_the_photograph_and_a_composite_are_encoded_once(
    model: MiniModel, request_: PaintRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    painter = DiffusersPainter.from_mini(model)
    encoded = list[float]()
    encode = model.vae.encode
    monkeypatch.setattr(model.vae, "encode", lambda pixels: encoded.append(float(pixels.mean())) or encode(pixels))
    short = replace(request_, steps=1, seeds=(1,))
    first = painter.paint(short, SilentObserver()).balls
    others = [replace(short, canvas=short.canvas * share) for share in (0.5, 0.25)]
    for other in others:
        painter.paint(other, SilentObserver())
        assert torch.equal(painter.paint(replace(short, canvas=short.canvas.clone()), SilentObserver()).balls, first)
    assert len(encoded) == 3
    painter.paint(others[0], SilentObserver())
    assert len(encoded) == 4


def test_a_varied_painter_samples_and_guides_in_another_way(painter: DiffusersPainter, request_: PaintRequest) -> None:
    short = replace(request_, seeds=(1,), steps=3)
    own = painter.paint(short, SilentObserver())
    unguided = painter.varied(guidance=1.0).paint(short, SilentObserver())
    assert unguided.evaluations * 2 == own.evaluations
    euler = painter.varied(sampler="euler").paint(short, SilentObserver())
    direct = DiffusersPainter(painter.pipeline, painter.defaults, sampler="euler").paint(short, SilentObserver())
    assert torch.equal(euler.balls, direct.balls)
    guided = painter.varied(guidance=3.0).paint(short, SilentObserver())
    assert guided.evaluations == own.evaluations
    for other in (guided, euler):
        assert (other.balls - own.balls).abs().max() > 1e-3
    with pytest.raises(OptionError, match="sampler"):
        painter.varied(sampler="none")


def test_the_mini_model_paints_the_same_ball_in_bfloat16(request_: PaintRequest) -> None:
    """The same light from the same noise; another seed's is further off."""
    asked = replace(request_, ball=place_ball(256, 128), seeds=(3, 4), steps=3)
    canvas = torch.rand(1, 256, 256, 3, generator=torch.Generator().manual_seed(2))
    asked = replace(asked, canvas=canvas, depth=paint_depth(None, asked.ball))
    found = {}
    for precision in (None, "bfloat16"):
        painter = BACKENDS["mini"].load(ModelFiles(precision=precision), "initial").painter
        assert isinstance(painter, DiffusersPainter)
        assert painter.pipeline.unet.dtype == (torch.float32 if precision is None else torch.bfloat16)
        found[precision] = painter.paint(asked, SilentObserver()).balls
    apart = (found[None][0] - found[None][1]).abs().mean()
    assert 0 < (found["bfloat16"] - found[None]).abs().mean() < 0.2 * apart


def test_a_stochastic_sampler_walks_its_own_way_from_the_same_start(
    painter: DiffusersPainter, request_: PaintRequest
) -> None:
    drawn = painter.varied(sampler="ddpm", batch=1)
    balls = drawn.paint(request_, SilentObserver()).balls
    assert torch.equal(drawn.varied().paint(request_, SilentObserver()).balls, balls)
    other_batch = drawn.varied(batch=2).paint(request_, SilentObserver()).balls
    assert (other_batch - balls).abs().max() < 1e-4
    other_walk = drawn.varied(walk=1).paint(request_, SilentObserver()).balls
    assert (other_walk - balls).abs().max() > 1e-2
    # Random networks: all that is known of the start is that the walk leaves it as it is.
    last = replace(request_, strength=0.25)
    assert torch.equal(
        drawn.paint(last, SilentObserver()).balls, drawn.varied(walk=1).paint(last, SilentObserver()).balls
    )


def test_another_precision_leaves_the_painter_as_it_is(painter: DiffusersPainter, request_: PaintRequest) -> None:
    before = painter.paint(request_, SilentObserver()).balls
    halves = painter.in_precision(torch.bfloat16).paint(request_, SilentObserver()).balls
    assert painter.pipeline.unet.dtype == torch.float32
    assert torch.equal(painter.paint(request_, SilentObserver()).balls, before)
    assert 0 < (halves - before).abs().mean() < 0.02  # bfloat16 keeps 8 bits
