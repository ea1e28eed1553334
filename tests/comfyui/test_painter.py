"""ComfyPainter: the port's promises, and agreement with the diffusers path on the same weights, noise and steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import comfy_host
import pytest
import torch
from comfy_host import pack_module

STEPS = 3


class Recorder:
    """An observer that adds up."""

    def __init__(self) -> None:
        self.evaluations = 0

    def evaluated(self, count: int) -> None:
        self.evaluations += count

    def painted(self, ev: float, round_index: int, balls: Any) -> None:
        raise AssertionError("a painter knows no rounds")


def painter(graph: Any, **options: Any) -> Any:
    module = pack_module("nodes.painter")
    extra = {name: options.pop(name) for name in ("mask", "on_balls") if name in options}
    return module.ComfyPainter(module.Networks(**graph.sockets()), module.Guidance(**options), **extra)


def request(
    scene: Any, seeds: tuple[int, ...] = (0,), strength: float = 1.0, steps: int = STEPS, until: float = 1.0
) -> Any:
    kind = pack_module("dl_core.painter").PaintRequest
    return kind(scene.canvas, scene.depth, scene.ball, 0.0, seeds, strength=strength, steps=steps, until=until)


def paint(graph: Any, asked: Any, **options: Any) -> Any:
    return painter(graph, **options).paint(asked, Recorder())


STOCHASTIC = ("lcm", "euler_ancestral", "dpmpp_2m_sde", "ddpm")


def samplers() -> tuple[str, ...]:
    plain = ("uni_pc", "uni_pc_bh2", "euler", "dpmpp_2m", "deis", "ipndm", "ipndm_v", "lms", "res_multistep")
    return plain + STOCHASTIC


def test_list_of_samplers_is_the_one_tested(pack: Any) -> None:
    module = pack_module("nodes.sampling")
    assert (samplers(), STOCHASTIC) == (module.SAMPLERS, module.STOCHASTIC)


@pytest.mark.parametrize("sampler", samplers())
@pytest.mark.parametrize(
    ("cfg", "strength", "until", "steps"),
    [(5.0, 1.0, 1.0, 3), (1.0, 0.7, 1.0, 2), (5.0, 1.0, 0.4, 1), (1.0, 0.7, 0.7, 1)],
)
def test_evaluations_are_counted_and_foretold(
    graph: Any, scene: Any, sampler: str, cfg: float, strength: float, until: float, steps: int
) -> None:
    """Counted where the network itself is called, a batch of n being n evaluations."""
    calls: list[int] = []
    hook = graph.model.model.diffusion_model.register_forward_hook(
        lambda module, arguments, output: calls.append(len(output))
    )
    observer = Recorder()
    brush = painter(graph, cfg=cfg, sampler=sampler, batch_size=2)
    try:
        result = brush.paint(request(scene, (3, 4, 5), strength, until=until), observer)
    finally:
        hook.remove()
    foretold = brush.evaluations(3, STEPS, strength, until)
    assert sum(calls) == result.evaluations == observer.evaluations == foretold
    assert foretold == 3 * steps * (1 if cfg == 1 else 2)
    assert result.balls.shape == (3, 32, 32, 3)
    assert result.balls.min() >= 0
    assert result.balls.max() <= 1


@pytest.mark.parametrize("sampler", samplers())
def test_a_ball_depends_on_its_seed_and_not_on_its_batch(graph: Any, scene: Any, sampler: str) -> None:
    together = paint(graph, request(scene, (7, 8, 9)), sampler=sampler, batch_size=3).balls
    alone = paint(graph, request(scene, (8,)), sampler=sampler).balls
    assert (together[1] - alone[0]).abs().max() < 1e-5  # order of summation in batched matrix products
    assert (together[0] - together[1]).abs().max() > 1e-4


@pytest.mark.parametrize("sampler", samplers())
def test_stochastic_samplers_repeat_and_say_so(graph: Any, scene: Any, sampler: str) -> None:
    first, again = (paint(graph, request(scene, (7,)), sampler=sampler) for _ in range(2))
    assert torch.equal(first.balls, again.balls)
    assert any("is stochastic" in note for note in first.notes) == (sampler in STOCHASTIC)
    assert paint(graph, request(scene, (7,), strength=0.7), sampler=sampler).notes == ()


@pytest.mark.parametrize("after_posterior", [False, True])
def test_noise_of_a_ball_is_its_own_generators(pack: Any, after_posterior: bool) -> None:
    latent = torch.zeros(1, 4, 2, 3)
    noise = pack_module("nodes.sampling").BallNoise((5, 9), latent, after_posterior=after_posterior)
    drawn = [noise.initial, noise(torch.tensor(3.0), torch.tensor(2.0)), noise(torch.tensor(2.0), torch.tensor(1.0))]
    for row, seed in enumerate((5, 9)):
        generator = torch.Generator().manual_seed(seed)
        stream = [torch.randn(1, 4, 2, 3, generator=generator) for _ in range(3 + after_posterior)]
        for ours, expected in zip(drawn, stream[after_posterior:], strict=True):
            assert torch.equal(ours[row], expected[0])


def test_strength_one_starts_from_noise_alone(graph: Any, scene: Any) -> None:
    """Under the disc the photograph must not show through: two photographs that differ there only give one ball."""
    other = scene.canvas.clone()
    inside = pack_module("dl_core.ball").disc_mask(scene.ball)[..., None]
    other = other * (1 - inside) + (1 - other) * inside
    latent, changed = (graph.vae.encode(picture) for picture in (scene.canvas, other))
    assert (latent - changed).abs().max() > 1e-3
    seen: list[torch.Tensor] = []
    hook = graph.model.model.diffusion_model.register_forward_pre_hook(
        lambda module, arguments: seen.append(arguments[0].clone())
    )
    try:
        for canvas in (scene.canvas, other):
            paint(graph, request(replace(scene, canvas=canvas)), sampler="euler")
    finally:
        hook.remove()
    centre = (slice(None), slice(None), slice(3, 5), slice(3, 5))
    assert torch.equal(seen[0][centre], seen[STEPS][centre])


@pytest.mark.parametrize("steps", [30, 20, 6])
def test_paper_schedule_visits_what_diffusers_visits(graph: Any, scene: Any, steps: int) -> None:
    from diffusers import UniPCMultistepScheduler

    reference = UniPCMultistepScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", timestep_spacing="leading", steps_offset=1
    )
    reference.set_timesteps(steps)
    visited = pack_module("nodes.sampling").leading_timesteps(steps)
    assert visited == reference.timesteps.tolist()
    if steps == 30:
        assert visited[:2] + visited[-1:] == [961, 929, 33]
    times: list[float] = []
    hook = graph.model.model.diffusion_model.register_forward_pre_hook(
        lambda module, arguments: times.append(float(arguments[1][0]))
    )
    try:
        paint(graph, request(scene, steps=steps), cfg=1.0)
    finally:
        hook.remove()
    assert times == visited


@pytest.mark.parametrize("scheduler", ["simple", "karras", "beta", "sgm_uniform", "normal", "exponential"])
def test_comfyui_schedules_run_the_steps_asked_for(graph: Any, scene: Any, scheduler: str) -> None:
    brush = painter(graph, scheduler=scheduler, sampler="euler")
    result = brush.paint(request(scene, steps=5, strength=0.8), Recorder())
    assert result.evaluations == brush.evaluations(1, 5, 0.8) == 8


def test_hears_of_balls_after_every_batch(graph: Any, scene: Any) -> None:
    heard: list[int] = []
    paint(graph, request(scene, (0, 1, 2)), batch_size=2, on_balls=lambda balls: heard.append(len(balls)))
    assert heard == [2, 3]


def test_interruption_stops_before_the_next_evaluation(graph: Any, scene: Any) -> None:
    import comfy.model_management

    class Interrupter(Recorder):
        def evaluated(self, count: int) -> None:
            super().evaluated(count)
            if self.evaluations >= 4:
                comfy.model_management.interrupt_current_processing()

    observer = Interrupter()
    with pytest.raises(comfy.model_management.InterruptProcessingException):
        painter(graph).paint(request(scene, steps=8), observer)
    assert observer.evaluations == 4
    assert paint(graph, request(scene)).evaluations == 2 * STEPS  # and the next run is not disturbed


@pytest.mark.parametrize("step", range(1, 9))
def test_interruption_at_any_step(graph: Any, scene: Any, step: int) -> None:
    errors = pack_module("dl_core.errors")

    class Stopper(Recorder):
        def evaluated(self, count: int) -> None:
            super().evaluated(count)
            if self.evaluations == 2 * step:
                raise errors.Interrupted("test")

    observer = Stopper()
    with pytest.raises(errors.Interrupted):
        painter(graph).paint(request(scene, steps=8), observer)
    assert observer.evaluations == 2 * step


def test_one_step_is_refused_where_the_sampler_cannot(graph: Any, scene: Any) -> None:
    errors = pack_module("dl_core.errors")
    with pytest.raises(errors.OptionError, match=r"steps is 2.*uni_pc"):
        paint(graph, request(scene, steps=2, strength=0.5))
    assert paint(graph, request(scene, steps=1), sampler="euler").evaluations == 2


def clean_estimates(graph: Any, asked: Any, **options: Any) -> tuple[Any, list[torch.Tensor]]:
    """A run to the end: its balls, and what ComfyUI's guided model took for the clean latents at each step."""
    found: list[torch.Tensor] = []

    def keep(evaluated: Any) -> Any:
        found.append(evaluated["denoised"].clone())
        return evaluated["denoised"]

    model = graph.model.clone()
    model.set_model_sampler_post_cfg_function(keep)
    return paint(replace(graph, model=model), asked, **options).balls, found


