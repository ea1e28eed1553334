"""What the nodes compute and pass on, and what they say about input they cannot use."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from comfy_host import pack_module

PROMPTS = {"prompt": "a chrome ball", "dark_prompt": "a dark chrome ball"}
STEERING = {**PROMPTS, "evs": "0, -2.5, -5", "ev_min": -5.0, "lora": "none", "lora_scale": 0.75}
PAINTING = {
    "seed": 0,
    "steps": 2,
    "cfg": 5.0,
    "sampler": "uni_pc",
    "scheduler": "leading (paper)",
    "control_strength": 0.5,
    "batch_size": 4,
}
ROUNDS = {"preset": "custom", "balls": 3, "rounds": 2, "strength": 1.0, "final": True}

Nodes = Callable[[str], Any]


def errors() -> Any:
    return pack_module("dl_core.errors")


# --- DepthBallMask -----------------------------------------------------------------------------------------------


def test_ball_is_placed_and_painted(node: Nodes) -> None:
    photo = torch.full((1, 100, 200, 3), 0.5)
    place = {"canvas": 256, "diameter": 64, "x": 100, "y": 140, "dilation": 5}
    canvas, depth, mask, ball = node("DepthBallMask").execute(photo, **place).args
    assert (ball.left, ball.top, ball.diameter, ball.canvas, ball.dilation) == (68, 108, 64, 256, 5)
    assert canvas.shape == depth.shape == (1, 256, 256, 3)
    assert canvas[0, 0].max() == 0  # the bar above
    assert depth[0, 140, 100].min() == 1
    assert depth[0, 10, 10].max() == 0
    assert mask.sum() == pytest.approx(math.pi * 37**2, rel=0.01)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_grey_and_transparent_photographs_work(node: Nodes, channels: int) -> None:
    photo = torch.rand(1, 10, 20, channels)
    place = {"canvas": 64, "diameter": 16, "x": -1, "y": -1, "dilation": -1}
    assert node("DepthBallMask").execute(photo, **place).args[0].shape == (1, 64, 64, 3)


@pytest.mark.parametrize("size", [(1, 1), (1, 4000), (4000, 1)])
def test_odd_sizes_work(node: Nodes, size: tuple[int, int]) -> None:
    place = {"canvas": 64, "diameter": 16, "x": -1, "y": -1, "dilation": -1}
    assert node("DepthBallMask").execute(torch.rand(1, *size, 3), **place).args[0].shape == (1, 64, 64, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"diameter": 300}, r"diameter is 300.*16 to 256"),
        ({"x": 10}, r"x is 10.*32 to 224"),
        ({"y": 250}, r"y is 250.*32 to 224"),
        ({"canvas": 100}, r"canvas is 100.*multiple of 8"),
        ({"canvas": 56}, r"canvas is 56.*at least 64"),
        ({"dilation": 200}, r"dilation is 200.*0 to 128"),
    ],
)
def test_ball_that_does_not_fit_is_refused(node: Nodes, change: dict[str, int], message: str) -> None:
    place = {"canvas": 256, "diameter": 64, "x": -1, "y": -1, "dilation": -1} | change
    with pytest.raises(errors().OptionError, match=message):
        node("DepthBallMask").execute(torch.rand(1, 20, 20, 3), **place)


@pytest.mark.parametrize(
    ("photo", "message"),
    [
        (torch.full((1, 8, 8, 3), float("nan")), "photograph: holds NaN"),
        (torch.full((1, 8, 8, 3), -0.5), r"photograph: holds values from -0\.5"),
        (torch.full((1, 8, 8, 3), 2.0), "photograph: holds values from 2"),
        (torch.rand(2, 8, 8, 3), "photograph: has shape"),
        (torch.rand(1, 8, 8, 2), "image: has shape"),
    ],
)
def test_photograph_that_cannot_be_used_is_refused(node: Nodes, photo: torch.Tensor, message: str) -> None:
    place = {"canvas": 64, "diameter": 16, "x": -1, "y": -1, "dilation": -1}
    with pytest.raises(errors().ImageError, match=message):
        node("DepthBallMask").execute(photo, **place)


def test_depth_with_nan_is_refused(node: Nodes) -> None:
    place = {"canvas": 64, "diameter": 16, "x": -1, "y": -1, "dilation": -1}
    with pytest.raises(errors().ImageError, match="depth: holds NaN"):
        node("DepthBallMask").execute(torch.rand(1, 8, 8, 3), depth=torch.full((1, 8, 8, 3), math.nan), **place)


# --- CanvasToImage -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_canvas_comes_back_at_the_photographs_size(node: Nodes, channels: int) -> None:
    photo = torch.rand(1, 50, 90, channels)
    place = {"canvas": 64, "diameter": 20, "x": 40, "y": 30, "dilation": -1}
    canvas, _, _, ball = node("DepthBallMask").execute(photo, **place).args
    composite = pack_module("dl_core.ball").paste_ball(canvas, torch.ones(1, 20, 20, 3), ball).expand(2, -1, -1, -1)
    pasted, framed, mask = node("CanvasToImage").execute(composite, photo, ball).args
    assert pasted.shape == framed.shape == (2, 50, 90, 3)
    assert mask.shape == (1, 50, 90)
    own = photo.expand(-1, -1, -1, 3) if channels == 1 else photo[..., :3]
    assert torch.equal(pasted[0][mask[0] == 0], own[0][mask[0] == 0])
    # The ball's centre, in pixels of the photograph.
    assert pasted[:, round((30 - 14) * 90 / 64), round(40 * 90 / 64)].min() == 1


def test_canvas_of_another_ball_is_refused(node: Nodes) -> None:
    ball = pack_module("dl_core.ball").place_ball(64, 20)
    with pytest.raises(errors().ImageError, match=r"is 32 x 32 pixels.*64 x 64"):
        node("CanvasToImage").execute(torch.rand(1, 32, 32, 3), torch.rand(1, 8, 8, 3), ball)


# --- EVPromptInterp ----------------------------------------------------------------------------------------------


def test_each_ev_lies_between_the_two_original_embeddings(node: Nodes, graph: Any) -> None:
    """Tokens and pooled: e = o + (ev / ev_min)(d - o), never from an embedding already interpolated."""
    output = node("EVPromptInterp").execute(clip=graph.clip, model=graph.model, **STEERING)
    model, positive, evs = output.args
    assert model is graph.model
    assert evs == [0.0, -2.5, -5.0]
    original, dark = (
        graph.clip.encode_from_tokens(graph.clip.tokenize(text), return_pooled=True) for text in PROMPTS.values()
    )
    for ev, ((tokens, options),) in zip(evs, positive, strict=True):
        weight = ev / -5.0
        torch.testing.assert_close(tokens, original[0] + weight * (dark[0] - original[0]))
        torch.testing.assert_close(options["pooled_output"], original[1] + weight * (dark[1] - original[1]))
    # At both ends they are the originals to the bit, and so is every EV whatever the others are.
    for end, (tokens, pooled) in ((positive[0], original), (positive[-1], dark)):
        assert torch.equal(end[0][0], tokens)
        assert torch.equal(end[0][1]["pooled_output"], pooled)
    alone = node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"evs": "0, -1, -2.5"})).args[1][-1]
    assert torch.equal(alone[0][0], positive[1][0][0])
    assert torch.equal(alone[0][1]["pooled_output"], positive[1][0][1]["pooled_output"])


def test_both_encoders_share_the_weight(node: Nodes, graph: Any) -> None:
    """The first half of a token's embedding is the first encoder's, the second half the second's."""
    _, positive, _ = node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"evs": "0, -2, -5"})).args
    first, between, last = (item[0][0] for item in positive)
    for half in (slice(0, 32), slice(32, 64)):
        step, whole = (between - first)[..., half], (last - first)[..., half]
        assert whole.abs().max() > 1e-2
        torch.testing.assert_close(step, 0.4 * whole, rtol=0, atol=1e-6)  # differences of numbers of order 1


