"""Path-traced scenes: directions as everywhere in the package, energy kept, seeds that repeat."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dl_core.errors import OptionError
from dl_core.geometry import latlong_directions
from dl_core.training.scenes import rendered

pytest.importorskip("mitsuba", reason="NO MITSUBA: the extra train is not installed")
pytest.importorskip("pyoidn", reason="NO DENOISER: the extra train is not installed")


@pytest.fixture(scope="module")
def mitsuba() -> Any:
    library, _ = rendered._libraries()
    if library.variant().startswith("scalar"):
        pytest.skip("NO LLVM: Mitsuba renders scenes with LLVM 16 or newer only")
    return library


@pytest.mark.parametrize("towards", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0.6, 0.48, -0.64)])
def test_a_light_is_where_the_convention_says(mitsuba: Any, towards: tuple[float, float, float]) -> None:
    lamp = {
        "type": "sphere",
        "center": [10 * x + y for x, y in zip(towards, (1, 2, 3), strict=True)],
        "radius": 1.5,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
    }
    scene = mitsuba.load_dict({"type": "scene", "lamp": lamp})
    image = torch.from_numpy(rendered._trace(mitsuba, scene, [1.0, 2.0, 3.0], 64, 4, 0))
    away = torch.acos((latlong_directions(64) * torch.tensor(towards)).sum(-1).clamp(-1, 1))
    size = math.asin(0.15)
    assert torch.allclose(image[away < size - 0.06], torch.tensor([1.0, 2.0, 3.0]))
    assert float(image[away > size + 0.06].abs().max()) == 0


def test_a_furnace_is_even(mitsuba: Any) -> None:
    """Inside a sphere of albedo a that shines with 1, radiance is 1 + a + a^2 ... up to the longest path."""
    albedo = 0.5
    inside = {
        "type": "sphere",
        "radius": 5.0,
        "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    scene = mitsuba.load_dict({"type": "scene", "furnace": inside})
    image = rendered._trace(mitsuba, scene, [0.0, 0.0, 0.0], 16, 256, 0)
    expected = sum(albedo**k for k in range(rendered.DEPTH))
    assert image.mean() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_scenes_are_light_and_repeat(mitsuba: Any, seed: int) -> None:
    panorama = rendered.render_panorama(seed, 32, samples=8)
    assert panorama.shape == (1, 32, 64, 3)
    assert torch.isfinite(panorama).all()
    assert panorama.min() >= 0
    assert float(panorama.mean(dim=-1).median()) == pytest.approx(0.2, rel=1e-3)
    again = rendered.render_panorama(seed, 32, samples=8)
    # The scene is the same. Its noise is not always: two orders of the lights were seen, means 0.2% apart.
    assert float(again.mean()) == pytest.approx(float(panorama.mean()), rel=0.02)
    blocks = [torch.nn.functional.avg_pool2d(light.permute(0, 3, 1, 2), 8) for light in (again, panorama)]
    assert torch.corrcoef(torch.stack([block.flatten() for block in blocks]))[0, 1] > 0.98


def test_denoising_keeps_the_energy_and_the_seam(mitsuba: Any) -> None:
    _, denoiser = rendered._libraries()
    smooth = torch.nn.functional.interpolate(torch.rand(1, 3, 4, 8) * 8, (64, 128), mode="bilinear")[0]
    smooth = torch.cat((smooth, smooth.flip(-1)), dim=-1).permute(1, 2, 0).numpy()  # the same at both edges
    noisy = (smooth * np.random.default_rng(0).gamma(16, 1 / 16, smooth.shape)).astype(np.float32)
    clean = rendered._denoised(denoiser, noisy)
    assert clean.mean() == pytest.approx(noisy.mean(), rel=0.01)
    assert np.abs(clean - smooth).mean() < 0.3 * np.abs(noisy - smooth).mean()
    assert np.abs(clean[:, 0] - clean[:, -1]).mean() < 2 * np.abs(np.diff(clean, axis=1)).mean()


def test_without_mitsuba_the_extra_is_named(tmp_path: Path) -> None:
    script = (
        "import sys; sys.modules['mitsuba'] = None\n"
        "from dl_core.cli import main\n"
        "sys.exit(main(['train', 'scenes', '--out', sys.argv[1], '--drawn', '0', '--rendered', '1']))"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 2
    assert (
        "--rendered is 'scenes without mitsuba'; accepted: 0, or mitsuba and pyoidn installed (the extra train)"
        in done.stderr
    )


def test_scalar_mitsuba_is_refused(mitsuba: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    class Scalar:
        @staticmethod
        def variant() -> str:
            return "scalar_rgb"

        @staticmethod
        def load_dict(what: Any) -> Any:
            return what

    with pytest.raises(OptionError, match="LLVM 16 or newer"):
        rendered._trace(Scalar, None, [0, 0, 0], 8, 1, 0)
