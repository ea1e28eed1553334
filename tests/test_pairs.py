"""Training pairs: what they show, how they are stored and read, and what stops a run or does not."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as PILImage

from dl_core.ball import Frame, crop_ball, disc_mask, paint_depth, place_ball
from dl_core.cli import main
from dl_core.errors import ImageError, OptionError, OutputError
from dl_core.exposure import decode_display, expose, quantize
from dl_core.geometry import ball_coverage
from dl_core.imageio import read_envmap, write_exr
from dl_core.training.data.pair_data import DataOptions, hold_out, make_pairs
from dl_core.training.data.pair_sampler import PairOptions, PairSampler
from dl_core.training.data.pairs import PairShards
from dl_core.training.data.shards import pair_members, planned_shards
from dl_core.training.data.views import Camera
from dl_core.training.scenes.procedural import draw_panorama

ROOT = Path(__file__).parents[1]
SMALL = PairOptions(canvas=64, diameter=24, central=0.5, augment=True)
ASPECTS = (1.0, 4 / 3, 3 / 2, 16 / 9, 3 / 4, 2 / 3)


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of five HDR panoramas of 64 rows."""
    folder = tmp_path_factory.mktemp("maps")
    for seed in range(5):
        panorama = draw_panorama(seed, 64)[0]
        write_exr(folder / f"scene{seed}.exr", panorama * (8 / panorama.max().clamp(max=8)), metadata={})
    return folder


def sampler(maps: Path, options: PairOptions = SMALL, stream: str = "training") -> PairSampler:
    return PairSampler({path.name: path for path in maps.iterdir()}, options, stream)


def make(maps: Path, out: Path, *, count: int = 7, size: int = 3, validation: float = 0.0, **options: object) -> Path:
    data = DataOptions(count, size, validation)
    return make_pairs([maps], None, out, replace(SMALL, **options), data, lambda line: None)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- what a pair shows ---------------------------------------------------------------------------------------------


def uniform(folder: Path, level: float) -> PairSampler:
    folder.mkdir(exist_ok=True)
    write_exr(folder / "even.exr", torch.full((64, 128, 3), level), metadata={})
    return sampler(folder)


def on_photograph(frame: Frame, side: int) -> torch.Tensor:
    inside = torch.zeros(1, side, side, 1)
    frame.cut(inside).fill_(1)
    return inside[0, ..., 0]


@pytest.mark.parametrize("index", range(6))
def test_in_even_light_the_photograph_is_at_nine_tenths_and_the_ball_at_its_ev(tmp_path: Path, index: int) -> None:
    """Everything in a furnace has its radiance: the percentile is it, whatever camera and ball."""
    options = replace(SMALL, augment=False)
    take = PairSampler(uniform(tmp_path / "maps", 3.0).panoramas, options).take(index)
    image, ball = take.pair.image[0], take.pair.ball
    assert take.scale == pytest.approx(0.9**2.4 / 3, rel=1e-6)
    cover = torch.zeros(1, 64, 64, 1)
    crop_ball(cover, ball).copy_(ball_coverage(ball.diameter)[None, ..., None])
    photo = 0.9 * on_photograph(take.frame, 64)
    expected = torch.lerp(photo, torch.tensor(0.9 * 2 ** (take.pair.ev / 2.4)), cover[0, ..., 0])
    # Half a code of 8 bits, and the outline's coverage by 16 x 16 samples a pixel: below 1 / 64 of a full step.
    assert float((image - expected[..., None]).abs().max()) < 0.5 / 255 + 1 / 64


def test_pairs_follow_from_seed_stream_and_index(maps: Path) -> None:
    first, again = sampler(maps).take(11), sampler(maps).take(11)
    assert torch.equal(first.pair.image, again.pair.image)
    assert (first.camera, first.pair.ball, first.pair.ev) == (again.camera, again.pair.ball, again.pair.ev)
    others = [sampler(maps, replace(SMALL, seed=2)).take(11), sampler(maps, stream="validation").take(11)]
    assert len({take.camera.yaw for take in (first, *others, sampler(maps).take(12))}) == 4


def test_every_panorama_is_drawn_as_often_as_any_other(maps: Path) -> None:
    drawn = [sampler(maps)._name(index) for index in range(20)]
    assert all(sorted(drawn[start : start + 5]) == sorted(path.name for path in maps.iterdir()) for start in (0, 5, 10))
    assert len({tuple(drawn[start : start + 5]) for start in (0, 5, 10, 15)}) > 1


