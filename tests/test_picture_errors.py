"""Picture errors against computations written another way, and the invariances their names promise."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core.errors import ImageError, OptionError
from dl_core.picture_errors import CONVENTIONS, check_convention, picture_errors

ERRORS = ("rmse", "si_rmse", "angular_error_deg", "normalized_rmse")
AGREEMENT = 1e-6
"""Both sides compute in float64; arccos keeps half of its digits at small angles, 1e-8 rad = 6e-7 degrees."""


def draw(seed: int, height: int = 9, width: int = 14) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two pictures over a few decades with black pixels and a black background, and a mask."""
    generator = torch.Generator().manual_seed(seed)
    pictures = torch.exp(torch.randn(2, height, width, 3, generator=generator) * 1.5)
    mask = torch.rand(height, width, generator=generator) < 0.6
    mask[height // 2, width // 2] = True
    black = torch.rand(2, height, width, generator=generator) < 0.15
    pictures[black | ~mask] = 0
    return pictures[0], pictures[1], mask


# --- independent computations ------------------------------------------------------------------------------------


def flat(picture: torch.Tensor, mask: torch.Tensor) -> list[list[float]]:
    """Pixels under a mask as plain lists of numbers."""
    return [
        pixel for pixel, inside in zip(picture.flatten(0, 1).tolist(), mask.flatten().tolist(), strict=True) if inside
    ]


def percentile(values: list[float], percent: float) -> float:
    """Linear between order statistics, at rank p (n - 1)."""
    ordered = sorted(values)
    rank = percent / 100 * (len(ordered) - 1)
    below = math.floor(rank)
    return ordered[below] + (rank - below) * (ordered[min(below + 1, len(ordered) - 1)] - ordered[below])


def squared(left: list[list[float]], right: list[list[float]]) -> float:
    return math.fsum((a - b) ** 2 for p, q in zip(left, right, strict=True) for a, b in zip(p, q, strict=True))


def angles(left: list[list[float]], right: list[list[float]]) -> list[float | None]:
    found: list[float | None] = []
    for p, q in zip(left, right, strict=True):
        product = math.sqrt(math.fsum(a * a for a in p)) * math.sqrt(math.fsum(b * b for b in q))
        cosine = math.fsum(a * b for a, b in zip(p, q, strict=True)) / product if product else None
        found.append(None if cosine is None else math.degrees(math.acos(min(1.0, cosine))))
    return found


def scaled(pixels: list[list[float]], offset: float, factor: float) -> list[list[float]]:
    return [[(value - offset) * factor for value in pixel] for pixel in pixels]


def by_hand(
    estimate: torch.Tensor,
    truth: torch.Tensor,
    mask: torch.Tensor,
    *,
    channels: int,
    black_is_zero: bool,
    on_mask: bool,
) -> dict[str, float]:
    e, t = flat(estimate, mask), flat(truth, mask)
    count = len(e) * channels
    # The least error over scales from its closed form, t·t - (e·t)² / e·e, instead of from the scale.
    nothing = [[0.0] * 3] * len(e)
    power, total = squared(e, nothing), squared(t, nothing)
    cross = (power + total - squared(e, t)) / 2
    found = angles(e, t)
    kept = [angle or 0.0 for angle in found] if black_is_zero else [angle for angle in found if angle is not None]
    everywhere = torch.ones_like(mask)
    normalized = []
    for picture, pixels in ((estimate, e), (truth, t)):
        values = [value for pixel in flat(picture, mask if on_mask else everywhere) for value in pixel]
        low, high = percentile(values, 0.01), percentile(values, 99.9)
        normalized.append(scaled(pixels, low, 1 / (high - low)))
    return {
        "rmse": math.sqrt(squared(e, t) / count),
        "si_rmse": math.sqrt((total - cross * cross / power) / count),
        "angular_error_deg": math.fsum(kept) / len(kept),
        "normalized_rmse": math.sqrt(squared(*normalized) / count),
    }


RULES = {
    "published": {"channels": 1, "black_is_zero": True, "on_mask": False},
    "published-array": {"channels": 3, "black_is_zero": False, "on_mask": False},
    "radiance": {"channels": 3, "black_is_zero": False, "on_mask": True},
}
"""The conventions once more, in the words of the computation above."""


@pytest.mark.parametrize("convention", CONVENTIONS)
@given(seed=st.integers(0, 2**16), height=st.integers(3, 20), width=st.integers(3, 20))
def test_errors_agree_with_a_computation_by_hand(convention: str, seed: int, height: int, width: int) -> None:
    estimate, truth, mask = draw(seed, height, width)
    estimate[height // 2, width // 2] = truth[height // 2, width // 2] = 1.0  # at least one pixel has an angle
    found = asdict(picture_errors(estimate, truth, mask, convention))
    expected = by_hand(estimate, truth, mask, **RULES[convention])
    assert found == pytest.approx(expected, rel=AGREEMENT, abs=AGREEMENT)


def test_a_picture_known_by_head() -> None:
    """One red pixel where a green one should be, beside one that is right; the frame has a bright background."""
    truth = torch.tensor([[[0.0, 1.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]]])
    estimate = torch.tensor([[[1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]]])
    mask = torch.tensor([[True, True, False]])
    published = picture_errors(estimate, truth, mask, "published")
    assert published.rmse == pytest.approx(math.sqrt(2 / 2))
    assert published.angular_error_deg == pytest.approx(45)
    # e·t = 3, e·e = 4: the scale is 3/4, and t·t - 9/4 = 7/4 is left.
    assert published.si_rmse == pytest.approx(math.sqrt(7 / 4 / 2))
    # The frame runs from 0 to 2, up to the percentiles' own 0.1% of a step between nine values.
    assert published.normalized_rmse == pytest.approx(published.rmse / 2, rel=2e-3)
    radiance = picture_errors(estimate, truth, mask, "radiance")
    assert radiance.rmse == pytest.approx(math.sqrt(2 / 6))
    assert radiance.normalized_rmse == pytest.approx(radiance.rmse, rel=2e-3)


def test_black_pixels_count_as_published_and_not_otherwise() -> None:
    truth = torch.tensor([[[1.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    estimate = torch.tensor([[[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]])
    assert picture_errors(estimate, truth, convention="published").angular_error_deg == pytest.approx(45)
    for convention in ("published-array", "radiance"):
        assert picture_errors(estimate, truth, convention=convention).angular_error_deg == pytest.approx(90)


# --- properties --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("convention", CONVENTIONS)
@given(seed=st.integers(0, 2**16))
def test_a_picture_has_no_error_against_itself(convention: str, seed: int) -> None:
    _, truth, mask = draw(seed)
    found = asdict(picture_errors(truth, truth, mask, convention))
    # The scale of a picture to itself is 1 up to a rounding of float64.
    assert found == pytest.approx(dict.fromkeys(ERRORS, 0.0), abs=1e-9)


@pytest.mark.parametrize("convention", CONVENTIONS)
@given(seed=st.integers(0, 2**16), exponent=st.integers(-12, 12))
def test_what_is_scale_invariant_sees_no_scale(convention: str, seed: int, exponent: int) -> None:
    """Scales are powers of two, which float32 pixels take without rounding."""
    estimate, truth, mask = draw(seed)
    once = picture_errors(estimate, truth, mask, convention)
    again = picture_errors(estimate * 2.0**exponent, truth, mask, convention)
    assert again.si_rmse == pytest.approx(once.si_rmse, rel=1e-9)
    assert again.angular_error_deg == pytest.approx(once.angular_error_deg, rel=1e-9)
    assert again.normalized_rmse == pytest.approx(once.normalized_rmse, rel=1e-9)
    both = picture_errors(estimate * 2.0**exponent, truth * 2.0**exponent, mask, convention)
    assert both.rmse == pytest.approx(once.rmse * 2.0**exponent, rel=1e-9)


@pytest.mark.parametrize("convention", CONVENTIONS)
@given(seed=st.integers(0, 2**16))
def test_all_but_the_scaled_error_are_symmetric(convention: str, seed: int) -> None:
    estimate, truth, mask = draw(seed)
    forth = asdict(picture_errors(estimate, truth, mask, convention))
    back = asdict(picture_errors(truth, estimate, mask, convention))
    for name in ("rmse", "angular_error_deg", "normalized_rmse"):
        assert back[name] == pytest.approx(forth[name], rel=1e-9)


@pytest.mark.parametrize("convention", CONVENTIONS)
@given(seed=st.integers(0, 2**16))
def test_the_scaled_error_is_the_least_over_all_scales(convention: str, seed: int) -> None:
    estimate, truth, mask = draw(seed)
    least = picture_errors(estimate, truth, mask, convention).si_rmse
    for scale in (0.0, 0.5, 1.0):
        assert least <= picture_errors(estimate * scale, truth, mask, convention).rmse * (1 + 1e-9)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_what_lies_off_the_mask_does_not_count(convention: str) -> None:
    estimate, truth, mask = draw(7)
    once = picture_errors(estimate, truth, mask, convention)
    # Inside the range of the frame, so that not even the published percentiles move by more than their own step.
    estimate[~mask] = estimate[mask].median()
    again = picture_errors(estimate, truth, mask, convention)
    assert (again.rmse, again.si_rmse, again.angular_error_deg) == (once.rmse, once.si_rmse, once.angular_error_deg)
    if CONVENTIONS[convention].range_on_mask:
        assert again.normalized_rmse == once.normalized_rmse


def test_summing_channels_is_root_three_above_averaging_them() -> None:
    estimate, truth, mask = draw(8)
    summed = picture_errors(estimate, truth, mask, "published")
    averaged = picture_errors(estimate, truth, mask, "published-array")
    for name in ("rmse", "si_rmse", "normalized_rmse"):
        assert getattr(summed, name) == pytest.approx(math.sqrt(3) * getattr(averaged, name), rel=1e-12)


# --- edges -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_black_and_even_pictures_have_finite_errors(convention: str) -> None:
    even, black = torch.full((4, 5, 3), 2.0), torch.zeros(4, 5, 3)
    found = picture_errors(black, even, None, convention)
    assert found.si_rmse == found.rmse
    assert (found.angular_error_deg, found.normalized_rmse) == (0, 0)
    assert np.isfinite(list(asdict(picture_errors(even, black, None, convention)).values())).all()


@pytest.mark.parametrize(
    ("estimate", "truth", "mask", "reason"),
    [
        (torch.ones(2, 3, 3), torch.ones(2, 4, 3), None, "3 x 2 and 4 x 2 pixels"),
        (torch.full((2, 3, 3), math.nan), torch.ones(2, 3, 3), None, "estimate: holds NaN"),
        (torch.ones(2, 3, 3), torch.full((2, 3, 3), math.inf), None, "truth: holds NaN or infinite"),
        (torch.ones(2, 3, 3), torch.ones(2, 3, 3), torch.zeros(2, 3, dtype=torch.bool), "mask: holds nowhere"),
    ],
)
def test_what_cannot_be_compared_says_why(
    estimate: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor | None, reason: str
) -> None:
    with pytest.raises(ImageError, match=reason):
        picture_errors(estimate, truth, mask)


def test_unknown_conventions_are_named() -> None:
    with pytest.raises(OptionError, match="convention is 'paper'; accepted: published, published-array, radiance"):
        check_convention("paper")
