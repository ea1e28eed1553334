"""Named tensor shapes, used in annotations across the library.

Axes: b batch, h height, w width, c channels (3 for colour), d the side of a square ball crop, n items.
The annotations are checked at run time in the test suite only (tests/conftest.py).
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

__all__ = ["BallImage", "Directions", "Disc", "Image", "Latlong", "Mask"]

Image = Float[Tensor, "b h w c"]
"""ComfyUI's layout. Display-encoded in [0, 1] (`_ldr`) or linear radiance (`_hdr`), as the function says."""

Latlong = Float[Tensor, "b h w c"]
"""An equirectangular map, w = 2 h, row 0 up, centre column straight ahead."""

BallImage = Float[Tensor, "b d d c"]
"""A square crop around a mirror ball."""

Mask = Float[Tensor, "b h w"]
"""ComfyUI's MASK: 1 inside, 0 outside."""

Directions = Float[Tensor, "*n 3"]
"""Unit vectors: +X right of the photograph, +Y up, -Z where the camera looks."""

Disc = Float[Tensor, "*n 2"]
"""Points of the unit disc a mirror ball covers: x right, y up."""
