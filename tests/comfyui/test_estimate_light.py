"""EstimateLight: the graph of single nodes to the bit, at the cost planned, and refusals that name a socket."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from comfy_host import pack_module
from counted_network import watched

PROMPTS = {"prompt": "a chrome ball", "dark_prompt": "a dark chrome ball"}
EVS = {"evs": "0, -2.5, -5", "ev_min": -5.0}
ROUNDS = {"preset": "custom", "balls": 3, "rounds": 2, "strength": 1.0, "final": True}
SAMPLING = {
    "seed": 4,
    "steps": 2,
    "cfg": 5.0,
    "sampler": "uni_pc",
    "scheduler": "leading (paper)",
    "control_strength": 1.0,
    "batch_size": 2,
}
PLACE = {"canvas": 64, "diameter": 32, "x": -1, "y": -1}
COST = 3 * (3 + 3 + 1) * 2 * 2
"""Denoiser evaluations: exposures, balls of all rounds, steps, with and without the prompt."""
COARSE = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(1))
PHOTO = torch.nn.functional.interpolate(COARSE, (48, 64), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)
DEPTH = torch.linspace(0, 1, 64).expand(1, 48, -1)[..., None].expand(-1, -1, -1, 3)

Nodes = Callable[[str], Any]


@pytest.fixture(scope="module")
def graph(heeding_graph: Any) -> Any:
    return heeding_graph


def forget() -> None:
    pack_module("nodes.painting").FINISHED.clear()


def whole(node: Nodes, graph: Any, **changes: Any) -> Any:
    """Outputs of EstimateLight: latlong, hdr, composite, balls, ball, report, confidence."""
    networks = {name: getattr(graph, name) for name in ("model", "clip", "vae", "control_net")}
    options = {**PROMPTS, "negative_prompt": "matte", **EVS, **ROUNDS, **SAMPLING, **PLACE, "height": 32}
    return node("EstimateLight").execute(**{**networks, "image": PHOTO, "merge": "robust", **options, **changes}).args


def single_nodes(
    node: Nodes,
    graph: Any,
    merge: str = "robust",
    depth: Any = None,
    depth_model: Any = None,
    rounds: dict[str, Any] = ROUNDS,
    **place: Any,
) -> Any:
    """The same of the single nodes, wired as in the workflows."""
    canvas, control, mask, ball = (
        node("DepthBallMask").execute(PHOTO, depth=depth, **{**PLACE, "dilation": -1, **place}).args
    )
    lora = {"lora": "none", "lora_scale": 0.75}
    model, positives, evs = (
        node("EVPromptInterp").execute(clip=graph.clip, model=graph.model, **PROMPTS, **EVS, **lora).args
    )
    networks = {"model": model, "vae": graph.vae, "control_net": graph.control_net}
    networks["negative"] = graph.clip.encode_from_tokens_scheduled(graph.clip.tokenize("matte"))
    places = {"image": canvas, "depth": control, "mask": mask, "ball": ball, "depth_model": depth_model}
    painted = [
        node("IterativeMedian").execute(positive=positive, ev=ev, **networks, **places, **rounds, **SAMPLING).args
        for positive, ev in zip(positives, evs, strict=True)
    ]
    balls, reports = [item[0] for item in painted], [item[4] for item in painted]
    lights = [item[6] for item in painted]
    hdr, report = node("HDRMerge").execute(balls, evs, [merge], [2.4], reports, lights).args
    latlong, _ = node("BallToEquirect").execute(hdr, height=32, yaw=0.0, samples=1).args
    trusted, _, _, line = node("ConfidenceMap").execute([item[5] for item in painted], evs, [latlong]).args
    return latlong, hdr, painted[0][3], torch.cat(balls), ball, report, trusted, line


def without_times(report: str) -> str:
    return re.sub(r"in \d+\.\d s", "in some time", report)


def darkness(canvas: torch.Tensor) -> torch.Tensor:
    """Stands in for a depth model."""
    return 1 - canvas.mean(dim=-1, keepdim=True)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"depth": DEPTH, "merge": "paper"},
        {"x": 20, "y": 40, "diameter": 23, "merge": "channel"},
        {"depth": DEPTH, "depth_model": darkness},
        {"depth_disc": "authors"},
    ],
    ids=["plain", "depth", "place", "depth model", "depth disc"],
)
def test_pictures_are_those_of_the_single_nodes(node: Nodes, graph: Any, changes: dict[str, Any]) -> None:
    with watched(graph) as counted:
        ours = whole(node, graph, **changes)
    assert counted.count == COST
    forget()
    with watched(graph) as counted:
        theirs = single_nodes(node, graph, **changes)
    assert counted.count == COST
    for one, other in zip(ours[:4], theirs[:4], strict=True):
        assert torch.equal(one, other)
    assert ours[4] == theirs[4]
    assert theirs[7] in ours[5].splitlines()
    assert without_times(ours[5].replace(theirs[7] + "\n", "")) == without_times(theirs[5])
    assert torch.equal(ours[6], theirs[6])
    # Equal pictures say nothing unless they differ from each other and from the photograph's.
    balls = ours[3]
    assert all((a - b).abs().max() > 1e-3 for a, b in ((balls[0], balls[1]), (balls[1], balls[2])))


def test_lights_are_given_back_as_by_the_single_nodes(node: Nodes, graph: Any) -> None:
    rounds = {**ROUNDS, "rounds": 1, "final": False, "light_balls": 2}
    ours = whole(node, graph, **rounds)
    forget()
    theirs = single_nodes(node, graph, rounds=rounds)
    for one, other in zip(ours[:4], theirs[:4], strict=True):
        assert torch.equal(one, other)
    assert "2 light balls" in ours[5]
    dull = whole(node, graph, **(rounds | {"light_balls": 0}))
    assert (ours[1] >= dull[1]).all()
    assert (ours[1] > dull[1]).any()


def test_it_takes_the_balls_that_the_single_nodes_painted(node: Nodes, graph: Any) -> None:
    """They ask for the same balls, by all that decides one: whoever paints second finds them."""
    theirs = single_nodes(node, graph, depth=DEPTH)
    with watched(graph) as counted:
        ours = whole(node, graph, depth=DEPTH)
    assert counted.count == 0
    assert torch.equal(ours[0], theirs[0])
    assert ours[5].count("3 of 3 balls taken from an earlier run") == 6


def test_depth_of_a_model_alone_is_that_of_the_canvas(node: Nodes, graph: Any) -> None:
    seen: list[torch.Tensor] = []

    def depth_model(canvas: torch.Tensor) -> torch.Tensor:
        seen.append(canvas)
        return darkness(canvas)

    alone = whole(node, graph, depth_model=depth_model)
    canvas = node("DepthBallMask").execute(PHOTO, **PLACE, dilation=-1).args[0]
    assert torch.equal(seen[0], canvas)
    assert len(seen) == 1 + 3 * 2  # and every median of every exposure
    assert not torch.equal(alone[0], whole(node, graph)[0])
    assert not torch.equal(alone[0], whole(node, graph, depth=darkness(PHOTO))[0])


def test_progress_runs_over_all_exposures(node: Nodes, graph: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import comfy.utils

    calls: list[tuple[float, float, Any]] = []
    monkeypatch.setattr(
        comfy.utils,
        "PROGRESS_BAR_HOOK",
        lambda value, total, preview, node_id=None: calls.append((value, total, preview)),
    )
    whole(node, graph)
    assert {total for _, total, _ in calls} == {COST}
    values = [value for value, _, _ in calls]
    assert values == sorted(values)
    assert set(values) >= {0, COST}
    # After every batch of two balls, and the median after each round: each exposure shows its own.
    previews = [preview[1] for _, _, preview in calls if preview]
    assert len(previews) == 3 * (2 + 1 + 2 + 1 + 1)
    assert all(preview.size == (32, 32) for preview in previews)


@pytest.mark.parametrize(("at", "finished"), [(4, 0), (COST // 3 + 10, 7 + 2), (COST - 2, 20)])
def test_it_goes_on_where_it_was_interrupted(node: Nodes, graph: Any, at: int, finished: int) -> None:
    """Batches are of two balls; at the second place one batch and half of the third ball of EV -2.5 are painted."""
    import comfy.model_management as host

    reference = whole(node, graph)
    forget()

    def stop(count: int, batch: int) -> None:
        if count >= at:
            host.interrupt_current_processing()

    with watched(graph, stop) as counted, pytest.raises(host.InterruptProcessingException):
        whole(node, graph)
    assert at <= counted.count < at + 4
    with watched(graph) as counted:
        resumed = whole(node, graph)
    assert counted.count == COST - finished * 4
    for ours, theirs in zip(resumed[:4], reference[:4], strict=True):
        assert torch.equal(ours, theirs)


def test_prompts_are_encoded_once_whatever_the_exposures(node: Nodes, graph: Any) -> None:
    encoded: list[str] = []

    class Listening:
        def tokenize(self, text: str) -> Any:
            encoded.append(text)
            return graph.clip.tokenize(text)

        def encode_from_tokens_scheduled(self, tokens: Any) -> Any:
            return graph.clip.encode_from_tokens_scheduled(tokens)

    rounds = {"balls": 1, "rounds": 0}
    balls = whole(node, graph, clip=Listening(), evs="0, -1, -2, -3, -5", **rounds)[3]
    assert encoded == [*PROMPTS.values(), "matte"]
    # Each exposure lies between the two originals, whatever the others are: alone it is the same.
    forget()
    assert torch.equal(whole(node, graph, evs="0, -3", **rounds)[3], balls[[0, 3]])


@pytest.mark.parametrize("preset", ["draft", "turbo"])
def test_a_preset_replaces_the_values_below_it(node: Nodes, graph: Any, preset: str) -> None:
    chosen = pack_module("dl_core.presets").PRESETS[preset]
    with watched(graph) as counted:
        report = whole(node, graph, preset=preset, balls=99, steps=99, cfg=1.0)[5]
    assert counted.count == chosen.guided_steps
    rounds = chosen.rounds
    assert report.count(f"{rounds.balls} balls, {rounds.rounds} rounds, {rounds.steps} steps") == 3


@pytest.mark.parametrize(("preset", "disc"), [("draft", "ball"), ("turbo", "authors")])
def test_the_disc_on_the_depth_is_the_presets_unless_chosen(node: Nodes, graph: Any, preset: str, disc: str) -> None:
    def balls(**choice: str) -> torch.Tensor:
        return whole(node, graph, preset=preset, evs="0", cfg=1.0, **choice)[3]

    found = {name: balls(depth_disc=name) for name in ("ball", "authors")}
    assert not torch.equal(found["ball"], found["authors"])
    assert torch.equal(balls(), found[disc])
    assert torch.equal(balls(depth_disc="by preset"), found[disc])


def test_every_preset_is_on_offer(node: Nodes) -> None:
    (combo,) = [item for item in node("EstimateLight").define_schema().inputs if item.id == "preset"]
    assert combo.options == ["custom", *pack_module("dl_core.presets").PRESETS]


def test_a_budget_replaces_the_preset_and_leaves_nothing_behind(
    node: Nodes, graph: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    presets = pack_module("dl_core.presets").PRESETS
    draft = replace(presets["draft"], error_deg=3.0)
    dear = replace(presets["paper"], error_deg=2.0, rounds=replace(presets["paper"].rounds, balls=1000, steps=998))
    monkeypatch.setattr(pack_module("dl_core.presets"), "PRESETS", {"draft": draft, "paper": dear})
    forget()
    whole(node, graph, preset="draft", cfg=1.0)
    kept = pack_module("nodes.painting").FINISHED.bytes_held
    report = whole(node, graph, budget=600.0, cfg=1.0)[5]
    assert report.startswith("budget 600 s: preset draft, ")
    assert report.count(f"{draft.rounds.balls} balls, {draft.rounds.rounds} rounds") == 3
    assert pack_module("nodes.painting").FINISHED.bytes_held == kept
    with pytest.raises(pack_module("dl_core.errors").OptionError, match=r"budget.*cheapest preset, draft"):
        whole(node, graph, budget=1e-6, cfg=1.0)


@pytest.mark.parametrize("ev_min", [-5.0, -7.5])
def test_a_bracket_sized_to_the_scene_takes_the_fixed_ones_balls(node: Nodes, graph: Any, ev_min: float) -> None:
    """As many exposures of the ladder down to EV min as clip, each the very one of a fixed bracket."""
    ladder = [0.0, -2.5, -5.0, -7.5][: int(-ev_min / 2.5) + 1]
    fixed = whole(node, graph, evs=", ".join(map(str, ladder)), ev_min=ev_min)
    with watched(graph) as counted:
        sized = whole(node, graph, ev_min=ev_min, bracket="scene")
    assert counted.count == 0
    count = len(sized[3])
    assert torch.equal(sized[3], fixed[3][:count])
    clipped = [bool((ball**2.4 >= 0.9).any()) for ball in fixed[3]]
    expected = next((i + 1 for i, clips in enumerate(clipped) if not clips), len(ladder))
    assert count <= expected
    assert f"bracket sized to the scene: {count} exposures" in sized[5]
    if not clipped[0]:
        assert torch.equal(sized[0], fixed[0])


def test_progress_of_a_sized_bracket_ends(node: Nodes, graph: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import comfy.utils

    calls: list[tuple[float, float]] = []
    monkeypatch.setattr(
        comfy.utils, "PROGRESS_BAR_HOOK", lambda value, total, preview, node_id=None: calls.append((value, total))
    )
    sized = whole(node, graph, bracket="scene")
    assert calls[0] == (0, COST)
    done = len(sized[3]) * COST // 3
    assert calls[-1] == (done, done)


def narrow_clip(graph: Any) -> Any:
    """Text encoders of another model."""

    class Narrow:
        def tokenize(self, text: str) -> str:
            return text

        def encode_from_tokens_scheduled(self, tokens: str) -> Any:
            return [[torch.zeros(1, 77, 32), {"pooled_output": torch.zeros(1, 32)}]]

    return Narrow()


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"image": PHOTO.expand(2, -1, -1, -1)}, "ImageError", "^image: holds 2 pictures; one is accepted"),
        ({"image": PHOTO * 3}, "ImageError", r"^image: holds values from .* display values in \[0, 1\]"),
        ({"image": PHOTO[..., :2]}, "ImageError", "^image: has shape"),
        ({"depth": DEPTH * math.nan}, "ImageError", "^depth: holds NaN"),
        ({"depth": DEPTH.expand(3, -1, -1, -1)}, "ImageError", "^depth: holds 3 pictures"),
        ({"evs": "0, dark"}, "OptionError", "^evs is '0, dark'"),
        ({"evs": "0, -6"}, "OptionError", "^evs is .*down to ev_min, -5"),
        ({"x": 5}, "OptionError", "^x is 5; accepted: 16 to 48"),
        ({"y": 60}, "OptionError", "^y is 60; accepted: 16 to 48"),
        ({"diameter": 65}, "OptionError", "^diameter is 65"),
        ({"canvas": 100}, "OptionError", "^canvas is 100"),
        ({"height": 1}, "OptionError", "^height is 1"),
        ({"bracket": "long"}, "OptionError", "^bracket is 'long'; accepted: fixed, scene"),
        ({"tolerance": 1.5}, "OptionError", "^tolerance is 1.5"),
        ({"tolerance": 0.1, "min_balls": 1}, "OptionError", "^min_balls is 1"),
        ({"merge": "guess"}, "OptionError", "^merge is 'guess'; accepted: robust, channel, paper"),
        ({"preset": "quick"}, "OptionError", "^preset is 'quick'; accepted: draft"),
        ({"balls": 0}, "OptionError", "^balls is 0"),
        ({"depth_disc": "square"}, "OptionError", "^depth_disc is 'square'; accepted: ball, authors"),
        ({"impute": "none"}, "OptionError", "^impute is 'none'; accepted: initial, predicted"),
        ({"sampler": "dpmpp_sde"}, "OptionError", "^sampler is 'dpmpp_sde'"),
        ({"clip": None}, "ModelError", "^socket clip: holds no text encoders"),
        ({"clip": "narrow"}, "ModelError", "^socket clip: holds embeddings 32 wide; the model takes 64"),
        ({"vae": object()}, "ModelError", "^socket vae: holds a VAE of None latent channels"),
        ({"control_net": object()}, "ModelError", "^socket control_net: holds object"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name_before_anything_is_painted(
    node: Nodes, graph: Any, change: dict[str, Any], kind: str, message: str
) -> None:
    if change.get("clip") == "narrow":
        change = {"clip": narrow_clip(graph)}
    with watched(graph) as counted, pytest.raises(getattr(pack_module("dl_core.errors"), kind), match=message):
        whole(node, graph, **change)
    assert counted.count == 0


def test_a_model_of_another_kind_is_refused_by_socket(node: Nodes, graph: Any) -> None:
    class Sd15:
        model = torch.nn.Identity()

    with pytest.raises(pack_module("dl_core.errors").ModelError, match=r"^socket model: holds Identity"):
        whole(node, replace(graph, model=Sd15()))


def test_the_front_is_that_of_the_single_node_and_the_horizon_is_level(node: Nodes, graph: Any) -> None:
    once = {"preset": "custom", "balls": 1, "rounds": 0, "evs": "0"}
    plain, *_ = whole(node, graph, **once)
    mended, *_, report, _ = whole(node, graph, **once, front_fill=True, fov=70.0, pitch=15.0)
    filled, _ = node("FrontFill").execute(plain, PHOTO, 70.0).args
    assert torch.equal(mended, pack_module("dl_core.mending").level(filled, 15.0, 0.0))
    assert "70 degrees" in report
    assert "pitch 15" in report
