"""Exposure and merge: single pixels worked out by hand, and bounds that follow from 8-bit steps."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.errors import ImageError, OptionError
from dl_core.exposure import (
    GAMMA,
    MERGES,
    auto_exposure,
    borne_out,
    check_evs,
    check_merge,
    decode_display,
    encode_display,
    expose,
    exposure_error,
    luminance,
    merge_bracket,
    merge_channel,
    merge_paper,
    merge_robust,
    quantize,
)

PAPER_EVS = (0.0, -2.5, -5.0)


def bracket(radiance: torch.Tensor, evs: tuple[float, ...] = PAPER_EVS) -> list[torch.Tensor]:
    """What a perfect painter's 8-bit pictures show of radiance."""
    return [quantize(expose(radiance, ev)) for ev in evs]


def pixel(*rgb: float) -> torch.Tensor:
    return torch.tensor(rgb).reshape(1, 1, 1, 3)


def code_step(display: torch.Tensor) -> torch.Tensor:
    """Most that rounding to 8 bits changes the radiance behind a display value: half a code times the slope."""
    return ((display + 0.5 / 255).clamp(max=1) ** GAMMA - (display - 0.5 / 255).clamp(min=0) ** GAMMA).abs()


# --- encoding ----------------------------------------------------------------------------------------------------


@given(st.floats(0, 1))
def test_encoding_inverts(value: float) -> None:
    assert_close(decode_display(encode_display(torch.tensor([value]))), torch.tensor([value]))


def test_encoding_clips_both_ends() -> None:
    assert encode_display(torch.tensor([-1.0, 0.0, 1.0, 7.0])).tolist() == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("ev", [0.0, -1.0, -2.5])
def test_an_ev_scales_radiance_by_a_power_of_two(ev: float) -> None:
    assert_close(decode_display(expose(torch.tensor([0.8]), ev)), torch.tensor([0.8 * 2**ev]))


@given(st.floats(0, 1))
def test_quantizing_is_off_by_half_a_code_at_most(value: float) -> None:
    rounded = float(quantize(torch.tensor([value])))
    assert abs(rounded - value) <= 0.5 / 255 + 1e-6
    assert rounded * 255 == pytest.approx(round(rounded * 255), abs=1e-4)


def test_luminance_of_white_is_one() -> None:
    assert_close(luminance(torch.ones(4, 3)), 1.0)


# --- the paper's EV 0 --------------------------------------------------------------------------------------------


def test_auto_exposure_maps_the_percentile_to_the_target(generator: torch.Generator) -> None:
    picture = torch.rand(1, 40, 40, 3, generator=generator) * 50
    shown = expose(picture * auto_exposure(picture), 0.0)
    assert float((shown > 0.9 + 1e-6).float().mean()) == pytest.approx(0.01, abs=1 / picture.numel())


@given(st.floats(1e-3, 1e3))
def test_auto_exposure_undoes_a_scale(factor: float) -> None:
    picture = torch.linspace(0.01, 2, 300).reshape(1, 10, 10, 3)
    assert auto_exposure(picture * factor) * factor == pytest.approx(auto_exposure(picture), rel=1e-5)


def test_a_dark_picture_is_left_as_it_is() -> None:
    assert auto_exposure(torch.zeros(1, 4, 4, 3)) == 1.0


# --- EVs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("evs", [(0,), (0.0, -2.5, -5.0), (0, -0.5, -40)])
def test_descending_evs_pass(evs: tuple[float, ...]) -> None:
    assert check_evs(evs) == evs


@pytest.mark.parametrize(
    "evs",
    [
        (),
        (-1.0,),
        (-2.5, 0.0),
        (0.0, -5.0, -2.5),
        (0.0, 0.0),
        (0.0, 2.0),
        (0.0, math.nan),
        (math.nan,),
        (0.0, -math.inf),
    ],
)
@pytest.mark.parametrize("method", MERGES)
def test_other_evs_are_named(evs: tuple[float, ...], method: str) -> None:
    with pytest.raises(OptionError) as raised:
        merge_bracket([torch.ones(1, 2, 2, 3)] * len(evs), evs, method)
    assert raised.value.name == "evs"


