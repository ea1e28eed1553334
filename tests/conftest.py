"""Set-up of the test suite: run-time shape checks on, seeded randomness."""

from __future__ import annotations

import importlib.util

import pytest
import torch
from hypothesis import settings
from jaxtyping import install_import_hook

# Before anything of the library is imported: its jaxtyping annotations are checked in tests, and only there.
install_import_hook("dl_core", "shape_checks.check")

# The web client's tests talk to ComfyUI's server and to a browser; its client library comes with ComfyUI.
HAS_AIOHTTP = importlib.util.find_spec("aiohttp") is not None
collect_ignore = [] if HAS_AIOHTTP else ["browser"]

# Two busy cores make times meaningless; a failing example is printed and can be repeated.
settings.register_profile("suite", deadline=None, max_examples=30, derandomize=True, print_blob=True)
settings.load_profile("suite")


def pytest_report_header() -> list[str]:
    """Say what is left out before anything is collected."""
    return [] if HAS_AIOHTTP else ["lightprobe: tests/browser is left out, aiohttp is not installed"]


@pytest.fixture
def generator() -> torch.Generator:
    """A CPU generator with a fixed seed."""
    return torch.Generator().manual_seed(20240617)


@pytest.fixture
def smooth_map() -> torch.Tensor:
    """(1, 64, 128, 3) radiance, smooth over the whole sphere: a different direction brightens each channel."""
    from dl_core.geometry import latlong_directions

    return torch.exp(latlong_directions(64))[None]