@pytest.mark.parametrize("sampler", samplers())
@pytest.mark.parametrize(
    ("strength", "until", "last", "impute"),
    [(1.0, 0.25, 0, "initial"), (0.8, 0.6, 1, "predicted")],
)
def test_an_early_answer_is_what_a_whole_run_took_for_clean_at_that_step(
    graph: Any, scene: Any, sampler: str, strength: float, until: float, last: int, impute: str
) -> None:
    """With the photograph around the mask, decoded as a whole canvas."""
    from comfy.sampler_helpers import prepare_mask

    asked = request(scene, (7, 8), strength, steps=5 if strength < 1 else 4)
    whole, estimates = clean_estimates(graph, asked, sampler=sampler, impute=impute)
    early = paint(graph, replace(asked, until=until), sampler=sampler, impute=impute).balls
    mask = prepare_mask(scene.mask, estimates[last].shape, "cpu")
    latents = torch.lerp(graph.vae.encode(scene.canvas), estimates[last], mask)
    expected = pack_module("dl_core.ball").crop_ball(graph.vae.decode(latents), scene.ball)
    # Half an 8-bit code for the cut of the decoding, and rounding.
    assert (early - expected).abs().max() < 0.5 / 255 + 1e-4
    assert not torch.equal(early, whole)
    assert len(estimates) == 4


