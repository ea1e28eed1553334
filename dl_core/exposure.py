"""Exposure: display encoding, EV scaling, and merging a bracket of balls into radiance.

Display-encoded values are radiance^(1/γ) clipped to [0, 1], γ = 2.4. An EV scales radiance by 2^EV before encoding.

Sources: DiffusionLight, Sec. 4.2 (γ-2.4, 99th percentile to 0.9) and Algorithm 2 (merge); Wang et al., StyleLight
(ECCV 2022) for the tone mapping it follows; luminance weights of sRGB as the paper prints them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import ImageError, OptionError

__all__ = [
    "GAMMA",
    "LUMINANCE",
    "MERGES",
    "auto_exposure",
    "borne_out",
    "brackets_of",
    "check_evs",
    "check_merge",
    "clipping",
    "decode_display",
    "encode_display",
    "expose",
    "exposure_error",
    "exposure_ratio",
    "luminance",
    "merge_batches",
    "merge_bracket",
    "merge_channel",
    "merge_paper",
    "merge_robust",
    "parse_evs",
    "quantize",
]

GAMMA: Final = 2.4
LUMINANCE: Final = (0.21267, 0.71516, 0.07217)
CLIP_THRESHOLD: Final = 0.9
"""Linear value from which an exposure counts as clipped; the next darker one takes over between it and 1."""

EVIDENCE_FLOOR: Final = 0.1
"""Linear value from which a picture is compared with a darker one: below it, noise of the painter outweighs."""
CLEAR_CODE: Final = 32 / 255
"""Display value above which half a code of 8 bits is under 4% of the radiance, 0.05 stops."""
EVIDENCE_COUNT: Final = 100
"""Values that it takes to tell the error of an exposure."""
DEAD_ZONE: Final = 0.05
"""Stops of error that rounding may feign, and that are left alone."""
LARGEST_ERROR: Final = 2.0
"""Stops of error that are undone at most: two neighbours, each off by one. More is another scene."""
TRUST: Final = 0.5
"""Scatter in stops, a median absolute deviation, up to which a measured error is believed in full."""
DISTRUST: Final = 1.0
"""Scatter in stops from which it is not believed at all."""
ONE_PICTURE: Final = 0.27
"""Scatter in stops that one picture reaches when it is moved, bent or tinted: 0.26 at most over the skies of
`tests/test_bench_misalign.py`. This and the next were set where single balls of the mini model merge best."""
TWO_PICTURES: Final = 0.33
"""Scatter in stops from which exposures count as pictures of their own; most single balls of the mini model do."""


def encode_display(radiance: Tensor, gamma: float = GAMMA) -> Tensor:
    """Radiance -> display values in [0, 1]; what lies outside [0, 1] clips."""
    return radiance.clamp(0, 1) ** (1 / gamma)


def decode_display(display: Tensor, gamma: float = GAMMA) -> Tensor:
    """Display values in [0, 1] -> radiance in [0, 1]."""
    return display.clamp(0, 1) ** gamma


def expose(radiance: Tensor, ev: float, gamma: float = GAMMA) -> Tensor:
    """What a display-encoded picture shows of radiance at an exposure value: encode(2^ev · radiance)."""
    return encode_display(radiance * 2.0**ev, gamma)


def quantize(display: Tensor) -> Tensor:
    """Round display values to 8 bits, as the authors' code stores them between its stages."""
    return (display.clamp(0, 1) * 255).round() / 255