def test_augmentation_changes_mirror_exposure_and_tint_alone(maps: Path) -> None:
    plain, augmented = (
        [sampler(maps, replace(SMALL, augment=flag)).take(i) for i in range(12)] for flag in (False, True)
    )
    for one, other in zip(plain, augmented, strict=True):
        assert replace(other.camera, mirrored=False) == one.camera
        assert (one.pair.ball, one.pair.ev, one.frame, one.tint) == (
            other.pair.ball,
            other.pair.ev,
            other.frame,
            (1, 1, 1),
        )
    assert {take.camera.mirrored for take in augmented} == {False, True}
    assert len({take.tint for take in augmented}) == 12


@given(
    index=st.integers(0, 10**6),
    central=st.sampled_from([0.0, 0.5, 1.0]),
    canvas=st.sampled_from([64, 128]),
    share=st.floats(0.3, 0.9),
)
def test_what_is_drawn_stays_within_the_options(index: int, central: float, canvas: int, share: float) -> None:
    diameter = max(20, round(canvas * share))
    options = PairOptions(canvas=canvas, diameter=diameter, central=central, elevation=10, roll=4, ev_min=-3)
    drawing = PairSampler({"none": Path("none")}, options)
    generator = drawing._generator(index)
    camera, frame = drawing._camera(generator), drawing._frame(generator)
    ball = drawing._place(generator, frame)
    assert isinstance(camera, Camera)
    assert abs(camera.pitch) <= 30
    assert abs(camera.roll) <= 12
    assert max(frame.width, frame.height) == canvas
    assert (
        min(abs(frame.width / frame.height - aspect) for aspect in ASPECTS) < 1.5 / min(frame.width, frame.height) * 2
    )
    if central == 1:
        assert ball == place_ball(canvas, diameter)
    assert 0 <= ball.left <= canvas - ball.diameter
    assert 0 <= ball.top <= canvas - ball.diameter
    if ball.diameter <= min(frame.width, frame.height) and central == 0:
        assert frame.left - 1 <= ball.left <= frame.left + frame.width - ball.diameter + 1
        assert frame.top - 1 <= ball.top <= frame.top + frame.height - ball.diameter + 1


def test_exposures_are_even_down_to_the_darkest(maps: Path) -> None:
    # Kolmogorov and Smirnov: the largest gap to the even distribution of 200 draws is below 0.115 in 99 of 100 cases.
    evs = sorted(sampler(maps, replace(SMALL, ev_min=-4)).take(index).pair.ev for index in range(200))
    gaps = [abs((ev + 4) / 4 - (place + 0.5) / 200) for place, ev in enumerate(evs)]
    assert max(gaps) < 0.115


def test_the_ball_alone_is_darkened(maps: Path) -> None:
    """The same draw down to a brighter and a darker limit: the photograph stays, decoded ball values scale by 2^ev."""
    one, other = (PairSampler(sampler(maps).panoramas, replace(SMALL, ev_min=low)).draw(3) for low in (-2.0, -4.0))
    assert other.ev == pytest.approx(2 * one.ev)
    outside = disc_mask(one.ball, grow=1)[0] == 0
    assert torch.equal(one.image[0][outside], other.image[0][outside])
    inside = (disc_mask(one.ball, grow=-2)[0, ..., None] > 0) & (one.image[0] < 1) & (other.image[0] > 0.2)
    stops = torch.log2(decode_display(other.image[0][inside]) / decode_display(one.image[0][inside]))
    assert inside.sum() > 20
    # Half a code at 0.2 is 1% of the value, 2.4 times that of the radiance: 0.035 stops, twice.
    assert float((stops - (other.ev - one.ev)).abs().max()) < 0.075


def test_options_out_of_range_are_named() -> None:
    for name, value in {"fov": 0.5, "elevation": -1, "central": 1.5, "ev_min": 1, "canvas": 100, "diameter": 8}.items():
        with pytest.raises(OptionError) as raised:
            replace(SMALL, **{name: value})
        assert raised.value.name == name
    for name, value in {"count": 0, "shard_size": 0, "validation": 1.0}.items():
        with pytest.raises(OptionError) as raised:
            replace(DataOptions(1, 1, 0.0), **{name: value})
        assert raised.value.name == name


# --- shards --------------------------------------------------------------------------------------------------------