def test_weights_stand_in_for_the_evs(node: Nodes, graph: Any) -> None:
    """They may leave the line of EV / EV min, and EVs below EV min are theirs to place."""
    steering = STEERING | {"evs": "0, -2, -8", "weights": "0, 0.9, 1"}
    _, positive, evs = node("EVPromptInterp").execute(clip=graph.clip, **steering).args
    assert evs == [0.0, -2.0, -8.0]
    (first, middle, last) = ((item[0][0], item[0][1]["pooled_output"]) for item in positive)
    for part in (0, 1):
        torch.testing.assert_close(middle[part], 0.1 * first[part] + 0.9 * last[part], rtol=0, atol=1e-6)
    dark, _ = graph.clip.encode_from_tokens(graph.clip.tokenize(PROMPTS["dark_prompt"]), return_pooled=True)
    assert torch.equal(last[0], dark)


@pytest.mark.parametrize("weights", ["0, 1", "0, 0.5, 1.5", "-0.1, 0, 1", "0, nan, 1", "0, 0.5, 1, 1"])
def test_weights_that_do_not_fit_the_evs_are_refused(node: Nodes, graph: Any, weights: str) -> None:
    with pytest.raises(errors().OptionError, match=r"weights is .*one number from 0 to 1 per EV, that is 3"):
        node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"weights": weights}))


