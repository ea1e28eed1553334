"""How painting runs: interrupted and queued again, short of memory, on few steps, without piling up canvases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from comfy_host import pack_module
from counted_network import watched
from torch.profiler import ProfilerActivity, profile

PAINTING = {
    "seed": 0,
    "steps": 2,
    "cfg": 5.0,
    "sampler": "uni_pc",
    "scheduler": "leading (paper)",
    "control_strength": 0.5,
    "batch_size": 2,
}
ROUNDS = {"preset": "custom", "balls": 4, "rounds": 2, "strength": 1.0, "final": True}
BALL_COST = 2 * PAINTING["steps"]
"""Denoiser evaluations of a ball: with and without the prompt, at each step."""
RUN_COST = (4 + 4 + 1) * BALL_COST

Nodes = Callable[[str], Any]


@pytest.fixture(scope="module")
def graph(trained_graph: Any) -> Any:
    """Trained networks: untrained ones paint nearly black balls, which are all alike."""
    return trained_graph


def run(node: Nodes, graph: Any, scene: Any, **changes: Any) -> Any:
    """Outputs of IterativeMedian: ball, median, spread, composite, report, balls."""
    places = {"image": scene.canvas, "depth": scene.depth, "ball": scene.ball, "mask": scene.mask}
    return node("IterativeMedian").execute(**{**graph.sockets(), **places, **PAINTING, **ROUNDS, **changes}).args


# --- interrupted and queued again --------------------------------------------------------------------------------


def interrupted(node: Nodes, graph: Any, scene: Any, at: int) -> int:
    """Run until the user interrupts during the evaluation of picture `at`; pictures evaluated in all."""
    import comfy.model_management as host

    def stop(count: int, batch: int) -> None:
        if count >= at:
            host.interrupt_current_processing()

    with watched(graph, stop) as counted, pytest.raises(host.InterruptProcessingException):
        run(node, graph, scene)
    return counted.count


@pytest.mark.parametrize(("at", "finished"), [(4, 0), (12, 2), (28, 6), (34, 8)])
def test_it_goes_on_where_it_was_interrupted(node: Nodes, graph: Any, scene: Any, at: int, finished: int) -> None:
    """A batch is 2 balls, that is 4 pictures an evaluation and 8 in all; an interrupt costs the batch it falls into."""
    whole = run(node, graph, scene)
    assert whole[2].mean() > 0.01  # balls that differ, so that none can stand for another
    pack_module("nodes.painting").FINISHED.clear()
    # Nothing is evaluated after the interrupt.
    assert at <= interrupted(node, graph, scene, at) < at + 4
    with watched(graph) as counted:
        resumed = run(node, graph, scene)
    for ours, reference in zip(resumed[:4], whole[:4], strict=True):
        assert torch.equal(ours, reference)
    spent = RUN_COST - finished * BALL_COST
    assert counted.count == spent
    assert f"{spent} denoiser evaluations" in resumed[4]
    assert ("balls taken from an earlier run" in resumed[4]) == (finished > 0)


def test_progress_of_a_resumed_run_fills_the_bar(
    node: Nodes, graph: Any, scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import comfy.utils

    interrupted(node, graph, scene, at=28)
    calls: list[tuple[float, float]] = []
    monkeypatch.setattr(
        comfy.utils, "PROGRESS_BAR_HOOK", lambda value, total, preview, node_id=None: calls.append((value, total))
    )
    run(node, graph, scene)
    assert calls[-1] == (RUN_COST, RUN_COST)


@pytest.mark.parametrize("change", ["seed", "cfg", "sampler", "scheduler", "control_strength", "positive", "image"])
def test_what_changes_the_balls_is_painted_anew(node: Nodes, graph: Any, scene: Any, change: str) -> None:
    run(node, graph, scene, rounds=0)
    tokens, options = graph.positive[0]
    values = {"seed": 100, "cfg": 4.0, "sampler": "euler", "scheduler": "normal", "control_strength": 0.25}
    values |= {"positive": [[tokens * 1.01, options]], "image": scene.canvas * 0.99}
    report = run(node, graph, scene, rounds=0, **{change: values[change]})[4]
    assert f"; {BALL_COST} denoiser evaluations" in report
    # And what has not changed is found.
    assert "; 0 denoiser evaluations" in run(node, graph, scene, rounds=0)[4]


def test_a_patched_model_paints_anew(node: Nodes, graph: Any, scene: Any) -> None:
    """A clone shares its weights, and its patches' name, with the model it is of; only its options differ here."""
    run(node, graph, scene, rounds=0)
    patched = graph.model.clone()
    patched.set_model_sampler_cfg_function(lambda arguments: arguments["cond"])
    report = run(node, replace(graph, model=patched), scene, rounds=0)[4]
    assert f"; {BALL_COST} denoiser evaluations" in report