def test_stored_pairs_are_those_drawn(maps: Path, tmp_path: Path) -> None:
    make(maps, tmp_path, count=7, size=3)
    stored, drawing = PairShards(tmp_path), sampler(maps)
    assert len(stored) == 7
    for index in (6, 0, 3, 2, -1):
        pair, drawn = stored[index], drawing.draw(index % 7)
        assert pair.image.dtype == torch.float32
        assert torch.equal(pair.image, drawn.image)
        assert (pair.ball, pair.ev, pair.panorama) == (drawn.ball, drawn.ev, drawn.panorama)
    assert len(list(stored)) == 7
    for index in (7, -8):
        with pytest.raises(IndexError):
            stored[index]


def test_members_are_laid_out_as_webdataset_reads_them(maps: Path, tmp_path: Path) -> None:
    make(maps, tmp_path, count=4, size=3)
    with tarfile.open(tmp_path / "training-000001.tar") as tar:
        members = {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]
        assert {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode) for m in tar.getmembers()} == {
            (0, 0, 0, "", "", 0o644)
        }
    assert list(members) == [f"00000003.{kind}" for kind in ("image.png", "mask.png", "depth.png", "json")]
    take = sampler(maps).take(3)
    ball = take.pair.ball
    mask, depth = (np.asarray(PILImage.open(io.BytesIO(members[f"00000003.{kind}.png"]))) for kind in ("mask", "depth"))
    assert np.array_equal(mask, disc_mask(ball, grow=ball.dilation)[0].numpy() * 255)
    assert np.array_equal(depth, paint_depth(None, ball)[0, ..., 0].numpy() * 255)
    record = json.loads(members["00000003.json"])
    assert record["ev"] == take.pair.ev
    assert Camera(**record["camera"]) == take.camera
    assert Frame(**record["photograph"]) == take.frame
    assert record["scale"] == take.scale
    assert tuple(record["tint"]) == take.tint
    assert record["panorama"] == take.pair.panorama


def test_a_record_is_enough_to_see_the_photograph_again(maps: Path) -> None:
    """Panorama, camera, frame, scale and tint give the picture around the ball."""
    from dl_core.geometry import latlong_to_perspective

    record = json.loads(pair_members(sampler(maps).take(5))["json"])
    pair = sampler(maps).draw(5)
    frame, camera = Frame(**record["photograph"]), Camera(**record["camera"])
    photo = latlong_to_perspective(
        read_envmap(maps / record["panorama"]),
        frame.height,
        frame.width,
        fov=camera.fov,
        rotation=camera.axes,
        samples=4,
    )
    again = torch.zeros_like(pair.image)
    frame.cut(again).copy_(expose(photo * record["scale"] * torch.tensor(record["tint"]), 0.0))
    around = disc_mask(pair.ball, grow=1)[0] == 0
    difference = (quantize(again) - pair.image)[0][around]
    assert float(difference.square().mean().sqrt()) < 4 / 255