def test_early_answers_and_whole_ones_are_kept_apart(graph: Any, scene: Any) -> None:
    module = pack_module("nodes.painter")
    store = pack_module("dl_core.finished").FinishedBalls(10**6)
    brush = module.ComfyPainter(module.Networks(**graph.sockets()), module.Guidance(), finished=store)
    costs = {
        until: [brush.paint(request(scene, steps=4, until=until), Recorder()).evaluations for _ in range(2)]
        for until in (1.0, 0.5, 0.75)
    }
    assert costs == {1.0: [8, 0], 0.5: [4, 0], 0.75: [6, 0]}
    observer = Recorder()
    brush.paint(request(scene, steps=4, until=0.5), observer)
    assert observer.evaluations == 4  # of an earlier run, told at once


# --- agreement with diffusers ------------------------------------------------------------------------------------


def diffusers_painter(mini: Any, sampler: str, guidance: float, control: float) -> Any:
    backend = pack_module("dl_core.backends.diffusers_painter")
    defaults = replace(mini.defaults, guidance=guidance, control_scale=control)
    return backend.DiffusersPainter.from_mini(replace(mini, defaults=defaults, lora=None), sampler=sampler)


@pytest.fixture
def leading_euler(monkeypatch: pytest.MonkeyPatch) -> str:
    """diffusers' Euler on the paper's timesteps, as one more row of the backend's table."""
    table = pack_module("dl_core.backends.diffusers_painter").SAMPLERS
    monkeypatch.setitem(table, "leading_euler", comfy_host.leading_euler)
    return "leading_euler"