# --- merge: what the paper's does on single pixels ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("radiance", "merged"),
    [
        # White far above the bracket: the ceiling, 2^5.
        ((100.0, 100.0, 100.0), (32.0, 32.0, 32.0)),
        # Sodium lamp: EV 0 shows (1, 1, 0.2), of luminance 0.942; the ramp mixes 0.42 of the darker luminances in.
        ((20.0, 6.0, 0.2), (3.4, 3.4, 0.7)),
        # Red: a luminance of 0.29 never reaches the threshold, so the clipped channel stays clipped.
        ((10.0, 0.1, 0.05), (1.0, 0.1, 0.05)),
        # Warm: EV 0 shows white, EV -2.5 still clips red, so that its luminance is
        # 0.2127 / 0.1768 + 0.7152 x 4 + 0.0722 x 1 = 4.1, below its threshold; the colour is lost.
        ((8.0, 4.0, 1.0), (4.1, 4.1, 4.1)),
    ],
)
def test_paper_merge_on_lamps(radiance: tuple[float, ...], merged: tuple[float, ...]) -> None:
    found = merge_paper(bracket(pixel(*radiance)), PAPER_EVS)
    torch.testing.assert_close(found, pixel(*merged), rtol=0, atol=0.05)  # half of the last digit printed


def test_paper_merge_keeps_the_black_of_ev_0() -> None:
    balls = [pixel(0, 0, 0), pixel(0.5, 0.5, 0.5), pixel(0.9, 0.9, 0.9)]
    assert_close(merge_paper(balls, PAPER_EVS), 0.0)


@given(st.lists(st.floats(0, 1), min_size=9, max_size=9))
def test_paper_merge_keeps_the_chroma_of_ev_0(values: list[float]) -> None:
    balls = [pixel(*values[3 * i : 3 * i + 3]) for i in range(3)]
    merged = merge_paper(balls, PAPER_EVS)
    assert bool(torch.isfinite(merged).all())
    assert float(merged.min()) >= 0
    shown = decode_display(balls[0])
    cross = torch.linalg.cross(merged, shown)
    assert float(cross.norm()) <= 1e-5 * float(merged.norm() * shown.norm()) + 1e-30


# --- merge: what the channel merge recovers ----------------------------------------------------------------------


@pytest.mark.parametrize("radiance", [(20.0, 6.0, 0.2), (10.0, 0.1, 0.05), (8.0, 4.0, 1.0), (31.0, 0.02, 3.0)])
def test_channel_merge_recovers_lamps(radiance: tuple[float, ...]) -> None:
    found = merge_channel(bracket(pixel(*radiance)), PAPER_EVS)
    # Between clipping of one exposure and the next, codes are at least 255 x 2^(-2.5 / 2.4) = 124: half a code is
    # 0.4% of the display value, 2.4 times that in radiance. Below EV 0's range a code is coarser.
    torch.testing.assert_close(found, pixel(*radiance), rtol=0.011, atol=0.0015)


@given(st.lists(st.floats(0, 32), min_size=3, max_size=3))
def test_channel_merge_is_within_half_a_code(values: list[float]) -> None:
    truth = pixel(*values)
    balls = bracket(truth)
    exposed = [truth * 2.0**ev for ev in PAPER_EVS]
    # An exposure has a say below its clipping, once the brighter one is past the threshold (less half a code).
    has_say = [exposed[0] < 1, (exposed[0] > 0.89) & (exposed[1] < 1), exposed[1] > 0.89]
    steps = [code_step(ball) * 2.0**-ev for ball, ev in zip(balls, PAPER_EVS, strict=True)]
    bound = torch.stack([step * say for step, say in zip(steps, has_say, strict=True)]).amax(dim=0)
    assert bool(((merge_channel(balls, PAPER_EVS) - truth).abs() <= bound + 1e-5 * (1 + truth)).all())