def test_more_balls_paint_only_the_ones_that_are_new(node: Nodes, graph: Any, scene: Any) -> None:
    rounds = {"rounds": 1, "final": False}
    run(node, graph, scene, **rounds)
    with watched(graph) as counted:
        more = run(node, graph, scene, balls=6, **rounds)
    assert counted.count == 2 * BALL_COST
    pack_module("nodes.painting").FINISHED.clear()
    assert torch.equal(more[1], run(node, graph, scene, balls=6, **rounds)[1])


# --- rounds that end when their median is settled ------------------------------------------------------------------

SETTLING = {"balls": 8, "min_balls": 4, "rounds": 1, "final": False}


def test_balls_asked_for_a_few_at_a_time_are_found_again(node: Nodes, graph: Any, scene: Any) -> None:
    """A tolerance out of reach asks for 4, 5, 6, 7, 8 balls; the interrupt falls into the sixth."""
    import comfy.model_management as host

    strict = {**SETTLING, "tolerance": 0.0001}
    whole = run(node, graph, scene, **strict)
    pack_module("nodes.painting").FINISHED.clear()

    def stop(count: int, batch: int) -> None:
        if count >= 5 * BALL_COST + 1:
            host.interrupt_current_processing()

    with watched(graph, stop), pytest.raises(host.InterruptProcessingException):
        run(node, graph, scene, **strict)
    with watched(graph) as counted:
        resumed = run(node, graph, scene, **strict)
    assert counted.count == 3 * BALL_COST
    for ours, reference in zip(resumed[:4], whole[:4], strict=True):
        assert torch.equal(ours, reference)
    assert "EV 0: up to 8 balls, 1 rounds" in resumed[4]
    assert "EV 0: 4 of 4 balls taken from an earlier run" in resumed[4]
    assert "round 1: not settled after 8 of at most 8 balls" in resumed[4]
    # And a run of so many balls without a tolerance has them all.
    with watched(graph) as counted:
        fixed = run(node, graph, scene, **{**SETTLING, "tolerance": 0.0})
    assert counted.count == 0
    if "left out" not in whole[4]:
        assert torch.equal(fixed[1], whole[1])


