"""Figures the paper prints, to stand beside ours. Each row says what data it is on; sets are not comparable.

Source: DiffusionLight, Table 1 (three spheres), Table 2 (array of spheres), Table 3 (random
camera), Table 4 (LDR maps).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

__all__ = ["PUBLISHED", "Published"]


@dataclass(frozen=True)
class Published:
    """A line of one of the paper's tables.

    Attributes:
        protocol: that it was measured by.
        data: panoramas it was measured on.
        method: as the paper names it.
        sphere: material; "array" and "map" where no single sphere is scored.
        si_rmse: scale-invariant RMSE.
        angular_error_deg: degrees.
        normalized_rmse: None where the table has none.
        rmse: likewise.
    """

    protocol: str
    data: str
    method: str
    sphere: str
    si_rmse: float
    angular_error_deg: float
    normalized_rmse: float | None = None
    rmse: float | None = None


def _spheres(
    protocol: str,
    data: str,
    method: str,
    si: tuple[float, ...],
    angle: tuple[float, ...],
    normalized: tuple[float, ...],
) -> tuple[Published, ...]:
    spheres = ("diffuse", "matte", "mirror")
    return tuple(Published(protocol, data, method, *line) for line in zip(spheres, si, angle, normalized, strict=True))


_LAVAL, _HAVEN, _ARRAY = "Laval Indoor (289)", "Poly Haven (500)", "Laval Indoor (224)"

PUBLISHED: Final[tuple[Published, ...]] = (
    *_spheres("three-spheres", _LAVAL, "base", (0.20, 0.45, 0.72), (5.87, 6.20, 8.28), (0.32, 0.47, 0.51)),
    *_spheres("three-spheres", _LAVAL, "base + iterative", (0.15, 0.39, 0.67), (3.58, 4.55, 7.05), (0.25, 0.41, 0.47)),
    *_spheres("three-spheres", _LAVAL, "base + LoRA", (0.15, 0.38, 0.65), (3.47, 3.86, 6.15), (0.25, 0.40, 0.45)),
    *_spheres(
        "three-spheres", _LAVAL, "base + iterative + LoRA", (0.14, 0.33, 0.60), (2.14, 3.42, 5.94), (0.20, 0.36, 0.43)
    ),
    *_spheres("three-spheres", _HAVEN, "base", (0.22, 0.59, 0.80), (2.98, 4.25, 5.74), (0.30, 0.50, 0.54)),
    *_spheres("three-spheres", _HAVEN, "base + iterative", (0.16, 0.50, 0.73), (2.57, 4.18, 5.31), (0.22, 0.44, 0.50)),
    *_spheres("three-spheres", _HAVEN, "base + LoRA", (0.16, 0.50, 0.72), (2.35, 3.56, 4.43), (0.24, 0.43, 0.47)),
    *_spheres(
        "three-spheres", _HAVEN, "base + iterative + LoRA", (0.14, 0.45, 0.66), (2.14, 3.60, 4.29), (0.20, 0.39, 0.43)
    ),
    Published("array", _ARRAY, "base + iterative + LoRA", "array", 0.090, 5.25),
    Published("array", _ARRAY, "EverLight", "array", 0.091, 6.36),
    Published("array", _ARRAY, "StyleLight", "array", 0.123, 7.09),
    Published("array", _ARRAY, "Weber et al.", "array", 0.081, 4.13),
    Published("array", _ARRAY, "EMLight", "array", 0.099, 3.99),
    *_spheres(
        "random-camera",
        _LAVAL,
        "base + iterative + LoRA",
        (0.135, 0.359, 0.644),
        (2.337, 3.483, 5.988),
        (0.219, 0.369, 0.438),
    ),
    Published("ldr", _LAVAL, "base + iterative + LoRA", "map", 0.303, 4.412, rmse=0.187),
    Published("ldr", _HAVEN, "base + iterative + LoRA", "map", 0.275, 4.567, rmse=0.179),
)
"""The paper's own method and its ablated versions; of the array of spheres, other methods too."""
