"""Panoramas that show the same scene: rescaled, exposed anew, noisy or turned about the vertical axis.

A map is reduced to a signature: the logarithm of its luminance over its median at low resolution, less its mean and
weighted by solid angle, as azimuthal frequencies of each row. Exposure drops out by the median, size and noise by the
resolution, and a turn by the search for the best one, which in frequencies is a product. Two maps are as alike as
their correlation there. A perceptual hash of a picture knows no turn, which is why none is used here.

Measured on 32 panoramas of Poly Haven (496 pairs): different ones are alike by 0.918 at most; one and the same reduced
to 70 rows, enlarged, at 1 / 100 of the exposure, with 10% of noise, turned, or all of these by 0.980 at least. Mirrored
ones count as different.

Source: DiffusionLight, Appendix C.1 (near-duplicates are left out of the training set, there by perceptual hashing).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from ...exposure import luminance
from ...geometry import latlong_solid_angles
from ...shapes import Latlong
from ..panoramas import reduce_panorama

__all__ = ["ALIKE", "ROWS", "find_duplicates", "likeness", "signature"]

ALIKE: Final = 0.96
"""Likeness from which two maps count as the same."""
ROWS: Final = 32
"""Of a signature, and at least of a map that has one."""
COLUMNS: Final = 4 * ROWS
"""Of the map the frequencies are taken of; more than they need, so that a turn by part of a column shows little."""
FREQUENCIES: Final = ROWS // 2
TURNS: Final = 8 * ROWS
"""Turns tried."""
BLACK: Final = 0.1
"""Added to luminance in units of the median: what is darker counts as black."""
EVEN: Final = 0.01
"""Added to the signature, so that maps without features are alike."""


def signature(latlong: Latlong) -> Complex[Tensor, "rows frequencies"]:
    """What a map is compared by.

    Args:
        latlong: (1, H, 2H, 3) linear radiance, H at least `COLUMNS` / 2.

    Returns:
        (`ROWS`, `FREQUENCIES`), its power over all turns 1.
    """
    levels = luminance(reduce_panorama(latlong, ROWS, COLUMNS)[0])[..., 0]
    median = levels.median()
    stops = torch.log2(levels / median.clamp(min=1e-12) + BLACK) if median > 0 else (levels > 0).float()
    weights = latlong_solid_angles(ROWS).to(levels)
    stops = stops - (stops * weights).sum() / (weights.sum() * COLUMNS) + EVEN
    spectrum = torch.fft.rfft(stops * weights.sqrt(), dim=1)[:, :FREQUENCIES]
    return spectrum / _correlations(spectrum, spectrum[None]).amax().clamp(min=1e-12).sqrt()


def _correlations(one: Complex[Tensor, "rows f"], others: Complex[Tensor, "n rows f"]) -> Float[Tensor, "n turns"]:
    return torch.fft.irfft((one.conj() * others).sum(dim=1), n=TURNS, norm="forward")


def likeness(one: Complex[Tensor, "rows f"], others: Complex[Tensor, "n rows f"]) -> Float[Tensor, "n"]:
    """Correlation of a signature with others at the turn where it is largest: 1 for the same map, turned or not."""
    return _correlations(one, others).amax(dim=1)


def find_duplicates(signatures: Mapping[str, Complex[Tensor, "rows f"]]) -> dict[str, str]:
    """Maps that show what an earlier one of the mapping shows, and which one that is.

    Args:
        signatures: by name, the ones to keep first.
    """
    kept: list[str] = []
    found: dict[str, str] = {}
    bank = torch.stack(list(signatures.values())) if signatures else torch.empty(0)
    places: list[int] = []
    for place, name in enumerate(signatures):
        if kept:
            alike = likeness(bank[place], bank[places])
            best = int(alike.argmax())
            if float(alike[best]) >= ALIKE:
                found[name] = kept[best]
                continue
        kept.append(name)
        places.append(place)
    return found
