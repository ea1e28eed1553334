"""The mini model's autoencoder: an encoder in closed form, and a decoder trained to undo it.

A latent of the mini model states, for a block of 8 x 8 pixels with display-encoded values: its mean luma, its mean
red and blue chroma, and how uneven it is (the gap between the mean of f(luma) and f of the mean luma, with f the
convex display decoding; zero on a flat block, large where a small light sits in the dark). The first three carry
colour and exposure without loss; the fourth tells the decoder of highlights.

Averages, sums and piecewise-linear functions of non-negative values are what TAESD's layers (convolutions, ReLU,
identity skips) compute, so the encoder is written into its weights rather than trained. It costs no training, its
colour is exact, and latents for training the denoiser come from a few poolings. Only the decoder is trained.
"""

from __future__ import annotations

from typing import Any, Final

import torch
import torch.nn.functional as F
from diffusers import AutoencoderTiny
from jaxtyping import Float
from torch import Tensor, nn

from ...exposure import GAMMA
from ...shapes import Image

__all__ = ["block_latents", "decoder_loss", "write_closed_form_encoder", "write_thumbnail_decoder"]

LUMA: Final = (0.25, 0.625, 0.125)
"""Weights of red, green and blue; exact in half precision."""
CHROMA_SCALE: Final = 8.0
LUMA_SCALE: Final = 4.0
LUMA_MIDDLE: Final = 0.4375
UNEVEN_SCALE: Final = 8.0
UNEVEN_MIDDLE: Final = 0.125

DECODING_KNOTS: Final = (0.0, 0.25, 0.5, 0.75, 0.875)
"""Where the piecewise-linear f(luma) ~ luma^2.4 bends."""
ROOT_KNOTS: Final = (0.0, 0.004, 0.0156, 0.0625, 0.16)
"""Where the piecewise-linear square root that compresses unevenness bends."""


def _bends(knots: tuple[float, ...], values: Tensor) -> Float[Tensor, "k"]:
    """Change of slope at each knot of the line through (knot, value); `values` has one more, at 1 for the last."""
    ends = torch.tensor([*knots, 1.0])
    slopes = (values[1:] - values[:-1]) / (ends[1:] - ends[:-1])
    return torch.diff(slopes, prepend=torch.zeros(1)).half().float()


def _decoding_bends() -> Float[Tensor, "k"]:
    return _bends(DECODING_KNOTS, torch.tensor([*DECODING_KNOTS, 1.0]) ** GAMMA)


def _root_bends() -> Float[Tensor, "k"]:
    return _bends(ROOT_KNOTS, torch.tensor([*ROOT_KNOTS, 1.0]) ** 0.5)


def _piecewise(values: Tensor, knots: tuple[float, ...], bends: Tensor) -> Tensor:
    return sum((bend * (values - knot).clamp(min=0) for knot, bend in zip(knots, bends, strict=True)), values * 0)


def block_latents(image_ldr: Image, block: int = 8) -> Float[Tensor, "b 4 m n"]:
    """Latents by their definition.

    Args:
        image_ldr: (B, H, W, 3) display-encoded in [0, 1]; H and W are multiples of `block`.
        block: pixels a latent covers on a side: 8 at full size, less for pictures rendered smaller.

    Returns:
        (B, 4, H / block, W / block), each channel of order 1.
    """
    rgb = image_ldr.permute(0, 3, 1, 2)
    mean = F.avg_pool2d(rgb, block)
    weights = rgb.new_tensor(LUMA).view(1, 3, 1, 1)
    luma, mean_luma = (rgb * weights).sum(1, keepdim=True), (mean * weights).sum(1, keepdim=True)
    decoding = _decoding_bends()
    gap = F.avg_pool2d(_piecewise(luma, DECODING_KNOTS, decoding), block) - _piecewise(
        mean_luma, DECODING_KNOTS, decoding
    )
    uneven = _piecewise(gap.clamp(min=0), ROOT_KNOTS, _root_bends())
    return torch.cat(
        (
            (mean_luma - LUMA_MIDDLE) * LUMA_SCALE,
            (mean[:, 0:1] - mean_luma) * CHROMA_SCALE,
            (mean[:, 2:3] - mean_luma) * CHROMA_SCALE,
            (uneven - UNEVEN_MIDDLE) * UNEVEN_SCALE,
        ),
        dim=1,
    )


# Channels of the encoder's feature maps that carry something; the rest stay zero.
_RGB: Final = slice(0, 3)
_DECODED: Final = 3  # luma through f
_GAP: Final = 4
_ROOT: Final = 5
_KNEES: Final = 8  # first of the channels that hold luma less a knot