def test_weights_that_are_no_numbers_are_refused(node: Nodes, graph: Any) -> None:
    with pytest.raises(errors().OptionError, match=r"weights is '0, dark'.*numbers between commas, such as 0, 0\.5"):
        node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"weights": "0, dark"}))


def test_conditionings_stand_in_for_the_prompts(node: Nodes, graph: Any) -> None:
    """Of any node that encodes: with the same prompts the outcome is the same, and no text encoder is needed."""
    original, dark = (graph.clip.encode_from_tokens_scheduled(graph.clip.tokenize(text)) for text in PROMPTS.values())
    from_prompts = node("EVPromptInterp").execute(clip=graph.clip, **STEERING).args[1]
    from_both = node("EVPromptInterp").execute(original=original, dark=dark, **STEERING).args[1]
    mixed = node("EVPromptInterp").execute(clip=graph.clip, dark=dark, **STEERING).args[1]
    for expected, *found in zip(from_prompts, from_both, mixed, strict=True):
        for item in found:
            assert torch.equal(item[0][0], expected[0][0])
            assert torch.equal(item[0][1]["pooled_output"], expected[0][1]["pooled_output"])


def test_conditionings_that_cannot_be_interpolated_are_refused(node: Nodes, graph: Any) -> None:
    run = node("EVPromptInterp").execute
    whole = [[torch.zeros(1, 77, 64), {"pooled_output": torch.zeros(1, 32)}]]
    with pytest.raises(errors().ModelError, match=r"socket clip: is not connected; .*original and dark"):
        run(original=whole, **STEERING)
    with pytest.raises(errors().ModelError, match="conditionings: hold no pooled embeddings"):
        run(original=whole, dark=[[torch.zeros(1, 77, 64), {"pooled_output": None}]], **STEERING)
    with pytest.raises(errors().ModelError, match="conditionings: are 64 and 768 wide"):
        run(original=whole, dark=[[torch.zeros(1, 77, 768), {"pooled_output": torch.zeros(1, 32)}]], **STEERING)
    with pytest.raises(errors().OptionError, match="dark_prompt is '2 conditionings'"):
        run(original=whole, dark=whole * 2, **STEERING)


def test_prompts_of_different_lengths_are_interpolated(node: Nodes, graph: Any) -> None:
    steering = STEERING | {"prompt": "ball " * 100}
    _, positive, _ = node("EVPromptInterp").execute(clip=graph.clip, **steering).args
    assert {item[0][0].shape for item in positive} == {(1, 154, 64)}
    dark = graph.clip.encode_from_tokens(graph.clip.tokenize(PROMPTS["dark_prompt"]))
    torch.testing.assert_close(positive[-1][0][0], dark.repeat(1, 2, 1))


