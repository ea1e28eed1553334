"""Files that are damaged at random: each reader gives something that can be used, or says what is wrong.

A file is damaged by bytes that are changed, cut out or put in, or by what follows being cut off. Readers of structured
text also get JSON of all shapes. Whatever else than a `ProbeError` comes out of a reader is a mistake of its own.
"""

# ruff: noqa: PT017  errors are one of two outcomes here

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image
from safetensors.torch import save

from dl_core.backends.mini import MINI_FOLDER, MiniModel, read_weights
from dl_core.errors import ProbeError
from dl_core.imageio import (
    exr_channels,
    read_envmap,
    read_exr_header,
    read_photograph,
    read_render,
    write_exr,
    write_hdr,
)
from dl_core.lora import read_lora
from dl_core.queueing.ledger import RECORDS, Ledger
from dl_core.queueing.workflow import read_workflow
from dl_core.training.data.pairs import FORMAT, INDEX, PairShards
from dl_core.training.data.shards import Shard, is_whole, png_bytes, write_pairs
from dl_core.training.panoramas import panorama_files

WORKFLOWS = Path(__file__).resolve().parent.parent / "workflows"
SHAPES = {"down.to_q": (8, 8), "mid.to_k": (8, 6)}

quick = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)


# --- damage ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Damage:
    """What happens to a file at a share of its length: `length` bytes there become `put`."""

    place: float
    length: int
    put: bytes

    def of(self, content: bytes) -> bytes:
        start = int(self.place * len(content))
        return content[:start] + self.put + content[start + self.length :]


DAMAGE = st.lists(
    st.one_of(
        # Headers are short and full of meaning, so half of the damage is done near the front.
        st.builds(Damage, st.floats(0, 0.05), st.integers(0, 8), st.binary(max_size=8)),
        st.builds(Damage, st.floats(0, 1), st.integers(0, 64), st.binary(max_size=64)),
        st.builds(Damage, st.floats(0, 1), st.just(1 << 30), st.just(b"")),
    ),
    min_size=1,
    max_size=4,
)


def damaged(content: bytes, damage: list[Damage]) -> bytes:
    for one in damage:
        content = one.of(content)
    return content


# --- pictures and maps -------------------------------------------------------------------------------------------


@cache
def picture(kind: str) -> bytes:
    codes = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(codes).save(file, kind, **({"exif": _exif()} if kind in ("JPEG", "PNG", "WEBP", "TIFF") else {}))
    return file.getvalue()


def _exif() -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = 6  # orientation
    exif[0xA405] = 35  # focal length on 35 mm film
    return exif


@cache
def light(kind: str, folder: Path) -> bytes:
    latlong = torch.rand((16, 32, 3), generator=torch.Generator().manual_seed(0)) * 4
    path = folder / f"whole{kind}"
    if kind == ".exr":
        write_exr(path, latlong, metadata={"lightprobe:seed": "3"})
    else:
        write_hdr(path, latlong)
    return path.read_bytes()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "GIF", "BMP", "PPM"])
@given(damage=DAMAGE)
@quick
def test_damaged_photographs(kind: str, damage: list[Damage], tmp_path: Path) -> None:
    path = tmp_path / f"photo.{kind.lower()}"
    path.write_bytes(damaged(picture(kind), damage))
    try:
        photo = read_photograph(path)
    except ProbeError as error:
        assert str(path) in str(error)
        return
    assert photo.ndim == 4
    assert photo.shape[0] == 1
    assert photo.shape[3] == 3
    assert photo.min() >= 0
    assert photo.max() <= 1


MAP_READERS: dict[str, Callable[[Path], Any]] = {
    "read_envmap": read_envmap,
    "read_render": read_render,
    "read_exr_header": read_exr_header,
    "exr_channels": exr_channels,
}


@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
@pytest.mark.parametrize("reader", MAP_READERS)
@given(damage=DAMAGE)
@quick
def test_damaged_maps(reader: str, suffix: str, damage: list[Damage], tmp_path: Path) -> None:
    path = tmp_path / f"map{suffix}"
    path.write_bytes(damaged(light(suffix, tmp_path.parent), damage))
    try:
        found = MAP_READERS[reader](path)
    except ProbeError as error:
        assert str(path) in str(error)
        return
    if reader == "read_envmap":
        assert found.shape[2] == 2 * found.shape[1]
        assert torch.isfinite(found).all()
        assert found.min() >= 0


# --- weights -----------------------------------------------------------------------------------------------------


def _lora() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        f"unet.{layer}.lora_{half}.weight": torch.randn(shape, generator=generator)
        for layer, (rows, columns) in SHAPES.items()
        for half, shape in (("A", (4, columns)), ("B", (rows, 4)))
    }


@given(damage=DAMAGE)
@quick
def test_damaged_weights(damage: list[Damage], tmp_path: Path) -> None:
    path = tmp_path / "lora.safetensors"
    path.write_bytes(damaged(save(_lora()), damage))
    try:
        found = read_lora(read_weights(path), SHAPES, path)
    except ProbeError as error:
        assert str(path) in str(error)
        return
    assert all(low_rank.fits(SHAPES[layer]) for layer, low_rank in found.items())


# --- text --------------------------------------------------------------------------------------------------------

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
NESTED = b"[" * 100_000
"""Deeper than any parser follows."""


