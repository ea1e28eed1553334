"""SaveEnvMap and LoadEnvMap: files, folders and refusals."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from comfy_host import pack_module

Nodes = Callable[[str], Any]
OPTIONS = {"filename_prefix": "probe", "precision": "half", "radiance_hdr": False}


def saver(node: Nodes, **hidden: Any) -> Any:
    """The node with what ComfyUI hides in it during a run."""
    kind = node("SaveEnvMap")
    values = SimpleNamespace(**{"prompt": None, "extra_pnginfo": None, **hidden})
    return type("Running", (kind,), {"hidden": values})


@pytest.fixture
def latlong(generator: torch.Generator) -> torch.Tensor:
    return torch.rand(1, 8, 16, 3, generator=generator) * 30


def test_saved_map_comes_back_with_its_origin(node: Nodes, folders: Path, latlong: torch.Tensor) -> None:
    kind = saver(node, prompt={"1": {"class_type": "X"}}, extra_pnginfo={"workflow": {"nodes": []}})
    output = kind.execute(latlong, report="EV 0: 1 ball", **OPTIONS)
    path = folders / "output" / "probe_00001_.exr"
    assert output.args == (str(path),)
    io = pack_module("dl_core.imageio")
    torch.testing.assert_close(io.read_envmap(path), latlong, rtol=1e-3, atol=0)
    header = io.read_exr_header(path)
    assert header["prompt"] == '{"1": {"class_type": "X"}}'
    assert header["workflow"] == '{"nodes": []}'
    assert header["lightprobe"] == "EV 0: 1 ball"
    assert {"chromaticities", "envmap"} <= set(header)


def test_client_hears_of_file_and_preview(node: Nodes, folders: Path, latlong: torch.Tensor) -> None:
    ui = saver(node).execute(latlong, **(OPTIONS | {"filename_prefix": "sub/probe", "radiance_hdr": True})).ui
    assert ui["envmaps"] == [
        {"filename": f"probe_00001_{suffix}", "subfolder": "sub", "type": "output"} for suffix in (".exr", ".hdr")
    ]
    (preview,) = ui["images"]
    assert preview["type"] == "temp"
    assert (folders / "temp" / preview["filename"]).is_file()
    assert {path.name for path in (folders / "output" / "sub").iterdir()} == {"probe_00001_.exr", "probe_00001_.hdr"}


def test_every_map_of_a_batch_is_saved_and_none_overwritten(node: Nodes, folders: Path) -> None:
    kind = saver(node)
    maps = torch.stack([torch.full((4, 8, 3), float(value)) for value in (1, 2)])
    kind.execute(maps, **OPTIONS)
    (folders / "output" / "probe_00003_.hdr").touch()
    third = kind.execute(maps[:1] * 7, **OPTIONS).args[0]
    assert Path(third).name == "probe_00004_.exr"
    read = pack_module("dl_core.imageio").read_envmap
    assert [float(read(path).mean()) for path in sorted((folders / "output").glob("*.exr"))] == [1, 2, 7]


def test_float_precision(node: Nodes, folders: Path, latlong: torch.Tensor) -> None:
    path = saver(node).execute(latlong, **(OPTIONS | {"precision": "float"})).args[0]
    assert torch.equal(pack_module("dl_core.imageio").read_envmap(path), latlong)


@pytest.mark.parametrize("prefix", ["../probe", "sub/../../probe", "/tmp/elsewhere/probe", "", "  "])
def test_prefix_that_leaves_the_output_folder_is_refused(
    node: Nodes, folders: Path, latlong: torch.Tensor, prefix: str
) -> None:
    errors = pack_module("dl_core.errors")
    with pytest.raises(errors.OutputError, match="filename_prefix has to name a file inside the output folder"):
        saver(node).execute(latlong, **(OPTIONS | {"filename_prefix": prefix}))
    assert not list(folders.rglob("*.exr"))


def test_folder_that_cannot_be_made_is_refused(node: Nodes, folders: Path, latlong: torch.Tensor) -> None:
    (folders / "output" / "taken").write_text("a file")
    errors = pack_module("dl_core.errors")
    with pytest.raises(errors.OutputError, match="taken"):
        saver(node).execute(latlong, **(OPTIONS | {"filename_prefix": "taken/probe"}))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission_is_refused(node: Nodes, folders: Path, latlong: torch.Tensor) -> None:
    (folders / "output").chmod(0o500)
    errors = pack_module("dl_core.errors")
    with pytest.raises(errors.OutputError, match="cannot be written"):
        saver(node).execute(latlong, **OPTIONS)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (torch.full((1, 4, 8, 3), float("nan")), "latlong: holds 96 NaN"),
        (torch.full((1, 4, 8, 3), -1.0), "latlong: holds 96 negative"),
        (torch.rand(1, 4, 4, 3), "latlong: has shape"),
        (torch.rand(1, 4, 8, 2), "latlong: has shape"),
    ],
)
def test_map_that_is_no_light_is_refused_and_nothing_written(
    node: Nodes, folders: Path, bad: torch.Tensor, message: str
) -> None:
    errors = pack_module("dl_core.errors")
    with pytest.raises(errors.ImageError, match=message):
        saver(node).execute(bad, **OPTIONS)
    assert not [path for path in folders.rglob("*") if path.is_file()]


def test_loader_lists_reads_and_notices_changes(node: Nodes, folders: Path, latlong: torch.Tensor) -> None:
    io, kind = pack_module("dl_core.imageio"), node("LoadEnvMap")
    path = folders / "input" / "sky.exr"
    io.write_exr(path, latlong[0], metadata={}, half=False)
    (folders / "input" / "photo.png").touch()
    assert kind.define_schema().inputs[0].options == ["sky.exr"]
    assert torch.equal(kind.execute("sky.exr").args[0], latlong)
    assert kind.validate_inputs("sky.exr") is True
    before = kind.fingerprint_inputs("sky.exr")
    os.utime(path, (1, 1))
    assert kind.fingerprint_inputs("sky.exr") != before
    assert "'gone.exr' is not in ComfyUI's input folder" in kind.validate_inputs("gone.exr")


def test_loader_refuses_what_is_no_map(node: Nodes, folders: Path) -> None:
    (folders / "input" / "broken.exr").write_bytes(b"v/1\x01 and no more")
    errors = pack_module("dl_core.errors")
    with pytest.raises(errors.ImageError, match=r"broken\.exr"):
        node("LoadEnvMap").execute("broken.exr")