@torch.no_grad()
def write_closed_form_encoder(vae: AutoencoderTiny) -> None:
    """Write the weights with which a TAESD-shaped encoder computes `block_latents` (block 8)."""
    for parameter in vae.encoder.parameters():
        parameter.zero_()
    layers: list[Any] = list(vae.encoder.layers)
    luma, decoding, root = torch.tensor(LUMA), _decoding_bends(), _root_bends()
    _pass_rgb(layers[0])
    for k, knot in enumerate(DECODING_KNOTS):
        layers[0].weight[_KNEES + k, :, 1, 1] = luma
        layers[0].bias[_KNEES + k] = -knot
    halvings = [layer for layer in layers if isinstance(layer, nn.Conv2d) and layer.stride == (2, 2)]
    for number, layer in enumerate(halvings):
        layer.weight[range(3), range(3), 1:, 1:] = 0.25
        if number == 0:
            for k, bend in enumerate(decoding):
                layer.weight[_DECODED, _KNEES + k, 1:, 1:] = 0.25 * bend
        else:
            layer.weight[_DECODED, _DECODED, 1:, 1:] = 0.25
    gap, compress = (list(layer.conv) for layer in layers[-4:-2])
    for k, (knot, bend) in enumerate(zip(DECODING_KNOTS, decoding, strict=True)):
        gap[0].weight[_KNEES + k, _RGB, 1, 1] = luma
        gap[0].bias[_KNEES + k] = -knot
        gap[4].weight[_GAP, _KNEES + k, 1, 1] = -bend
    gap[0].weight[_DECODED, _DECODED, 1, 1] = 1
    gap[4].weight[_GAP, _DECODED, 1, 1] = 1
    for k, (knot, bend) in enumerate(zip(ROOT_KNOTS, root, strict=True)):
        compress[0].weight[_KNEES + k, _GAP, 1, 1] = 1
        compress[0].bias[_KNEES + k] = -knot
        compress[4].weight[_ROOT, _KNEES + k, 1, 1] = bend
    for convolution in (gap[2], compress[2]):
        for channel in range(64):
            convolution.weight[channel, channel, 1, 1] = 1
    _write_latents(layers[-1], luma)


def _pass_rgb(layer: nn.Conv2d) -> None:
    layer.weight[range(3), range(3), 1, 1] = 1


def _write_latents(layer: Any, luma: Tensor) -> None:
    red, blue = torch.eye(3)[0], torch.eye(3)[2]
    layer.weight[0, _RGB, 1, 1] = luma * LUMA_SCALE
    layer.weight[1, _RGB, 1, 1] = (red - luma) * CHROMA_SCALE
    layer.weight[2, _RGB, 1, 1] = (blue - luma) * CHROMA_SCALE
    layer.weight[3, _ROOT, 1, 1] = UNEVEN_SCALE
    layer.bias[0] = -LUMA_MIDDLE * LUMA_SCALE
    layer.bias[3] = -UNEVEN_MIDDLE * UNEVEN_SCALE


OFFSET: Final = 0.5
"""Added to the colours inside the decoder, so that ReLUs let them pass."""


@torch.no_grad()
def write_thumbnail_decoder(vae: AutoencoderTiny) -> None:
    """Start the decoder as one that interpolates the blocks' mean colours, the other channels at random.

    Colours are then right and edges of blocks soft from the first step; training adds what lies between the blocks.
    """
    layers: list[Any] = list(vae.decoder.layers)
    first, last = layers[0], layers[-1]
    tent = torch.outer(torch.tensor([0.25, 0.5, 0.25]), torch.tensor([0.25, 0.5, 0.25]))
    inverse = torch.linalg.inv(
        torch.stack((torch.tensor(LUMA), torch.eye(3)[0] - torch.tensor(LUMA), torch.eye(3)[2] - torch.tensor(LUMA)))
    )
    scales = torch.tensor([LUMA_SCALE, CHROMA_SCALE, CHROMA_SCALE])
    first.weight[_RGB] = 0
    first.weight[_RGB, :3, 1, 1] = inverse / scales
    first.bias[_RGB] = inverse[:, 0] * LUMA_MIDDLE + OFFSET
    for layer in layers:
        if isinstance(layer, nn.Conv2d) and layer not in (first, last):
            # After each nearest-neighbour doubling: together they interpolate linearly.
            layer.weight[_RGB] = 0
            layer.weight[range(3), range(3)] = tent
        elif hasattr(layer, "conv"):
            layer.conv[4].weight[_RGB] = 0
            layer.conv[4].bias[_RGB] = 0
            layer.conv[4].weight[3:] *= 0.3
    last.weight.mul_(0.05)
    last.weight[:, _RGB] = 0
    _pass_rgb(last)
    last.bias.copy_(-OFFSET * torch.ones(3))


def decoder_loss(painted: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"]) -> Float[Tensor, ""]:
    """L1 on pixels and on block means of 2, 4 and 8, and on block means of linear light (what lighting integrates).

    Args:
        painted: decoded display values, not clipped.
        truth: display values in [0, 1].
    """
    loss = F.l1_loss(painted, truth)
    for block in (2, 4, 8):
        loss = loss + F.l1_loss(F.avg_pool2d(painted, block), F.avg_pool2d(truth, block))
    linear, true_linear = painted.clamp(1e-3, 1) ** GAMMA, truth**GAMMA
    return loss + 2 * F.l1_loss(F.avg_pool2d(linear, 8), F.avg_pool2d(true_linear, 8))
