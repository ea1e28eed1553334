"""White balance: the identity for neutral photographs, and gains that cancel."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core.errors import OptionError
from dl_core.exposure import decode_display, encode_display, luminance
from dl_core.white_balance import WHITE_BALANCES, balance, cast_gains

METHODS = [name for name in WHITE_BALANCES if name != "none"]
PICTURE = torch.rand(1, 24, 32, 3, generator=torch.Generator().manual_seed(0)) * 0.6
CASTS = st.tuples(*[st.floats(0.4, 1.6)] * 3)


@pytest.mark.parametrize("method", WHITE_BALANCES)
@pytest.mark.parametrize("photo", [PICTURE[..., :1].expand(-1, -1, -1, 3), torch.zeros(1, 4, 4, 3)])
def test_a_neutral_photograph_stays_bit_for_bit(method: str, photo: torch.Tensor) -> None:
    gains = cast_gains(photo, method)
    assert torch.equal(gains, torch.ones(3))
    assert torch.equal(balance(photo, gains), photo)


def test_none_leaves_a_cast() -> None:
    assert torch.equal(cast_gains(PICTURE * torch.tensor([1.0, 0.5, 0.2]), "none"), torch.ones(3))


@pytest.mark.parametrize("method", METHODS)
@given(cast=CASTS)
def test_a_cast_on_a_grey_picture_is_taken_out(method: str, cast: tuple[float, float, float]) -> None:
    grey = decode_display(PICTURE[..., :1].expand(-1, -1, -1, 3))
    photo = encode_display(grey * torch.tensor(cast))
    balanced = decode_display(balance(photo, cast_gains(photo, method)))
    torch.testing.assert_close(balanced, luminance(balanced).expand_as(balanced), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_the_mean_keeps_its_luminance(method: str) -> None:
    photo = encode_display(decode_display(PICTURE) * torch.tensor([1.5, 1.0, 0.5]))
    order = WHITE_BALANCES[method] or 1
    pictures = (photo, balance(photo, cast_gains(photo, method)))
    means = [(decode_display(picture) ** order).mean(dim=(0, 1, 2)) ** (1 / order) for picture in pictures]
    torch.testing.assert_close(luminance(means[0]), luminance(means[1]), rtol=1e-4, atol=0)


@given(cast=CASTS)
def test_gains_cancel(cast: tuple[float, float, float]) -> None:
    photo = PICTURE * torch.tensor(cast) ** 0.5
    gains = cast_gains(photo, "grey-world")
    back = balance(balance(photo, gains), 1 / gains)
    unclipped = balance(photo, gains) < 1
    torch.testing.assert_close(back[unclipped], photo[unclipped], rtol=1e-5, atol=1e-6)


def test_a_picture_all_in_red_is_not_blown_up() -> None:
    gains = cast_gains(torch.tensor([1.0, 0.1, 0.0]).expand(1, 4, 4, 3), "grey-world")
    assert bool(torch.isfinite(gains).all())
    assert float(gains.max() / gains.min()) <= 16


def test_an_unknown_method_is_named() -> None:
    with pytest.raises(OptionError, match="grey-world"):
        cast_gains(PICTURE, "auto")
