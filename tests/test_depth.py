"""Depth through transformers' models of toy size: conventions, sizes, and what is refused.

Values are held against transformers' own pipeline on the same folder.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from depth_models import save_depth_anything, save_dpt
from PIL import Image as PILImage
from safetensors.torch import load_file, save_file
from tolerances import assert_close

from dl_core.depth import CONVENTIONS, NEAREST, DepthModel, load_depth_model
from dl_core.errors import ImageError, ModelError

SAVERS: dict[str, Callable[[Path], Path]] = {
    "dpt": save_dpt,
    "depth_anything": save_depth_anything,
    "metric": lambda folder: save_depth_anything(folder, "metric"),
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: save(tmp_path_factory.mktemp(name)) for name, save in SAVERS.items()}


@pytest.fixture(scope="module")
def photo() -> torch.Tensor:
    """(1, 90, 140, 3), smooth, in steps of 8 bits as the pipeline is given them."""
    coarse = torch.rand(1, 3, 5, 7, generator=torch.Generator().manual_seed(3))
    fine = torch.nn.functional.interpolate(coarse, (90, 140), mode="bilinear").permute(0, 2, 3, 1)
    return (fine * 255).round() / 255


def predicted_by_transformers(folder: Path, photo: torch.Tensor) -> torch.Tensor:
    from transformers import pipeline

    picture = PILImage.fromarray((photo[0] * 255).round().byte().numpy())
    return pipeline("depth-estimation", model=str(folder))(picture)["predicted_depth"].squeeze()


@pytest.mark.parametrize("kind", ["dpt", "depth_anything"])
def test_inverse_depth_is_what_transformers_predicts_stretched(
    folders: dict[str, Path], photo: torch.Tensor, kind: str
) -> None:
    depth = load_depth_model(folders[kind])(photo)
    reference = predicted_by_transformers(folders[kind], photo)
    assert depth.shape == (1, 90, 140, 1)
    assert_close(depth[0, ..., 0], (reference - reference.min()) / (reference.max() - reference.min()))


def test_distance_is_inverted(folders: dict[str, Path], photo: torch.Tensor) -> None:
    """The bright end is where transformers predicts the least distance."""
    model = load_depth_model(folders["metric"])
    depth = model(photo)[0, ..., 0]
    reference = predicted_by_transformers(folders["metric"], photo)
    assert not model.nearer_is_larger
    # Both are resized after the network, there in metres and here in their inverse, which differs where it is steep.
    assert torch.corrcoef(torch.stack([depth.flatten(), (1 / reference).flatten()]))[0, 1] > 0.99
    assert (float(depth.min()), float(depth.max())) == (0, 1)


@dataclass
class FixedNetwork:
    """Stands for a network: it predicts what it is told, and remembers where it was."""

    predicted: torch.Tensor
    places: list[str]
    dtype: torch.dtype = torch.float32

    def to(self, place: Any) -> FixedNetwork:
        self.places.append(str(place))
        return self

    def __call__(self, pixels: torch.Tensor) -> Any:
        return SimpleNamespace(predicted_depth=self.predicted)


def fixed(predicted: list[list[float]], *, nearer_is_larger: bool = True) -> DepthModel:
    network = FixedNetwork(torch.tensor([predicted]), [])
    return DepthModel("fixed", network, lambda **inputs: {"pixel_values": torch.zeros(1)}, nearer_is_larger, "meta")


def four(model: DepthModel) -> list[float]:
    return model(torch.zeros(1, 2, 2, 3)).flatten().tolist()


def test_values_in_closed_form() -> None:
    assert four(fixed([[2.0, 4.0], [3.0, 6.0]])) == pytest.approx([0, 0.5, 0.25, 1])
    # 1 / d of 1, 2, 4 metres and of one that is impossible, which counts as the nearest there is.
    assert four(fixed([[1.0, 2.0], [4.0, -5.0]], nearer_is_larger=False)) == pytest.approx(
        [(1 / d - 1 / 4) / (1 / NEAREST - 1 / 4) for d in (1, 2, 4, NEAREST)], abs=1e-6
    )


def test_all_at_one_depth_is_far() -> None:
    assert four(fixed([[3.0, 3.0], [3.0, 3.0]])) == [0, 0, 0, 0]


def test_it_uses_its_device_and_leaves_it() -> None:
    model = fixed([[0.0, 1.0], [2.0, 3.0]])
    four(model)
    assert model.network.places == ["meta", "cpu"]
    broken = replace(model, network=FixedNetwork(torch.zeros(1, 2, 2).fill_(torch.nan), []))
    with pytest.raises(ModelError, match="fixed: estimated a depth of NaN"):
        four(broken)


def test_pictures_of_a_batch_are_stretched_each_by_itself(folders: dict[str, Path], photo: torch.Tensor) -> None:
    model = load_depth_model(folders["depth_anything"])
    together = model(torch.cat([photo, photo.flip(2)]))
    # Order of summation in batched matrix products, stretched to [0, 1].
    torch.testing.assert_close(together[1:], model(photo.flip(2)), rtol=0, atol=1e-4)
    assert torch.equal(together.amax(dim=(1, 2, 3)), torch.ones(2))


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (torch.rand(1, 1, 400, 3), r"400 x 1 pixels; up to 8 times"),
        (torch.full((1, 8, 8, 3), torch.nan), "holds NaN"),
        (torch.rand(1, 0, 8, 3), r"is empty \(8 x 0\)"),
    ],
)
def test_pictures_it_cannot_use_are_named(image: torch.Tensor, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        fixed([[0.0, 1.0], [2.0, 3.0]])(image)


def test_an_empty_folder_says_what_belongs_there(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"holds no config\.json.*preprocessor_config\.json and model\.safetensors"):
        load_depth_model(tmp_path)


def test_an_id_that_is_not_here_names_the_cache_and_downloads_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import socket

    from huggingface_hub.constants import HF_HUB_CACHE

    def refuse(*arguments: Any) -> None:
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    with pytest.raises(ModelError, match="no complete model of that id") as raised:
        load_depth_model("nobody/no-such-depth-model")
    assert str(HF_HUB_CACHE) in str(raised.value)
    assert "or allow the download" in str(raised.value)


def test_a_model_of_another_kind_is_refused_with_the_known_ones(folders: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "clip", "architectures": ["CLIPModel"]}))
    with pytest.raises(ModelError, match=f"is a clip model; accepted: {', '.join(CONVENTIONS)}"):
        load_depth_model(tmp_path)


def copied(folder: Path, target: Path) -> Path:
    for file in folder.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    return target


@pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json", "model.safetensors"])
def test_a_broken_file_is_one_clear_error(folders: dict[str, Path], tmp_path: Path, name: str) -> None:
    folder = copied(folders["dpt"], tmp_path)
    (folder / name).write_bytes(b"not what it should be")
    with pytest.raises(ModelError, match="cannot be loaded"):
        load_depth_model(folder)


def test_missing_weights_are_told_but_for_the_one_that_has_no_use(folders: dict[str, Path], tmp_path: Path) -> None:
    """The authors' DPT is published without the first fusion layer's residual part, which is never run."""
    folder = copied(folders["dpt"], tmp_path)
    weights = load_file(folder / "model.safetensors")
    unused = [name for name in weights if "fusion_stage.layers.0.residual_layer1." in name]
    assert unused
    photo = torch.rand(1, 30, 40, 3, generator=torch.Generator().manual_seed(0))
    whole = load_depth_model(folder)(photo)
    save_file({name: weights[name] for name in weights if name not in unused}, folder / "model.safetensors")
    assert torch.equal(load_depth_model(folder)(photo), whole)
    save_file(
        {name: tensor for name, tensor in weights.items() if not name.startswith("head.")},
        folder / "model.safetensors",
    )
    with pytest.raises(ModelError, match=r"lacks \d+ of its weights, such as head\."):
        load_depth_model(folder)


def test_importing_it_does_not_import_transformers() -> None:
    code = "import sys, dl_core.depth; assert 'transformers' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent.parent)