def test_merge_is_exact_without_quantization(generator: torch.Generator) -> None:
    truth = torch.rand(1, 16, 16, 3, generator=generator) ** 4 * 32
    balls = [expose(truth, ev) for ev in PAPER_EVS]
    # Powers of 2.4 and 1 / 2.4 in float32: some dozens of roundings, times 2^5.
    torch.testing.assert_close(merge_channel(balls, PAPER_EVS), truth, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("evs", [(0.0, -2.5, -5.0), (0.0, -2.5, -5.0, -7.5, -10.0), (0.0, -1.0)])
@pytest.mark.parametrize("method", MERGES)
def test_merge_of_grey_rises_to_its_ceiling(method: str, evs: tuple[float, ...]) -> None:
    ceiling = 2.0 ** -evs[-1]
    ramp = torch.logspace(-3, math.log10(2 * ceiling), 400).reshape(1, 1, -1, 1).expand(-1, -1, -1, 3)
    merged = merge_bracket([expose(ramp, ev) for ev in evs], evs, method)[0, 0, :, 1]
    # Monotone up to the roundings of merging each value twice.
    assert bool((merged[1:] >= merged[:-1] * (1 - 1e-5)).all())
    assert float(merged[-1]) == pytest.approx(ceiling, rel=1e-5)
    below = ramp[0, 0, :, 1] < ceiling
    torch.testing.assert_close(merged[below], ramp[0, 0, below, 1], rtol=2e-5, atol=1e-6)


@given(st.floats(0, 32), st.floats(1, 2))
def test_a_brighter_pixel_never_merges_darker(value: float, factor: float) -> None:
    low, high = (merge_channel(bracket(pixel(v, v, v)), PAPER_EVS) for v in (value, value * factor))
    # Where one exposure hands over to the next their codes may disagree by half a step of each: about 1%.
    assert float(high.min()) >= float(low.max()) * 0.98 - 1e-6


def test_merges_agree_where_nothing_clips(generator: torch.Generator) -> None:
    balls = bracket(0.8 * torch.rand(1, 8, 8, 3, generator=generator))
    # The paper's luminance round trip divides and multiplies by the same number.
    torch.testing.assert_close(merge_paper(balls, PAPER_EVS), merge_channel(balls, PAPER_EVS), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(merge_robust(balls, PAPER_EVS), merge_channel(balls, PAPER_EVS))


# --- the robust merge --------------------------------------------------------------------------------------------


def lamps(generator: torch.Generator, size: int = 48) -> torch.Tensor:
    """Radiance with a tenth of its pixels above white, in colours of their own."""
    dim = torch.rand(1, size, size, 3, generator=generator)
    lamp = (torch.rand(1, size, size, 1, generator=generator) < 0.1).float()
    return dim + lamp * 20 * torch.rand(1, size, size, 3, generator=generator)


@pytest.mark.parametrize("evs", [PAPER_EVS, (0.0, -2.5, -5.0, -7.5, -10.0), (0.0, -1.0), (0.0, -5.0)])
def test_robust_is_the_channel_merge_on_exposures_that_agree(
    evs: tuple[float, ...], generator: torch.Generator
) -> None:
    balls = bracket(lamps(generator), evs)
    # Neither error nor distrust is found; what is left is the order of a few roundings, times the scale of the bracket.
    torch.testing.assert_close(merge_robust(balls, evs), merge_channel(balls, evs), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("stops", [-1.0, -0.4, 0.4, 1.0])
def test_an_exposure_that_is_wrong_as_a_whole_is_put_right(stops: float, generator: torch.Generator) -> None:
    truth = lamps(generator)
    balls = [quantize(expose(truth, ev + (stops if ev else 0))) for ev in PAPER_EVS]
    # 0.05 stops and the scatter of 8-bit codes, about 0.02, stay; the codes of lights are good to 1.1%, 0.02 stops.
    found = merge_robust(balls, PAPER_EVS)
    # Below what the darkest exposure shows even if it is a stop too bright.
    bright = (truth > 2) & (truth < 15)
    assert float((found[bright] / truth[bright]).log2().abs().max()) < 0.1
    assert float((merge_channel(balls, PAPER_EVS)[bright] / truth[bright]).log2().abs().median()) > 0.3


def test_the_error_of_an_exposure_is_measured(generator: torch.Generator) -> None:
    truth = lamps(generator)
    shown, darker = decode_display(expose(truth, 0.0)), decode_display(expose(truth, -1.5))
    # Half a stop too bright, less the dead zone of 0.05.
    assert exposure_error(shown, darker, 2.0) == pytest.approx(0.45, abs=1e-3)


def test_too_few_values_are_no_evidence() -> None:
    shown = torch.full((1, 3, 3, 3), 0.5)
    assert exposure_error(shown, shown, 2.0) == 0


def test_exposures_of_different_scenes_tell_no_error(generator: torch.Generator) -> None:
    shown = decode_display(expose(lamps(generator), 0.0))
    other = decode_display(expose(100 * torch.rand(1, 48, 48, 3, generator=generator) ** 8, -2.5))
    assert exposure_error(shown, other, 2.5) == 0


@given(st.integers(0, 2**32), st.floats(-3, 3))
def test_no_darker_exposure_makes_a_ghost(seed: int, stops: float) -> None:
    """Whatever the darker exposures show, EV 0 is kept where it does not clip, and nowhere darkened."""
    generator = torch.Generator().manual_seed(seed)
    balls = [torch.rand(1, 16, 16, 3, generator=generator) for _ in PAPER_EVS]
    shown = decode_display(balls[0] * 2.0 ** (stops / GAMMA))
    balls[0] = encode_display(shown)
    merged = merge_robust(balls, PAPER_EVS)
    # Encoding and decoding again costs a few float32 roundings.
    assert bool((merged >= shown * (1 - 1e-5)).all())
    dim = shown < 0.9
    torch.testing.assert_close(merged[dim], shown[dim], rtol=1e-5, atol=1e-7)


@given(st.integers(0, 2), st.integers(0, 2), st.floats(0, 1), st.lists(st.floats(0, 1), min_size=9, max_size=9))
def test_robust_rises_with_every_input(exposure: int, channel: int, raised: float, values: list[float]) -> None:
    balls = [pixel(*values[3 * i : 3 * i + 3]) for i in range(3)]
    before = merge_robust(balls, PAPER_EVS)
    balls[exposure] = balls[exposure].clone()
    balls[exposure][..., channel] = torch.maximum(balls[exposure][..., channel], torch.tensor(raised))
    assert bool((merge_robust(balls, PAPER_EVS) >= before * (1 - 1e-6)).all())  # float32 roundings of up to 32


@pytest.mark.parametrize("scatter", [0.0, 0.6, 3.0])
def test_robust_rises_at_its_own_place_whatever_is_measured(scatter: float, generator: torch.Generator) -> None:
    """On brackets big enough to be measured, trusted, half trusted and not."""
    truth = lamps(generator, 16)
    painted = [truth, *(truth * torch.exp2(scatter * torch.randn(truth.shape, generator=generator)) for _ in range(2))]
    balls = [expose(shown, ev) for shown, ev in zip(painted, PAPER_EVS, strict=True)]
    before = merge_robust(balls, PAPER_EVS)
    for place in torch.randint(0, truth.numel(), (60,), generator=generator).tolist():
        for exposure in range(3):
            raised = [ball.clone() for ball in balls]
            value = raised[exposure].view(-1)[place]
            raised[exposure].view(-1)[place] = value + (1 - value) * torch.rand((), generator=generator)
            after = merge_robust(raised, PAPER_EVS).reshape(-1)[place]
            assert float(after) >= float(before.reshape(-1)[place]) * (1 - 1e-6)


# --- exposures that are pictures of their own --------------------------------------------------------------------

known = st.floats(0.4, 0.89)
"""Values that say in full what a pixel shows: twice the floor of evidence and more, and not clipped."""


@given(known, known, st.floats(1, 8), st.floats(1.04, 50))
def test_a_light_shown_too_bright_keeps_its_colour(green: float, blue: float, red: float, times: float) -> None:
    """Red clips alone; the darker exposure shows the same colour, times too bright: its red is put right with it."""
    shown, light = pixel(1.0, green, blue), pixel(red, green, blue)
    share = borne_out(shown, times * light, 2.5)[..., 0]
    # Less the dead zone of 0.05 stops.
    torch.testing.assert_close(share * times * red, torch.full((1, 1, 1), red * 2**0.05), rtol=1e-4, atol=0)


@given(known, known, st.floats(0.05, 1.03))
def test_a_light_no_brighter_than_the_pixel_is_believed(green: float, blue: float, times: float) -> None:
    shown = pixel(1.0, green, blue)
    assert float(borne_out(shown, times * pixel(9.0, green, blue), 2.5)[..., 0]) == 1


@pytest.mark.parametrize("shown", [(1.0, 1.0, 1.0), (1.0, 0.19, 0.1), (1.0, 1.0, 0.0)], ids=str)
def test_a_pixel_that_tells_nothing_doubts_nothing(shown: tuple[float, float, float]) -> None:
    assert float(borne_out(pixel(*shown), pixel(30.0, 30.0, 30.0), 2.5)[..., 0]) == 1


@given(st.lists(st.floats(0, 1), min_size=3, max_size=3), st.lists(st.floats(0, 30), min_size=3, max_size=3))
def test_a_channel_does_not_speak_for_itself(shown: list[float], darker: list[float]) -> None:
    for channel in range(3):
        other_shown, other_darker = list(shown), list(darker)
        other_shown[channel], other_darker[channel] = 0.5, 7.0
        share = borne_out(pixel(*shown), pixel(*darker), 2.5)[..., channel]
        assert torch.equal(share, borne_out(pixel(*other_shown), pixel(*other_darker), 2.5)[..., channel])
        assert 0 < float(share) <= 1


def of_their_own(generator: torch.Generator, lamp: torch.Tensor) -> tuple[list[torch.Tensor], torch.Tensor]:
    """A bracket whose exposures scatter by a stop: a dim picture with a warm glow where the darker ones have a lamp."""
    glow = torch.zeros(1, 48, 48, 1, dtype=torch.bool)
    glow[:, 20:26, 20:26] = True
    dim = 0.1 + 0.7 * torch.rand(1, 48, 48, 3, generator=generator)
    pictures = [torch.where(glow, pixel(1.3, 0.8, 0.5), dim)]
    for _ in PAPER_EVS[1:]:
        scattered = dim * torch.exp2(torch.randn(dim.shape, generator=generator))
        pictures.append(torch.where(glow, lamp, scattered))
    return [quantize(expose(picture, ev)) for picture, ev in zip(pictures, PAPER_EVS, strict=True)], glow[..., 0]


def test_a_channel_that_clips_alone_takes_no_light_of_another_picture(generator: torch.Generator) -> None:
    balls, glow = of_their_own(generator, pixel(6.0, 6.0, 6.0))
    # The lamp has eight times the green and more of the blue: less than white is left of its red. Codes of 8 bits.
    expected = torch.tensor([1.0, 0.8, 0.5]).expand(36, 3)
    torch.testing.assert_close(merge_robust(balls, PAPER_EVS)[glow], expected, atol=6e-3, rtol=0)
    assert float(merge_channel(balls, PAPER_EVS)[glow][:, 0].min()) > 5


def test_a_light_of_the_pixels_colour_is_taken_from_another_picture(generator: torch.Generator) -> None:
    balls, glow = of_their_own(generator, pixel(1.3, 0.8, 0.5))
    # What scatter leaves of the exposure's measured error is under a tenth of a stop.
    assert float(merge_robust(balls, PAPER_EVS)[glow][:, 0].mean()) == pytest.approx(1.3, rel=0.07)


def test_robust_keeps_blacks_black() -> None:
    balls = [pixel(0, 0, 0), pixel(0.5, 0.5, 0.5), pixel(0.9, 0.9, 0.9)]
    assert_close(merge_robust(balls, PAPER_EVS), 0.0)


def test_one_exposure_is_only_decoded(generator: torch.Generator) -> None:
    ball = torch.rand(1, 8, 8, 3, generator=generator)
    for method in MERGES:
        torch.testing.assert_close(merge_bracket([ball], (0.0,), method), decode_display(ball), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("method", MERGES)
@pytest.mark.parametrize(
    ("spoiled", "reason"),
    [
        (torch.full((1, 2, 2, 3), math.nan), "NaN"),
        (torch.full((1, 2, 2, 3), math.inf), "NaN or infinite"),
        (torch.full((1, 2, 2, 3), -0.1), "negative"),
        (torch.ones(1, 2, 3, 3), "shape"),
    ],
)
def test_a_spoiled_exposure_is_named(method: str, spoiled: torch.Tensor, reason: str) -> None:
    balls = [torch.ones(1, 2, 2, 3), spoiled, torch.ones(1, 2, 2, 3)]
    with pytest.raises(ImageError, match=reason) as raised:
        merge_bracket(balls, PAPER_EVS, method)
    assert raised.value.source == "ball at EV -2.5"


def test_one_ball_per_ev_is_wanted() -> None:
    with pytest.raises(OptionError, match="balls"):
        merge_channel([torch.ones(1, 2, 2, 3)], PAPER_EVS)


def test_an_unknown_merge_is_refused_with_the_known_ones() -> None:
    with pytest.raises(OptionError, match="robust, channel, paper"):
        check_merge("median")