def luminance(rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 1"]:
    """Luminance of linear RGB (Rec.709 primaries, weights as printed in Algorithm 2)."""
    return (rgb * rgb.new_tensor(LUMINANCE)).sum(dim=-1, keepdim=True)


def auto_exposure(
    radiance: Float[Tensor, "*n 3"], *, percentile: float = 99.0, target: float = 0.9, gamma: float = GAMMA
) -> float:
    """Scale that maps a percentile of intensity to a display value: the paper's EV 0.

    Args:
        radiance: linear RGB of the picture the photographer would have taken.
        percentile: of all channel values, 0 to 100.
        target: display value it lands on, in (0, 1].
        gamma: of the display encoding.

    Returns:
        The factor for the radiance; 1 for a picture without light.

    Source: DiffusionLight, Sec. 4.2.
    """
    values = radiance.reshape(-1).double()
    rank = min(len(values), max(1, round(len(values) * percentile / 100)))
    level = float(torch.kthvalue(values, rank).values)
    return target**gamma / level if level > 0 else 1.0


def check_evs(evs: Sequence[float]) -> tuple[float, ...]:
    """The EVs of a bracket, checked: they start at 0 and descend strictly.

    Raises:
        OptionError: none, unsorted, repeated, or without 0.
    """
    values = tuple(float(ev) for ev in evs)
    accepted = "strictly descending EVs that start at 0, such as 0, -2.5, -5"
    if not values or values[0] != 0 or not all(a > b for a, b in pairwise(values)):
        raise OptionError("evs", tuple(evs), accepted)
    if not all(ev >= -40 for ev in values):
        raise OptionError("evs", tuple(evs), accepted + ", none below -40")
    return values


def parse_evs(text: str) -> tuple[float, ...]:
    """The EVs of a bracket from text, checked as `check_evs` does.

    Raises:
        OptionError: something else than numbers and commas, or EVs that are no bracket's.
    """
    try:
        evs = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise OptionError("evs", text, "numbers and commas, such as 0,-2.5,-5") from error
    return check_evs(evs)


def _bracket(balls: Sequence[Tensor], evs: Sequence[float]) -> tuple[list[Tensor], tuple[float, ...]]:
    values = check_evs(evs)
    if len(balls) != len(values):
        raise OptionError("balls", len(balls), f"one ball image per EV, that is {len(values)}")
    for ball, ev in zip(balls, values, strict=True):
        if ball.shape != balls[0].shape:
            raise ImageError(f"ball at EV {ev:g}", f"has shape {tuple(ball.shape)}, EV 0 has {tuple(balls[0].shape)}")
        if not torch.isfinite(ball).all():
            raise ImageError(f"ball at EV {ev:g}", "holds NaN or infinite values")
        if ball.min() < 0:
            raise ImageError(f"ball at EV {ev:g}", f"holds negative values (lowest {float(ball.min()):g})")
    return list(balls), values


def _takeover(exposed: Tensor, brighter: Tensor, darker: Tensor) -> Tensor:
    """Weight of the darker exposure: rises from 0 to 1 as the brighter one, `exposed`, goes from 0.9 to clipped.

    It takes over only where it reports more light (Algorithm 2, line 7).
    """
    return clipping(exposed) * (darker > brighter).to(exposed)


def clipping(exposed: Tensor) -> Tensor:
    """How far linear values of an exposure clip: 0 up to 0.9 of its white, 1 from its white on."""
    return ((exposed - CLIP_THRESHOLD) / (1 - CLIP_THRESHOLD)).clamp(0, 1)


def exposure_error(
    brighter: Float[Tensor, "*n 3"], darker: Float[Tensor, "*n 3"], stops: float, gamma: float = GAMMA
) -> float:
    """Stops by which an exposure is brighter than its EV says, measured against the next brighter one.

    Compared are values that the brighter one shows below clipping and the darker one must show clear of its coarsest
    codes. Their median ratio is the error. Their scatter about it says whether both are pictures of one scene, and so
    how far the ratio is to be believed. An error that no exposure has, above 2 stops, counts like scatter. What
    rounding and scatter may feign is left out, so that exposures that agree have an error of exactly 0.

    Args:
        brighter: linear values in [0, 1] of its own white.
        darker: likewise.
        stops: between the two, above 0, as the EVs say.
        gamma: of the display encoding they were painted in.

    Returns:
        Within -2 to 2; 0 for fewer than 100 values to compare.

    Source: Mitsunaga and Nayar, Radiometric self calibration (CVPR 1999), for exposure ratios measured from the
    pictures.
    """
    return _believed_error(exposure_ratio(brighter, darker, stops, gamma))


def _believed_error(compared: tuple[float, float] | None) -> float:
    """What of a measured ratio is an error of the exposure; nothing was measured where it is None."""
    if compared is None:
        return 0.0
    error, scatter = compared
    doubt = scatter + max(0.0, abs(error) - LARGEST_ERROR)
    trust = min(1.0, max(0.0, (DISTRUST - doubt) / (DISTRUST - TRUST)))
    excess = min(max(abs(error) - scatter - DEAD_ZONE, 0.0), LARGEST_ERROR)
    return math.copysign(excess, error) * trust


def _apart(compared: tuple[float, float] | None) -> float:
    """How far two exposures are pictures of their own, 0 to 1, by their scatter; 0 where none was measured."""
    scatter = 0.0 if compared is None else compared[1]
    return min(1.0, max(0.0, (scatter - ONE_PICTURE) / (TWO_PICTURES - ONE_PICTURE)))


def _evidence_floor(stops: float, gamma: float = GAMMA) -> float:
    """Linear value from which a picture is compared with one darker by some stops, whose codes are coarser."""
    return max(EVIDENCE_FLOOR, 2.0**stops * CLEAR_CODE**gamma)


def exposure_ratio(
    brighter: Float[Tensor, "*n 3"], darker: Float[Tensor, "*n 3"], stops: float, gamma: float = GAMMA
) -> tuple[float, float] | None:
    """Stops by which an exposure is brighter than its EV says, and the scatter of that over the picture.

    Args: as `exposure_error`, which says what is compared.

    Returns:
        Median and median absolute deviation of the ratios, both in stops; None for fewer than 100 values to compare.
    """
    known = (brighter >= _evidence_floor(stops, gamma)) & (brighter < CLIP_THRESHOLD)
    if int(known.sum()) < EVIDENCE_COUNT:
        return None
    ratios = torch.log2(darker[known].clamp(min=1e-6) / brighter[known]) + stops
    error = float(ratios.detach().median())
    return error, float((ratios.detach() - error).abs().median())


def borne_out(
    brighter: Float[Tensor, "*n 3"], darker: Float[Tensor, "*n 3"], stops: float, gamma: float = GAMMA
) -> Float[Tensor, "*n 3"]:
    """Share of a darker exposure's light that a pixel's other channels bear out, by channel.

    Of a warm lamp the brighter exposure clips red alone. If the darker one shows more green and blue there than the
    brighter one, which knows better, it shows another light, and red would rise alone to a colour that neither has.
    Where it shows c times the other channels' light, 1 / c of its own is believed.

    Args:
        brighter: linear values in [0, 1] of its own white.
        darker: linear radiance in the same units, put right as a whole.
        stops: between the two, above 0.
        gamma: of the display encoding they were painted in.

    Returns:
        In (0, 1]; exactly 1 where the other channels agree within 0.05 stops, show less light, or tell nothing: those
        that clip, and those below twice the floor of `exposure_ratio`. What a channel shows itself does not enter its
        own share.
    """
    # Single pixels are compared, so both exposures' codes have to agree within the dead zone.
    floor = 2 * _evidence_floor(stops, gamma)
    known = (1 - clipping(brighter)) * (brighter / floor - 1).clamp(0, 1)
    weights = known * brighter
    excess = torch.log2(darker.clamp(min=1e-6) / brighter.clamp(min=1e-6))
    shares = []
    for channel in range(3):
        others = [other for other in range(3) if other != channel]
        weight = weights[..., others]
        mean = (weight * excess[..., others]).sum(-1) / weight.sum(-1).clamp(min=1e-6)
        shares.append(torch.exp2(-known[..., others].amax(-1) * (mean - DEAD_ZONE).clamp(min=0)))
    return torch.stack(shares, dim=-1)


def merge_robust(balls: Sequence[Tensor], evs: Sequence[float], gamma: float = GAMMA) -> Tensor:
    """Merge each colour channel by itself, once each exposure's error is undone.

    Each darker exposure is compared with the next brighter one (`exposure_error`) and put right. It then completes
    the brighter one where that clips:

        l + w(l) max(0, s d - l)

    with l a value of the brighter exposure in units of its white, d what the darker ones say of it, and w rising from
    0 to 1 between 0.9 and clipping. The darker ones never darken what the brighter one shows, and add no light where
    it is not clipped: what moved, or is another scene's, leaves no ghost there.

    s is 1 where exposures scatter as one picture does that is moved or bent: what it gains at one side of a light it
    loses at the other. Where they scatter more, each is a picture of its own, as single balls of a diffusion model are,
    and s falls to the share of the light that the pixel's other channels bear out (`borne_out`): a channel that clips
    alone does not rise to a colour that no exposure has.

    Args, Returns, Raises: as `merge_paper`; any number of EVs.

    Warnings:
        Raising a value never lowers the result at its own pixel and channel: values that tell an error are below the
        threshold, where nothing is taken over. Elsewhere the result rises as well, with two exceptions: what was raised
        moves the measured error or scatter of the whole exposure, or, where exposures are pictures of their own, shows
        more of a channel than the brighter one, which makes the pixel's others doubtful. Errors of up to 2 stops
        between neighbours are undone, less 0.05 stops and the scatter. A light that the darker exposures show elsewhere
        is not moved back, and ends at white. Noise of single pixels and channels, from a deviation of 0.1 of display
        values on, makes exposures pictures of their own and costs lights whose channels it pulls below white; diffusion
        models paint smoother.
        Where scenes scatter, giving up a darker exposure's colour for its luminance (as `merge_paper` does) was tried
        and dropped: over photographed panoramas shifted and bent lights came out worse and lights of another scene no
        better; only on balls of different seeds were colours closer, 0.96 for 1.03 degrees of irradiance at the median.

    Source: Debevec and Malik, Recovering high dynamic range radiance maps from photographs (SIGGRAPH 1997), and
    Robertson et al., Estimation-theoretic approach to dynamic range enhancement using multiple exposures (Journal of
    Electronic Imaging 12, 2003), whose weights fall to 0 at clipping; the latter prefer the longest exposure that is
    not clipped, which is what the ramp takes to its limit: averaging in the coarser codes of darker exposures would
    add noise. Sen et al., Robust patch-based HDR reconstruction of dynamic scenes (SIGGRAPH Asia 2012), for one
    reference exposure that the others may only complete where it is clipped; here EV 0.
    """
    balls, evs = _bracket(balls, evs)
    linear = [decode_display(ball, gamma) for ball in balls]
    merged = linear[-1]
    for i in range(len(balls) - 2, -1, -1):
        shown, stops = linear[i], evs[i] - evs[i + 1]
        compared = exposure_ratio(shown, linear[i + 1], stops, gamma)
        darker = merged * 2.0 ** (stops - _believed_error(compared))
        apart = _apart(compared)
        if apart:
            darker = darker * borne_out(shown, darker, stops, gamma) ** apart
        merged = shown + clipping(shown) * (darker - shown).clamp(min=0)
    return merged


def merge_paper(balls: Sequence[Tensor], evs: Sequence[float], gamma: float = GAMMA) -> Tensor:
    """Merge luminances and keep the chroma of EV 0.

    Args:
        balls: one (..., 3) display-encoded image in [0, 1] per EV, all of one shape.
        evs: exposure values, strictly descending from 0.
        gamma: of the display encoding.

    Returns:
        (..., 3) linear radiance; its ceiling is 2^(-last EV).

    Raises:
        OptionError: EVs as `check_evs` rejects them, or not one ball per EV.
        ImageError: shapes that differ, NaN, or negative values.

    Warnings:
        A light with one clipped channel is never replaced, and clipped lights turn neutral: the chroma is that of a
        clipped picture. That is how the paper avoids ghosts where painted exposures do not align.

    Source: DiffusionLight, Algorithm 2.
    """
    balls, evs = _bracket(balls, evs)
    linear = [decode_display(ball, gamma) for ball in balls]
    scaled = [luminance(image) * 2.0**-ev for image, ev in zip(linear, evs, strict=True)]
    merged = scaled[-1]
    for i in range(len(balls) - 2, -1, -1):
        weight = _takeover(scaled[i] * 2.0 ** evs[i], scaled[i], merged)
        merged = (1 - weight) * scaled[i] + weight * merged
    # Where EV 0 is black its chroma is undefined, and so is the ratio: the merge keeps the black.
    return linear[0] * (merged / scaled[0].clamp(min=1e-10))


def merge_channel(balls: Sequence[Tensor], evs: Sequence[float], gamma: float = GAMMA) -> Tensor:
    """Merge each colour channel by itself: the paper's rule applied to radiance per channel.

    Exact on brackets that align; ghosts in colour where they do not.

    Args, Returns, Raises: as `merge_paper`.

    Source: Algorithm 2 of DiffusionLight with luminance replaced by each channel.
    """
    balls, evs = _bracket(balls, evs)
    linear = [decode_display(ball, gamma) for ball in balls]
    merged = linear[-1] * 2.0 ** -evs[-1]
    for i in range(len(balls) - 2, -1, -1):
        scaled = linear[i] * 2.0 ** -evs[i]
        weight = _takeover(linear[i], scaled, merged)
        merged = (1 - weight) * scaled + weight * merged
    return merged


MERGES: Final[dict[str, Callable[..., Tensor]]] = {
    "robust": merge_robust,
    "channel": merge_channel,
    "paper": merge_paper,
}
"""Merge methods by name, the default first."""


def check_merge(method: str) -> str:
    """The name of a merge method, checked before anything is painted for it.

    Raises:
        OptionError: an unknown method.
    """
    if method not in MERGES:
        raise OptionError("merge", method, ", ".join(MERGES))
    return method


def merge_bracket(
    balls: Sequence[Tensor], evs: Sequence[float], method: str = "robust", gamma: float = GAMMA
) -> Tensor:
    """Merge a bracket by the method of a given name (see `MERGES`).

    Raises:
        OptionError: an unknown method, and what the method raises.
    """
    return MERGES[check_merge(method)](balls, evs, gamma)


def brackets_of(batches: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
    """Balls painted at several exposures, as many at each, as brackets: (M, ...) per EV -> M tuples of (1, ...)."""
    return list(zip(*(batch.split(1) for batch in batches), strict=True))


def merge_batches(
    batches: Sequence[Tensor], evs: Sequence[float], method: str = "robust", gamma: float = GAMMA
) -> Tensor:
    """Merge each ball of some by itself, as exposures are measured ball by ball: (M, ..., 3) per EV -> (M, ..., 3).

    Raises: as `merge_bracket`.
    """
    return torch.cat([merge_bracket(bracket, evs, method, gamma) for bracket in brackets_of(batches)])