@pytest.mark.parametrize(("steps", "strength"), [(6, 1.0), (10, 0.8)])
def test_predicted_noise_is_imputed_as_in_the_listing(
    trained_graph: Any, mini_scene: Any, monkeypatch: pytest.MonkeyPatch, steps: int, strength: float
) -> None:
    """Euler over noise levels is DDIM, which is first-order DPM-Solver++ in diffusers, on UniPC's timesteps."""
    from diffusers import DPMSolverMultistepScheduler

    backend = pack_module("dl_core.backends.diffusers_painter")

    def first_order(config: Any) -> Any:
        return DPMSolverMultistepScheduler.from_config(config, solver_order=1, algorithm_type="dpmsolver++")

    monkeypatch.setitem(backend.SAMPLERS, "first_order", first_order)
    defaults = replace(trained_graph.mini.defaults, guidance=3.0, control_scale=0.5)
    mini = replace(trained_graph.mini, defaults=defaults, lora=None)
    asked = request(mini_scene, (0, 1), strength, steps)
    theirs, other = (
        backend.DiffusersPainter.from_mini(mini, sampler="first_order", impute=impute).paint(asked, Recorder()).balls
        for impute in ("predicted", "initial")
    )
    ours = paint(trained_graph, asked, sampler="euler", cfg=3.0, control_strength=0.5, impute="predicted").balls
    assert (ours - theirs).abs().mean() < 5e-3  # cells that the mask covers partly are blended differently
    assert (other - theirs).abs().mean() > 0.01  # so the option does something, in both


def euler_difference(graph: Any, scene: Any, steps: int, strength: float, row: str) -> tuple[float, float]:
    """Mean absolute difference of two balls from diffusers' Euler, and the standard deviation of the latter."""
    asked = request(scene, (0, 1), strength, steps)
    theirs = diffusers_painter(graph.mini, row, 3.0, 0.5).paint(asked, Recorder()).balls
    ours = paint(graph, asked, sampler="euler", cfg=3.0, control_strength=0.5).balls
    return float((ours - theirs).abs().mean()), float(theirs.std())


@pytest.mark.parametrize(("strength", "until"), [(1.0, 0.1), (1.0, 0.5), (0.8, 0.7)])
def test_early_answers_agree_with_diffusers_on_trained_weights(
    trained_graph: Any, mini_scene: Any, leading_euler: str, strength: float, until: float
) -> None:
    """At the same step, by the project's bar; the two compute the clean image each in its own units."""
    asked = request(mini_scene, (0, 1), strength, 10, until)
    theirs = diffusers_painter(trained_graph.mini, leading_euler, 3.0, 0.5).paint(asked, Recorder())
    ours = paint(trained_graph, asked, sampler="euler", cfg=3.0, control_strength=0.5)
    assert ours.evaluations == theirs.evaluations
    assert theirs.balls.std() > 0.05
    assert (ours.balls - theirs.balls).abs().mean() <= 1e-2


SCHEDULES = pytest.mark.parametrize(("steps", "strength"), [(6, 1.0), (10, 0.8)])


@SCHEDULES
def test_euler_agrees_with_diffusers(
    graph: Any, mini_scene: Any, leading_euler: str, steps: int, strength: float
) -> None:
    """Untrained networks paint balls of little contrast, so the difference is held against that contrast."""
    difference, contrast = euler_difference(graph, mini_scene, steps, strength, leading_euler)
    assert difference <= 0.02 * contrast


@SCHEDULES
def test_euler_agrees_with_diffusers_on_trained_weights(
    trained_graph: Any, mini_scene: Any, leading_euler: str, steps: int, strength: float
) -> None:
    """The project's bar: 1e-2 in [0, 1]."""
    difference, contrast = euler_difference(trained_graph, mini_scene, steps, strength, leading_euler)
    assert contrast > 0.05
    assert difference <= 1e-2