def replaced(document: Any, place: int, value: Any) -> Any:
    """A document with the node of a number, counted in depth, replaced."""
    left = [place]

    def walk(node: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            left[0] = 1 << 60
            return value
        if isinstance(node, dict):
            return {key: walk(item) for key, item in node.items()}
        return [walk(item) for item in node] if isinstance(node, list) else node

    return walk(document)


def texts(document: Any) -> st.SearchStrategy[bytes]:
    """A JSON file damaged in its bytes, or with a part of it replaced."""
    whole = json.dumps(document).encode()
    return st.one_of(
        st.builds(lambda damage: damaged(whole, damage), DAMAGE),
        st.builds(lambda place, value: json.dumps(replaced(document, place, value)).encode(), st.integers(0, 60), JSON),
        st.builds(lambda value: json.dumps(value).encode(), JSON),
    )


FLOW = json.loads((WORKFLOWS / "mini_quickstart.api.json").read_text())


@given(content=texts(FLOW))
@example(content=NESTED)
@quick
def test_damaged_workflows(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "flow.json"
    path.write_bytes(content)
    try:
        workflow = read_workflow(path)
        assert workflow.savers
        assert len(workflow.identity) == 64
        workflow.with_photo("a.png")
        workflow.with_seed(3)
    except ProbeError as error:
        assert str(path) in str(error) or "seed" in str(error)


@given(content=texts([{"file": "a.exr", "split": "training"}, {"file": "b.exr", "split": "validation"}]))
@example(content=NESTED)
@quick
def test_damaged_manifests(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_bytes(content)
    try:
        found = panorama_files(tmp_path, "training")
    except ProbeError as error:
        assert str(tmp_path) in str(error) or "split" in str(error)
        return
    assert all(isinstance(path, Path) for path in found)


RECORD = {"key": "k" * 64, "name": "photo", "photo": "photo.jpg", "files": ["photo.exr"]}


@given(content=texts(RECORD))
@example(content=NESTED)
@quick
def test_damaged_records_are_run_again(content: bytes, tmp_path: Path) -> None:
    (tmp_path / RECORDS).mkdir(exist_ok=True)
    (tmp_path / RECORDS / f"{'k' * 32}.json").write_bytes(content)
    ledger = Ledger(tmp_path)
    record = ledger.record("k" * 64, Path("photo.jpg"))
    assert record.name
    assert not ledger.finished(record)


@given(content=texts(json.loads((MINI_FOLDER / "mini.json").read_text())))
@example(content=NESTED)
@settings(quick, max_examples=15)
def test_damaged_settings_of_the_mini_model(content: bytes, tmp_path: Path) -> None:
    if not (tmp_path / "tokenizer").exists():
        (tmp_path / "tokenizer").symlink_to(MINI_FOLDER / "tokenizer")
    (tmp_path / "mini.json").write_bytes(content)
    try:
        defaults = MiniModel.untrained(tmp_path).defaults
    except ProbeError as error:
        assert "mini.json" in str(error)
        return
    assert defaults.canvas > defaults.diameter > 0
    assert isinstance(defaults.prompt, str)


# --- shards ------------------------------------------------------------------------------------------------------


SHARD = Shard("training", 0, 0, 1)
PAIR = {"ball": {"left": 8, "top": 8, "diameter": 16, "canvas": 32, "dilation": 2}, "ev": -1.0, "panorama": "sky"}


def shard(folder: Path) -> bytes:
    """A whole shard of one pair, written to the folder."""
    picture = png_bytes(torch.rand((32, 32, 3), generator=torch.Generator().manual_seed(0)))
    members = {"image.png": picture, "mask.png": picture, "depth.png": picture, "json": json.dumps(PAIR).encode()}
    return write_pairs(folder / SHARD.file, [(0, members)]).read_bytes()


def read_pair(folder: Path) -> None:
    try:
        pair = PairShards(folder)[0]
    except ProbeError as error:
        assert str(folder) in str(error) or "split" in str(error)
        return
    assert pair.image.shape[0] == 1
    assert pair.image.shape[3] == 3
    assert pair.ball.diameter > 0
    assert isinstance(pair.ev, float | int)


@given(damage=DAMAGE)
@quick
def test_damaged_shards(damage: list[Damage], tmp_path: Path) -> None:
    content = damaged(shard(tmp_path), damage)
    (tmp_path / SHARD.file).write_bytes(content)
    entry = {"file": SHARD.file, "split": "training", "pairs": 1, "bytes": len(content)}
    (tmp_path / INDEX).write_text(json.dumps({"format": FORMAT, "shards": [entry]}))
    assert is_whole(tmp_path, SHARD) in (True, False)
    read_pair(tmp_path)


def test_a_whole_shard_is_read(tmp_path: Path) -> None:
    entry = {"file": SHARD.file, "split": "training", "pairs": 1, "bytes": len(shard(tmp_path))}
    (tmp_path / INDEX).write_text(json.dumps({"format": FORMAT, "shards": [entry]}))
    assert is_whole(tmp_path, SHARD)
    assert PairShards(tmp_path)[0].ev == -1.0


@given(content=texts({"format": FORMAT, "shards": [{"file": SHARD.file, "split": "training", "pairs": 1, "bytes": 1}]}))
@example(content=NESTED)
@quick
def test_damaged_indices(content: bytes, tmp_path: Path) -> None:
    shard(tmp_path)
    (tmp_path / INDEX).write_bytes(content)
    read_pair(tmp_path)
