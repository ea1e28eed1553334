"""Set-up of the test suite: run-time shape checks on, seeded randomness."""

from __future__ import annotations

import pytest
import torch
from hypothesis import settings
from jaxtyping import install_import_hook

# Before anything of the library is imported: its jaxtyping annotations are checked in tests, and only there.
install_import_hook("dl_core", "shape_checks.check")

# Two busy cores make times meaningless; a failing example is printed and can be repeated.
settings.register_profile("suite", deadline=None, max_examples=30, derandomize=True, print_blob=True)
settings.load_profile("suite")


@pytest.fixture
def generator() -> torch.Generator:
    """A CPU generator with a fixed seed."""
    return torch.Generator().manual_seed(20240617)


@pytest.fixture
def smooth_map() -> torch.Tensor:
    """(1, 64, 128, 3) radiance, smooth over the whole sphere: a different direction brightens each channel."""
    from dl_core.geometry import latlong_directions

    return torch.exp(latlong_directions(64))[None]