@pytest.mark.parametrize("evs", ["", "-2.5, -5", "0, -5, -2.5", "0, 0", "0, 2"])
def test_evs_that_do_not_descend_from_0_are_refused(node: Nodes, graph: Any, evs: str) -> None:
    with pytest.raises(errors().OptionError, match=r"evs is .*strictly descending EVs that start at 0"):
        node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"evs": evs}))


def test_evs_that_are_no_numbers_are_refused(node: Nodes, graph: Any) -> None:
    with pytest.raises(errors().OptionError, match=r"evs is '0, dark'.*numbers between commas"):
        node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"evs": "0, dark"}))


def test_evs_below_the_dark_prompt_are_refused(node: Nodes, graph: Any) -> None:
    with pytest.raises(errors().OptionError, match=r"evs is .*down to ev_min, -5"):
        node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"evs": "0, -6"}))


def test_lora_without_a_model_is_refused(node: Nodes, graph: Any) -> None:
    with pytest.raises(errors().ModelError, match="socket model: is not connected"):
        node("EVPromptInterp").execute(clip=graph.clip, **(STEERING | {"lora": "some.safetensors"}))


# --- painting ----------------------------------------------------------------------------------------------------


def inputs(graph: Any, scene: Any, **changes: Any) -> dict[str, Any]:
    places = {"image": scene.canvas, "depth": scene.depth, "ball": scene.ball, "mask": scene.mask}
    return {**graph.sockets(), **places, **PAINTING, **changes}


def test_balls_are_painted_and_pasted(node: Nodes, graph: Any, scene: Any) -> None:
    output = node("ChromeBallInpaint").execute(count=2, strength=1.0, **inputs(graph, scene))
    balls, composite, evaluations = output.args
    assert balls.shape == (2, 32, 32, 3)
    assert composite.shape == (2, 64, 64, 3)
    assert evaluations == 2 * 2 * 2
    torch.testing.assert_close(composite[:, 32, 32], balls[:, 16, 16])
    assert torch.equal(composite[0, 0], scene.canvas[0, 0])


def test_iterative_median_is_algorithm_1(node: Nodes, graph: Any, scene: Any) -> None:
    output = node("IterativeMedian").execute(ev=-2.5, **ROUNDS, **inputs(graph, scene))
    ball, median, spread, composite, report, balls, light_balls = output.args
    assert torch.equal(light_balls, ball)
    assert torch.equal(pack_module("dl_core.median").pixelwise_median(balls), median)
    assert ball.shape == median.shape == spread.shape == (1, 32, 32, 3)
    assert (spread >= 0).all()
    assert spread.max() > 0
    assert composite.shape == scene.canvas.shape
    assert "EV -2.5" in report
    assert f"{(3 + 3 + 1) * 2 * 2} denoiser evaluations" in report


def test_median_of_one_round_is_the_median_of_its_balls(node: Nodes, graph: Any, scene: Any) -> None:
    common = inputs(graph, scene, steps=2)
    rounds = ROUNDS | {"rounds": 1, "final": False}
    answer = node("IterativeMedian").execute(**rounds, **common).args[0]
    balls = node("ChromeBallInpaint").execute(count=3, strength=1.0, **common).args[0]
    torch.testing.assert_close(answer[0], balls.median(dim=0).values)


def test_preset_replaces_the_values_below_it(node: Nodes, graph: Any, scene: Any) -> None:
    rounds = ROUNDS | {"preset": "draft", "balls": 99}
    report = node("IterativeMedian").execute(**rounds, **inputs(graph, scene, steps=99)).args[4]
    draft = pack_module("dl_core.presets").PRESETS["draft"].rounds
    assert f"{draft.balls} balls, {draft.rounds} rounds, {draft.steps} steps" in report


