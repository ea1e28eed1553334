"""Decoding a ball's neighbourhood against decoding the whole canvas."""

from __future__ import annotations

import pytest
import torch
from diffusers import AutoencoderKL, AutoencoderTiny
from tolerances import assert_close
from torch import Tensor, nn

from dl_core.backends.mini import load_mini
from dl_core.ball import Ball, crop_ball, place_ball
from dl_core.decoding import PLAIN_MARGIN, decode_ball, decode_margin

CODE = 1 / 255

BALLS = {
    "in the middle": place_ball(512, 64),
    "off the cells": place_ball(512, 61, x=203, y=262),
    "in the corner": place_ball(512, 64, x=32, y=480),
    "as large as the canvas": place_ball(512, 512),
}


def pixels_of(autoencoder: nn.Module, latents: Tensor) -> Tensor:
    decoded: Tensor = autoencoder.decode(latents).sample
    return (decoded / 2 + 0.5).permute(0, 2, 3, 1)


@torch.no_grad()
def error(autoencoder: nn.Module, ball: Ball, margin: int | None) -> tuple[float, float, float]:
    """Largest and mean difference from the whole canvas' decoding, and the contrast of the ball."""
    cells = ball.canvas // 8
    latents = torch.randn(1, 4, cells, cells, generator=torch.Generator().manual_seed(0))
    whole = crop_ball(pixels_of(autoencoder, latents), ball).clamp(0, 1)
    found = decode_ball(lambda part: pixels_of(autoencoder, part), latents, ball, margin)
    difference = (found - whole).abs()
    return float(difference.max()), float(difference.mean()), float(whole.std())


@pytest.mark.parametrize("place", BALLS)
def test_each_cell_lands_where_the_canvas_has_it(place: str) -> None:
    """With a decoder that sees one cell, no margin is needed: what is cut is what the canvas shows, to the pixel."""
    ball = BALLS[place]
    latents = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))

    def decode(part: Tensor) -> Tensor:
        return part.repeat_interleave(8, 2).repeat_interleave(8, 3).permute(0, 2, 3, 1)

    for margin in (0, 3):
        assert torch.equal(decode_ball(decode, latents, ball, margin), crop_ball(decode(latents), ball))


def test_balls_are_in_the_range_of_display_values() -> None:
    ball, latents = place_ball(64, 64), torch.linspace(-3, 3, 64).reshape(1, 1, 8, 8).expand(1, 3, 8, 8)
    found = decode_ball(
        lambda part: part.permute(0, 2, 3, 1).repeat_interleave(8, 1).repeat_interleave(8, 2), latents, ball, 0
    )
    assert found.min() == 0
    assert found.max() == 1


@pytest.mark.parametrize("place", BALLS)
def test_the_trained_autoencoder_loses_less_than_half_a_code(place: str) -> None:
    """On latents of white noise, which carry more fine detail than any painting."""
    autoencoder = load_mini().vae
    assert decode_margin(autoencoder) == PLAIN_MARGIN
    worst, _, contrast = error(autoencoder, BALLS[place], PLAIN_MARGIN)
    assert worst < 0.5 * CODE
    assert contrast > 20 * CODE


def test_autoencoders_of_taesds_shape_lose_less_than_half_a_code_and_less_with_more_margin() -> None:
    torch.manual_seed(1)
    autoencoder = AutoencoderTiny().eval()
    errors = [error(autoencoder, BALLS["in the middle"], margin)[0] for margin in (0, PLAIN_MARGIN, 20)]
    assert errors[0] > 2 * CODE
    assert errors[1] < 0.5 * CODE
    assert_close(torch.tensor(errors[2]), 0.0)  # further than its convolutions reach


@pytest.fixture(scope="module")
def normalizing() -> AutoencoderKL:
    """The topology of SDXL's autoencoder at a quarter of its width, with random weights."""
    torch.manual_seed(0)
    return AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=(32, 64, 128, 128),
        layers_per_block=2,
        latent_channels=4,
    ).eval()


def test_normalizing_autoencoders_decode_the_whole_canvas(normalizing: AutoencoderKL) -> None:
    """Statistics and attention take in all there is: a margin that covers half of the canvas leaves a visible error.

    Measured: 2.4 codes on average, of a contrast of 42.
    """
    assert decode_margin(normalizing) is None
    ball = place_ball(512, 128)
    worst, _, contrast = error(normalizing, ball, None)
    assert worst == 0
    assert contrast > 20 * CODE
    _, cut, _ = error(normalizing, ball, 16)
    assert CODE < cut < 5 * CODE