def test_progress_of_a_settled_run_fills_the_bar(
    node: Nodes, graph: Any, scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import comfy.utils

    calls: list[tuple[float, float]] = []
    monkeypatch.setattr(
        comfy.utils, "PROGRESS_BAR_HOOK", lambda value, total, preview, node_id=None: calls.append((value, total))
    )
    report = run(node, graph, scene, **{**SETTLING, "tolerance": 0.5})[4]
    assert "round 1: settled after 4 of at most 8 balls" in report
    assert calls[0] == (0, 8 * BALL_COST)
    assert calls[-1] == (4 * BALL_COST, 4 * BALL_COST)
    assert all(value <= total for value, total in calls)


# --- memory ------------------------------------------------------------------------------------------------------


def test_a_shortage_halves_the_batch_and_the_report_says_so(node: Nodes, graph: Any, scene: Any) -> None:
    def short_of_memory(count: int, batch: int) -> None:
        if batch > 4:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    whole = run(node, graph, scene)
    pack_module("nodes.painting").FINISHED.clear()
    with watched(graph, short_of_memory):
        answer = run(node, graph, scene, batch_size=4)
    # The same batches of two, once the first of four has failed.
    assert torch.equal(answer[0], whole[0])
    assert answer[4].count("EV 0: out of memory with 4 balls at once: went on with 2") == 1


def test_one_ball_that_does_not_fit_is_left_to_the_host(node: Nodes, graph: Any, scene: Any) -> None:
    """ComfyUI unloads its models on torch's own error and tells the user."""
    import comfy.model_management as host

    def no_memory(count: int, batch: int) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    with watched(graph, no_memory), pytest.raises(host.OOM_EXCEPTION):
        run(node, graph, scene)


@pytest.mark.parametrize("cfg", [1.0, 5.0])
@pytest.mark.parametrize(("fits", "size"), [(-3.0, 1), (0.5, 1), (1.5, 1), (3.5, 3), (400.0, 16)])
def test_the_batch_is_what_fits_in_free_memory(
    graph: Any, scene: Any, monkeypatch: pytest.MonkeyPatch, cfg: float, fits: float, size: int
) -> None:
    """Free: ComfyUI's reserve, the weights not yet loaded, and room for `fits` balls."""
    import comfy.model_management as host

    module = pack_module("nodes.painter")
    latent = graph.vae.encode(scene.canvas)
    each = graph.model.model.memory_required([1 if cfg == 1 else 2, *latent.shape[1:]])
    networks = [graph.model, *graph.control_net.get_models()]
    unloaded = sum(network.model_size() - network.loaded_size() for network in networks)
    free = host.minimum_inference_memory() + unloaded + fits * each
    monkeypatch.setattr(host, "get_free_memory", lambda device: free)
    painter = module.ComfyPainter(module.Networks(**graph.sockets()), module.Guidance(cfg=cfg))
    assert painter._room(latent) == size


def test_an_automatic_batch_paints_the_same_balls(node: Nodes, graph: Any, scene: Any) -> None:
    one = run(node, graph, scene)
    pack_module("nodes.painting").FINISHED.clear()
    # Order of summation in batched matrix products.
    torch.testing.assert_close(run(node, graph, scene, batch_size=0)[1], one[1], rtol=0, atol=1e-5)


def peak_bytes(action: Callable[[], Any]) -> int:
    """Most that torch held at once on the CPU of what it took during an action."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
        action()
    held = peak = 0
    for event in profiled.profiler.kineto_results.events():
        if event.name() == "[memory]":
            held += event.nbytes()
            peak = max(peak, held)
    return peak


def test_memory_grows_by_the_balls_alone(node: Nodes, graph: Any) -> None:
    """A small ball on a large canvas: 12 canvases kept would be 2.4 MB more, 12 balls are 37 kB in each place."""
    place = {"canvas": 128, "diameter": 16, "x": -1, "y": -1, "dilation": -1}
    canvas, depth, mask, ball = node("DepthBallMask").execute(torch.rand(1, 96, 128, 3), **place).args
    sockets = {**graph.sockets(), "image": canvas, "depth": depth, "mask": mask, "ball": ball}
    options = {**PAINTING, **ROUNDS, "sampler": "euler", "cfg": 1.0, "rounds": 1, "final": False}

    def paint(balls: int) -> int:
        return peak_bytes(lambda: node("IterativeMedian").execute(**{**sockets, **options, "balls": balls}))

    paint(4)  # weights are loaded once
    pack_module("nodes.painting").FINISHED.clear()
    few, many = (paint(balls) for balls in (4, 16))
    # In a request's list, in the store, in the picture shown, and in the answer.
    assert many - few <= 4 * 12 * 16 * 16 * 3 * 4


# --- few steps ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sampler", "scheduler"), [("euler", "sgm_uniform"), ("dpmpp_2m", "simple"), ("uni_pc", "leading (paper)")]
)
def test_distilled_models_run_on_few_steps_without_guidance(
    node: Nodes, graph: Any, scene: Any, sampler: str, scheduler: str
) -> None:
    """LCM, Lightning and Hyper LoRAs ask for no more than 4 steps at cfg 1 on a schedule of their own."""
    options = {"sampler": sampler, "scheduler": scheduler, "steps": 4, "cfg": 1.0, "strength": 0.75}
    with watched(graph) as counted:
        ball, _, _, _, report, *_ = run(node, graph, scene, **options)
    cost = 4 * 4 + 4 * 3 + 3
    assert counted.count == cost
    assert f"{cost} denoiser evaluations" in report
    assert torch.isfinite(ball).all()


# --- the mask ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [{}, {"diameter": 23, "x": 25, "y": 40}, {"diameter": 50, "dilation": 3}])
def test_the_sampler_sees_the_latent_mask_of_the_authors(node: Nodes, graph: Any, place: dict[str, int]) -> None:
    """The grown disc reduced bilinearly, as the diffusers path has it: what ComfyUI makes of the node's mask."""
    sizes = {"canvas": 64, "diameter": 32, "x": -1, "y": -1, "dilation": -1} | place
    canvas, depth, mask, ball = node("DepthBallMask").execute(torch.rand(1, 64, 64, 3), **sizes).args
    seen: list[torch.Tensor] = []

    def watch(sigma: Any, denoise_mask: torch.Tensor, extra_options: Any) -> torch.Tensor:
        seen.append(denoise_mask.clone())
        return denoise_mask

    model = graph.model.clone()
    model.set_model_denoise_mask_function(watch)
    sockets = {**replace(graph, model=model).sockets(), "image": canvas, "depth": depth, "mask": mask, "ball": ball}
    node("ChromeBallInpaint").execute(count=2, strength=1.0, **{**PAINTING, **sockets})
    wanted = pack_module("dl_core.backends.diffusers_painter").ball_latent_mask(ball)
    assert len(seen) == PAINTING["steps"]
    assert all(torch.equal(item, wanted.expand(2, 4, -1, -1)) for item in seen)
    # Nearly binary: a cell is the mean of its middle four pixels.
    assert set(wanted.unique().tolist()) <= {0.0, 0.25, 0.5, 0.75, 1.0}