def test_mask_decides_where_is_painted(node: Nodes, graph: Any, scene: Any) -> None:
    """Nothing masked: the ball's place decodes to the photograph's own latent."""
    nothing = torch.zeros_like(scene.mask)
    output = node("ChromeBallInpaint").execute(count=1, strength=1.0, **inputs(graph, scene, mask=nothing))
    decoded = graph.vae.decode(graph.vae.encode(scene.canvas))
    torch.testing.assert_close(output.args[0], decoded[:, 16:48, 16:48], rtol=0, atol=1e-3)


def test_progress_counts_evaluations_and_shows_the_median(
    node: Nodes, graph: Any, scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import comfy.utils

    calls: list[tuple[float, float, Any]] = []
    monkeypatch.setattr(
        comfy.utils,
        "PROGRESS_BAR_HOOK",
        lambda value, total, preview, node_id=None: calls.append((value, total, preview)),
    )
    node("IterativeMedian").execute(**ROUNDS, **inputs(graph, scene))
    total = (3 + 3 + 1) * 2 * 2
    assert calls[-1][:2] == (total, total)
    values = [value for value, _, _ in calls]
    assert values == sorted(values)
    previews = [preview for _, _, preview in calls if preview]
    assert previews
    assert previews[0][1].size == (32, 32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 1}, "steps is 1.*at least 2 steps"),
        ({"batch_size": -1}, "batch_size is -1"),
        ({"cfg": 0.0}, r"cfg is 0\.0.*1 or more"),
        ({"sampler": "dpmpp_sde"}, "sampler is 'dpmpp_sde'.*uni_pc"),
        ({"count": 0}, "balls is 0.*1 or more"),
        ({"strength": 0.01}, r"strength is 0\.01.*at least 0\.5 with 2 steps"),
    ],
)
def test_options_out_of_range_are_refused(
    node: Nodes, graph: Any, scene: Any, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(errors().OptionError, match=message):
        node("ChromeBallInpaint").execute(**{**inputs(graph, scene), "count": 1, "strength": 1.0, **change})


def test_zero_balls_are_refused(node: Nodes, graph: Any, scene: Any) -> None:
    with pytest.raises(errors().OptionError, match=r"balls is 0.*1 to 1000"):
        node("IterativeMedian").execute(**(ROUNDS | {"balls": 0}), **inputs(graph, scene))


class OtherModel:
    """Stands where a graph holds another model: what a MODEL is to the check, and no more."""

    model = torch.nn.Identity()


@pytest.mark.parametrize(
    ("socket", "value", "message"),
    [
        ("model", OtherModel(), "socket model: holds Identity; a model of SDXL's architecture"),
        ("vae", object(), "socket vae: holds a VAE of None latent channels; the model's has 4"),
        ("control_net", object(), "socket control_net: holds object; a ControlNet"),
        ("positive", [[torch.zeros(1, 77, 768), {}]], "socket positive: holds embeddings 768 wide; the model takes 64"),
        ("negative", [[torch.zeros(1, 77, 64), {}]], "socket negative: .*with a pooled output"),
        ("negative", [], "socket negative: holds no conditioning"),
    ],
)
def test_models_of_another_kind_are_refused_by_socket(
    node: Nodes, graph: Any, scene: Any, socket: str, value: Any, message: str
) -> None:
    with pytest.raises(errors().ModelError, match=message):
        node("IterativeMedian").execute(**ROUNDS, **inputs(graph, scene, **{socket: value}))


@pytest.mark.parametrize(
    ("socket", "value", "message"),
    [
        ("image", torch.full((1, 64, 64, 3), math.nan), "image: holds NaN"),
        ("depth", torch.full((1, 64, 64, 3), math.inf), "depth: holds NaN or infinite"),
        ("image", torch.rand(1, 32, 64, 3), r"is 64 x 32 pixels.*64 x 64.*canvas image"),
        ("image", torch.rand(2, 64, 64, 3), "image: holds 2 pictures"),
        ("mask", torch.ones(1, 8, 8), "mask: has shape"),
    ],
)
def test_pictures_that_cannot_be_used_are_refused(
    node: Nodes, graph: Any, scene: Any, socket: str, value: Any, message: str
) -> None:
    with pytest.raises(errors().ImageError, match=message):
        node("IterativeMedian").execute(**ROUNDS, **inputs(graph, scene, **{socket: value}))


def test_controlnet_of_another_architecture_is_refused(node: Nodes, graph: Any, scene: Any) -> None:
    control = graph.control_net.copy()
    control.control_model = torch.nn.Identity()
    control.control_model.num_classes = None
    with pytest.raises(errors().ModelError, match="socket control_net: holds a ControlNet of another architecture"):
        node("IterativeMedian").execute(**ROUNDS, **inputs(replace(graph, control_net=control), scene))


# --- HDRMerge and BallToEquirect ---------------------------------------------------------------------------------


def bracket(radiance: torch.Tensor, evs: list[float]) -> list[torch.Tensor]:
    expose = pack_module("dl_core.exposure").expose
    return [expose(radiance, ev) for ev in evs]


@pytest.mark.parametrize("method", ["robust", "channel", "paper"])
def test_merge_gathers_lists_and_returns_radiance(node: Nodes, method: str) -> None:
    radiance = torch.rand(1, 8, 8, 3, generator=torch.Generator().manual_seed(3)).mean(dim=-1, keepdim=True) * 20
    radiance, evs = radiance.expand(-1, -1, -1, 3), [0.0, -2.5, -5.0]
    merged, report = node("HDRMerge").execute(bracket(radiance, evs), evs, [method], [2.4], ["one", "two"]).args
    torch.testing.assert_close(merged, radiance, rtol=1e-3, atol=1e-3)
    assert report.splitlines()[:2] == ["one", "two"]
    assert f"EV 0, -2.5, -5 by the method {method}" in report


def test_merge_gives_lights_back(node: Nodes) -> None:
    """A lamp that every ball has elsewhere: no median has it, the merged ball does, as bright as in the balls."""
    evs = [0.0, -2.5, -5.0]
    whole = torch.full((5, 32, 32, 3), 0.2)
    for number, ball in enumerate(whole):
        ball[8 + 2 * number : 10 + 2 * number, 14:16] = 20.0
    medians = bracket(whole.median(dim=0, keepdim=True).values, evs)
    dull, _ = node("HDRMerge").execute(medians, evs, ["robust"], [2.4]).args
    lit, report = node("HDRMerge").execute(medians, evs, ["robust"], [2.4], ["one"], bracket(whole, evs)).args
    assert float(dull.max()) < 0.3
    restore = pack_module("dl_core.restored_lights").restore_lights
    torch.testing.assert_close(lit, restore(dull, whole), rtol=1e-3, atol=1e-3)
    assert float(lit.mean()) > float(dull.mean())
    assert report.startswith("one")
    # A ball is as bright as itself: what Iterative Median hands on where it painted none changes nothing.
    same, _ = node("HDRMerge").execute(medians, evs, ["robust"], [2.4], [], medians).args
    assert torch.equal(same, dull)


@pytest.mark.parametrize("counts", [(2, 2), (2, 3, 2), (0, 0, 0)])
def test_light_balls_that_are_not_as_many_at_every_ev_are_refused(node: Nodes, counts: tuple[int, ...]) -> None:
    balls, evs = [torch.rand(1, 16, 16, 3)] * 3, [0.0, -2.5, -5.0]
    batches = [torch.rand(count, 16, 16, 3) for count in counts]
    with pytest.raises(errors().ProbeError, match="light_balls"):
        node("HDRMerge").execute(balls, evs, ["robust"], [2.4], [], batches)


@pytest.mark.parametrize(
    ("balls", "evs", "kind", "message"),
    [
        (3, [0.0, -2.5], "OptionError", "balls is 3; accepted: one ball image per EV, that is 2"),
        (2, [-2.5, 0.0], "OptionError", "evs is .*start at 0"),
        (0, [0.0], "OptionError", "balls is 0"),
    ],
)
def test_bracket_that_does_not_fit_its_evs_is_refused(
    node: Nodes, balls: int, evs: list[float], kind: str, message: str
) -> None:
    with pytest.raises(getattr(errors(), kind), match=message):
        node("HDRMerge").execute([torch.rand(1, 4, 4, 3)] * balls, evs, ["channel"], [2.4])


@pytest.mark.parametrize(("value", "message"), [(math.nan, "EV -2.5: holds NaN"), (-1.0, "EV -2.5: holds negative")])
def test_ball_that_is_no_light_is_refused_by_its_ev(node: Nodes, value: float, message: str) -> None:
    balls = [torch.rand(1, 4, 4, 3), torch.full((1, 4, 4, 3), value)]
    with pytest.raises(errors().ImageError, match=message):
        node("HDRMerge").execute(balls, [0.0, -2.5], ["channel"], [2.4])


def test_unwrapped_from_the_canvas_as_from_the_crop(node: Nodes, generator: torch.Generator) -> None:
    balls = pack_module("dl_core.ball")
    place = balls.place_ball(64, 32, x=24, y=40)
    canvas = torch.rand(2, 64, 64, 3, generator=generator)
    crop = balls.crop_ball(canvas, place)
    options = {"height": 16, "yaw": 0.0, "samples": 2}
    from_canvas = node("BallToEquirect").execute(canvas, ball=place, **options).args
    from_crop = node("BallToEquirect").execute(crop, **options).args
    with_ball = node("BallToEquirect").execute(crop, ball=place, **options).args
    assert from_canvas[0].shape == (2, 16, 32, 3)
    assert torch.equal(from_canvas[0], from_crop[0])
    assert torch.equal(with_ball[0], from_crop[0])


def test_coverage_leaves_out_straight_ahead(node: Nodes) -> None:
    _, coverage = node("BallToEquirect").execute(torch.rand(1, 16, 16, 3), height=64, yaw=0.0, samples=1).args
    assert coverage.shape == (1, 64, 128)
    assert coverage[0, 32, 64] == 0
    assert coverage[0, 32, 0] == coverage[0, 0, 0] == coverage[0, 63, 0] == 1
    weights = pack_module("dl_core.geometry").latlong_solid_angles(64)
    share = float((coverage[0] * weights).sum() / (4 * math.pi))
    assert share == pytest.approx((1 - 1 / 16) ** 2, abs=0.02)  # equal-area: the radius squared


def test_yaw_turns_the_world_to_the_right(node: Nodes) -> None:
    """A light straight behind, at the map's edge, turned by 90 degrees lies left of the centre by a quarter."""
    ball = torch.zeros(1, 32, 32, 3)
    ball[:, 14:18, 14:18] = 1.0
    plain, _ = node("BallToEquirect").execute(ball, height=32, yaw=0.0, samples=2).args
    turned, _ = node("BallToEquirect").execute(ball, height=32, yaw=90.0, samples=2).args

    def azimuth(latlong: torch.Tensor) -> float:
        columns = (torch.arange(64) + 0.5) / 64 * 2 * math.pi
        weight = latlong[0, ..., 0].sum(dim=0)
        return math.degrees(math.atan2(float((weight * columns.sin()).sum()), float((weight * columns.cos()).sum())))

    assert azimuth(plain) % 360 == pytest.approx(0, abs=2) or azimuth(plain) % 360 == pytest.approx(360, abs=2)
    assert azimuth(turned) % 360 == pytest.approx(90, abs=3)


def test_oblong_ball_is_refused(node: Nodes) -> None:
    with pytest.raises(errors().ImageError, match="image: is 8 x 4 pixels; a square ball crop"):
        node("BallToEquirect").execute(torch.rand(1, 4, 8, 3), height=8, yaw=0.0, samples=1)


def test_a_fitted_circle_is_what_is_unwrapped(node: Nodes) -> None:
    library = pack_module("dl_core.ball_fit")
    place = pack_module("dl_core.ball").place_ball(256, 64)
    fit = library.BallFit(31.4, (128.6, 127.7), (0.01, 0.01, 0.01), clear=True, reason="", explained=1.0)
    crop = torch.rand(1, 64, 64, 3)
    options = {"height": 32, "yaw": 0.0, "samples": 1}
    found, coverage = node("BallToEquirect").execute(crop, ball=place, fit=fit, **options).args
    geometry = pack_module("dl_core.geometry")
    circle = {"radius": 31.4, "centre": (32.6, 31.7)}
    torch.testing.assert_close(found, geometry.ball_to_latlong(crop, 32, painted=True, **circle))
    torch.testing.assert_close(coverage, geometry.latlong_coverage(32, 64, **circle))
    with pytest.raises(errors().OptionError, match="ball"):
        node("BallToEquirect").execute(crop, fit=fit, **options)


def test_an_inset_is_a_smaller_ball(node: Nodes) -> None:
    geometry = pack_module("dl_core.geometry")
    crop = torch.rand(1, 32, 32, 3, generator=torch.Generator().manual_seed(3))
    found, _ = node("BallToEquirect").execute(crop, height=16, yaw=0.0, samples=1, inset=0.5).args
    assert torch.equal(found, geometry.ball_to_latlong(crop, 16, samples=1, painted=True, radius=15.5))
    plain, _ = node("BallToEquirect").execute(crop, height=16, yaw=0.0, samples=1).args
    assert (found - plain).abs().max() > 0.01


def test_fit_ball_keeps_the_circle_asked_for_where_nothing_tells(node: Nodes) -> None:
    place = pack_module("dl_core.ball").place_ball(256, 64)
    grey = torch.full((1, 64, 64, 3), 0.5)
    fit, report = node("FitBall").execute([grey, grey], [torch.full((1, 256, 256, 3), 0.5)], [place]).args
    assert (fit.radius, fit.centre, fit.clear) == (32.0, place.centre, False)
    assert fit.reason in report
    with pytest.raises(errors().ImageError, match="balls"):
        node("FitBall").execute([grey[:, :32]], [torch.full((1, 256, 256, 3), 0.5)], [place])


def smooth_latlong(height: int = 64) -> torch.Tensor:
    return torch.exp(pack_module("dl_core.geometry").latlong_directions(height))[None]


@pytest.mark.parametrize("camera", [{}, {"projection": "perspective", "fov": 60.0, "frame": 4.0}])
def test_a_map_comes_back_from_the_ball_it_shows(node: Nodes, camera: dict[str, Any]) -> None:
    latlong = smooth_latlong()
    (ball,) = node("EquirectToBall").execute(latlong, 256, 90.0, **camera).args
    assert ball.shape == (1, 256, 256, 3)
    again, coverage = node("BallToEquirect").execute(ball, height=64, yaw=-90.0, samples=1, **camera).args
    seen = coverage > 0.99
    # exp(d) changes by at most e · π/64 = 13% a pixel of the map; a pixel of the ball blurs by a fraction of that.
    torch.testing.assert_close(again[seen], latlong[seen], rtol=0.02, atol=0.02)
    assert float(seen.float().mean()) > 0.9


def test_a_map_of_another_shape_is_named(node: Nodes) -> None:
    with pytest.raises(errors().OptionError, match="latlong"):
        node("EquirectToBall").execute(torch.rand(1, 16, 16, 3), 64, 0.0)


def test_the_chart_points_at_a_preset_and_at_values_of_ones_own(node: Any) -> None:
    values = {"balls": 5, "rounds": 1, "strength": 0.8, "final": False, "steps": 7, "evs": "0, -2.5, -5"}
    pictures = {}
    for preset in ("balanced", "custom"):
        pictures[preset], told = node("SpeedAccuracyChart").execute(preset=preset, **values).args
        assert ("not measured" in told) == (preset == "custom")
    assert pictures["balanced"].shape == pictures["custom"].shape
    assert (pictures["balanced"] != pictures["custom"]).any()