def test_the_same_options_give_the_same_bytes(maps: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        make(maps, tmp_path / name, count=5, size=2, validation=0.4)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    index = json.loads((tmp_path / "one" / "index.json").read_text())
    assert index["pairs"] == 5
    assert [(shard["file"], shard["pairs"]) for shard in index["shards"]] == [
        ("training-000000.tar", 2),
        ("training-000001.tar", 1),
        ("validation-000000.tar", 2),
    ]
    assert sorted(contents(tmp_path / "one")) == sorted(
        ["index.json", "plan.json", *(shard["file"] for shard in index["shards"])]
    )


@given(pairs=st.integers(0, 50), size=st.integers(1, 20))
def test_shards_hold_every_pair_once(pairs: int, size: int) -> None:
    shards = planned_shards("training", pairs, size)
    assert [index for shard in shards for index in shard.indices] == list(range(pairs))
    assert all(shard.pairs == size for shard in shards[:-1])
    assert len({shard.file for shard in shards}) == len(shards)


@given(count=st.integers(2, 40), share=st.floats(0.01, 0.99), seed=st.integers(0, 9))
def test_no_panorama_is_in_both_splits(count: int, share: float, seed: int) -> None:
    names = [f"{number}" for number in range(count)]
    divided = hold_out(names, share, seed)
    assert sorted(divided["training"] + divided["validation"]) == sorted(names)
    assert divided["training"]
    assert abs(len(divided["validation"]) - share * count) <= 1
    pairs = DataOptions(count, 1, share).pairs
    assert sum(pairs.values()) == count
    assert pairs["training"] >= 1
    assert pairs["validation"] >= 1


def test_validation_pairs_show_panoramas_held_out(maps: Path, tmp_path: Path) -> None:
    make(maps, tmp_path, count=12, size=5, validation=0.3)
    splits = {name: {pair.panorama for pair in PairShards(tmp_path, name)} for name in ("training", "validation")}
    assert not splits["training"] & splits["validation"]
    assert all(splits.values())
    with pytest.raises(OptionError, match="split is 'test'"):
        PairShards(tmp_path, "test")
    assert hold_out(["a", "b"], 0, 1)["validation"] == []
    with pytest.raises(OptionError, match="two or more panoramas"):
        hold_out(["a"], 0.5, 1)


# --- going on ------------------------------------------------------------------------------------------------------


COMMAND = [sys.executable, "-c", "import sys; from dl_core.cli import main; sys.exit(main(sys.argv[1:]))"]


def command(maps: Path, out: Path, *more: str) -> list[str]:
    options = ["--count", "40", "--canvas", "64", "--diameter", "24", "--shard-size", "10", *more]
    return [*COMMAND, "train", "data", "--panoramas", str(maps), "--out", str(out), *options]


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def test_a_killed_run_goes_on_at_the_first_missing_shard(maps: Path, tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(command(maps, whole), check=True, env=environment(), capture_output=True)
    process = subprocess.Popen(command(maps, killed), env=environment(), stderr=subprocess.DEVNULL)
    first = killed / "training-000000.tar"
    deadline = time.monotonic() + 120
    while True:
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        # Stopped, it cannot finish the shard between the look and the kill.
        process.send_signal(signal.SIGSTOP)
        if first.is_file() and list(killed.glob(".training-*")):
            break
        process.send_signal(signal.SIGCONT)
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (killed / "index.json").exists()
    with pytest.raises(OptionError, match="has finished; run the same command again"):
        PairShards(killed)
    written = first.stat().st_mtime_ns
    done = subprocess.run(command(maps, killed), check=True, env=environment(), capture_output=True, text=True)
    assert first.stat().st_mtime_ns == written
    assert "training-000000.tar: is there" in done.stderr
    assert "left by a run that was killed" in done.stderr
    assert contents(killed) == contents(whole)


def test_a_shard_that_was_cut_off_is_made_again(maps: Path, tmp_path: Path) -> None:
    make(maps, tmp_path)
    before = contents(tmp_path)
    for name, damage in (("training-000000.tar", lambda data: data[:3000]), ("training-000002.tar", lambda data: b"")):
        (tmp_path / name).write_bytes(damage(before[name]))
    with pytest.raises(ImageError, match=r"training-000000\.tar: has 3,000 bytes"):
        PairShards(tmp_path)
    (tmp_path / "training-000001.tar").rename(tmp_path / "elsewhere")
    make(maps, tmp_path)
    (tmp_path / "elsewhere").unlink()
    assert contents(tmp_path) == before


def test_a_pair_is_read_without_the_rest_of_its_shard(maps: Path, tmp_path: Path) -> None:
    make(maps, tmp_path, count=3, size=3)
    path = tmp_path / "training-000000.tar"
    whole = PairShards(tmp_path)[2]
    with tarfile.open(path) as tar:
        member = tar.getmember("00000000.image.png")
    data = bytearray(path.read_bytes())
    data[member.offset_data : member.offset_data + member.size] = bytes(member.size)
    path.write_bytes(data)
    damaged = PairShards(tmp_path)
    assert torch.equal(damaged[2].image, whole.image)
    with pytest.raises(ImageError, match=r"damaged at pair 00000000"):
        damaged[0]
    path.unlink()
    with pytest.raises(ImageError, match="is missing"):
        PairShards(tmp_path)


def test_a_rerun_with_other_options_says_what_differs(maps: Path, tmp_path: Path) -> None:
    out, more = tmp_path / "out", tmp_path / "maps"
    make(maps, out, count=2)
    before = contents(out)
    with pytest.raises(OptionError, match=r"differ in ev_min \(-5\.0 there, -4\.0 now\), seed \(1 there, 9 now\)$"):
        make(maps, out, count=2, ev_min=-4.0, seed=9)
    with pytest.raises(OptionError, match=r"count \(2 there, 3 now\)$"):
        make(maps, out, count=3)
    more.mkdir()
    for path in maps.iterdir():
        (more / path.name).write_bytes(path.read_bytes())
    make(more, out, count=2)  # the same maps elsewhere
    (more / "scene0.exr").rename(more / "new.exr")
    (more / "scene1.exr").write_bytes((more / "scene2.exr").read_bytes())
    with pytest.raises(OptionError) as raised:
        make(more, out, count=2)
    for said in ("new.exr (only now)", "scene0.exr (only there)", "scene1.exr (other contents)"):
        assert f"panorama {said}" in str(raised.value)
    assert contents(out) == before


def test_a_folder_of_other_shards_is_refused(maps: Path, tmp_path: Path) -> None:
    (tmp_path / "anything.tar").touch()
    with pytest.raises(OptionError, match="this one holds other shards"):
        make(maps, tmp_path)
    assert list(contents(tmp_path)) == ["anything.tar"]
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(OptionError, match=r"plan\.json can be read"):
        make(maps, tmp_path)
    (tmp_path / "index.json").write_text('{"format": 99}')
    with pytest.raises(OptionError, match="shards of format 1; these have 99"):
        PairShards(tmp_path)


def test_a_disk_that_is_full_leaves_finished_shards_and_says_what_to_do(maps: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: a shard is too long for it."""
    script = (
        "import resource, sys; from dl_core.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    whole, out = tmp_path / "whole", tmp_path / "out"
    make(maps, whole, count=3, size=1)
    out.mkdir()
    finished = ("plan.json", "training-000000.tar")
    for name in finished:
        (out / name).write_bytes((whole / name).read_bytes())
    given = command(maps, out, "--count", "3", "--shard-size", "1", "--central", "0.5", "--augment")[len(COMMAND) :]
    done = subprocess.run([sys.executable, "-c", script, *given], env=environment(), capture_output=True, text=True)
    assert done.returncode == 1
    assert "training-000001.tar: cannot be written (File too large)" in done.stderr
    assert "make room and run the same command again" in done.stderr
    assert sorted(contents(out)) == sorted(finished)
    subprocess.run([*COMMAND, *given], check=True, env=environment(), capture_output=True)
    assert contents(out) == contents(whole)


def test_an_error_while_writing_leaves_no_half_shard(
    maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(tar: tarfile.TarFile, member: tarfile.TarInfo, *_: object) -> None:
        if member.name.startswith("00000004"):
            raise OSError(28, "No space left on device")
        write(tar, member, *_)

    write = tarfile.TarFile.addfile
    monkeypatch.setattr(tarfile.TarFile, "addfile", full)
    with pytest.raises(
        OutputError, match=r"training-000001\.tar: cannot be written \(No space left on device\); shards"
    ):
        make(maps, tmp_path)
    assert sorted(contents(tmp_path)) == ["plan.json", "training-000000.tar"]


def test_a_map_that_vanishes_meanwhile_is_named(maps: Path) -> None:
    with pytest.raises(ImageError, match=r"gone\.exr"):
        PairSampler({"gone.exr": maps / "gone.exr"}, SMALL).draw(0)
    with pytest.raises(OptionError, match="panoramas"):
        PairSampler({}, SMALL)


# --- the command ---------------------------------------------------------------------------------------------------


def test_the_command_says_what_it_leaves_out(maps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = tmp_path / "maps", tmp_path / "out"
    folder.mkdir()
    for path in maps.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    turned = torch.roll(read_envmap(folder / "scene0.exr"), 17, dims=2)
    write_exr(folder / "turned.exr", turned[0], metadata={})
    write_exr(folder / "white.exr", turned[0] / turned.max(), metadata={})
    (folder / "notes.txt").touch()
    given = ["train", "data", "--panoramas", str(folder), "--out", str(out), "--count", "2", "--canvas", "512"]
    assert main([*given, "--diameter", "64"]) == 0
    said = capsys.readouterr()
    assert said.out == f"wrote {out / 'index.json'}\n"
    assert "skipped white.exr: is not HDR" in said.err
    assert "left out turned.exr: shows what scene0.exr shows" in said.err
    assert "5 of 5 maps have less than half the 1393 rows" in said.err
    index = json.loads((out / "index.json").read_text())
    assert index["duplicates"] == {"turned.exr": "scene0.exr"}
    assert list(index["skipped"]) == ["white.exr"]
    assert index["panoramas"]["training"] == sorted(path.name for path in maps.iterdir())


def test_folders_with_nothing_fit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    given = ["train", "data", "--panoramas", str(folder), "--out", str(tmp_path / "out")]
    assert main(given) == 2
    assert "this one holds none" in capsys.readouterr().err
    write_exr(folder / "grey.exr", torch.full((64, 128, 3), 0.5), metadata={})
    assert main(given) == 2
    said = capsys.readouterr().err
    assert "none of them fit" in said
    assert "grey.exr is not HDR" in said
    (tmp_path / "file").touch()
    assert main([*given[:-1], str(tmp_path / "file" / "out")]) == 1
    assert "cannot be made" in capsys.readouterr().err
