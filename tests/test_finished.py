"""The store of finished balls: what it gives back, what it forgets, and what its keys tell apart."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core.ball import paint_depth, place_ball
from dl_core.errors import OptionError
from dl_core.finished import FinishedBalls, content_key
from dl_core.painter import PaintRequest

BALL_BYTES = 4 * 4 * 3 * 4
"""Of a ball of 4 x 4 pixels, three channels of 32 bits."""


def balls(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32)[:, None, None, None].expand(-1, 4, 4, 3).clone()


def test_a_ball_comes_back_as_it_was_kept() -> None:
    store, painted = FinishedBalls(10**6), torch.rand(2, 4, 4, 3, generator=torch.Generator().manual_seed(0))
    store.keep("key", (7, 8), painted)
    kept = painted.clone()
    painted.zero_()
    found = store.find("key", (6, 7, 8))
    assert sorted(found) == [7, 8]
    assert torch.equal(torch.cat([found[7], found[8]]), kept)
    assert store.find("other", (7, 8)) == {}


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 5)), max_size=30), st.integers(0, 5))
def test_it_stays_within_its_limit_and_forgets_what_is_longest_unused(kept: list[tuple[str, int]], room: int) -> None:
    store = FinishedBalls(room * BALL_BYTES + BALL_BYTES // 2)
    for key, seed in kept:
        store.keep(key, (seed,), balls(float(seed)))
        assert store.bytes_held <= room * BALL_BYTES
    latest = list(dict.fromkeys(reversed(kept)))[:room]
    assert store.bytes_held == len(latest) * BALL_BYTES
    for key in "ab":
        assert set(store.find(key, tuple(range(6)))) == {seed for other, seed in latest if other == key}


def test_a_ball_that_is_found_counts_as_used() -> None:
    store = FinishedBalls(2 * BALL_BYTES)
    store.keep("key", (1, 2), balls(1, 2))
    store.find("key", (1,))
    store.keep("key", (3,), balls(3))
    assert set(store.find("key", (1, 2, 3))) == {1, 3}


def test_cleared_it_holds_nothing() -> None:
    store = FinishedBalls(10**6)
    store.keep("key", (1,), balls(1))
    store.clear()
    assert (store.bytes_held, store.find("key", (1,))) == (0, {})


def test_balls_of_the_key_longest_unused_go_when_there_are_too_many_keys() -> None:
    store = FinishedBalls(10**6, keys=2)
    store.keep("a", (1, 2), balls(1, 2))
    store.keep("b", (1, 2, 3), balls(1, 2, 3))
    assert set(store.find("a", (1, 2))) == {1, 2}
    store.keep("c", (1,), balls(1))
    assert [len(store.find(key, (1, 2, 3))) for key in "abc"] == [2, 0, 1]
    assert store.bytes_held == 3 * BALL_BYTES
    store.keep("c", (1,), balls(4))  # the same ball again is no more of them
    store.keep("d", (1,), balls(1))
    assert [len(store.find(key, (1, 2, 3))) for key in "acd"] == [0, 1, 1]


HEAP = """
import torch
from dl_core.finished import FinishedBalls

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

store = FinishedBalls(2**30)
for run in range(60):
    buffers = [torch.ones(27 * 2**18), torch.ones(27 * 2**18)]
    balls = torch.ones(3, 64, 64, 3)
    buffers.append(torch.ones(9 * 2**18))
    del buffers[0]
    store.keep(str(run), (0, 1, 2), balls)
    del buffers, balls
    if run == 19:
        warm = resident() - store.bytes_held
print(resident() - store.bytes_held - warm)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_what_is_kept_does_not_keep_the_memory_of_its_painting() -> None:
    """40 runs with buffers of 63 MiB, of which each keeps 144 KiB: what else stays is less than one run's buffers."""
    answer = subprocess.run(
        [sys.executable, "-c", HEAP], cwd=Path(__file__).parent.parent, capture_output=True, text=True, check=True
    )
    assert int(answer.stdout) < 63 * 2**20


@pytest.mark.parametrize(("options", "name"), [((-1,), "limit"), ((5, 0), "keys")])
def test_limits_that_are_none_are_refused(options: tuple[int, ...], name: str) -> None:
    with pytest.raises(OptionError, match=f"{name} is {options[-1]}"):
        FinishedBalls(*options)


# --- keys --------------------------------------------------------------------------------------------------------


class Network:
    """An object that counts by its identity."""


NETWORK = Network()


def request() -> PaintRequest:
    ball = place_ball(64, 32)
    return PaintRequest(torch.full((1, 64, 64, 3), 0.5), paint_depth(None, ball), ball, 0.0, (0,))


def test_equal_content_has_equal_keys() -> None:
    conditioning = [[torch.ones(1, 2, 3), {"pooled_output": torch.zeros(1, 4), "width": 64}]]
    again = [[torch.ones(1, 2, 3), {"width": 64, "pooled_output": torch.zeros(1, 4)}]]
    assert content_key(request(), NETWORK, conditioning) == content_key(request(), NETWORK, again)


def changed_in_one_pixel(picture: torch.Tensor) -> torch.Tensor:
    picture = picture.clone()
    picture[0, 3, 5, 1] += 1e-6
    return picture


def test_whatever_differs_changes_the_key() -> None:
    base = request()
    others = [
        replace(base, canvas=changed_in_one_pixel(base.canvas)),
        replace(base, depth=changed_in_one_pixel(base.depth)),
        replace(base, ball=place_ball(64, 32, x=20)),
        replace(base, strength=0.8),
        replace(base, steps=29),
    ]
    keys = {content_key(item, NETWORK) for item in [base, *others]} | {content_key(base, Network())}
    assert len(keys) == 1 + len(others) + 1


@dataclass(frozen=True)
class Pair:
    """Two values."""

    first: object
    second: object


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Pair("a", "bc"), Pair("ab", "c")),
        ([[1], [2]], [[1, 2], []]),
        (1, 1.0),
        (None, "None"),
        (torch.zeros(2, 3), torch.zeros(3, 2)),
        (torch.zeros(2), torch.zeros(2, dtype=torch.int32)),
        ({"a": 1}, {"a": 2}),
        (b"a", "a"),
    ],
)
def test_contents_do_not_run_together(one: object, other: object) -> None:
    assert content_key(one) != content_key(other)


def test_half_precision_tensors_have_keys() -> None:
    half = torch.linspace(0, 1, 5, dtype=torch.bfloat16)
    assert content_key(half) == content_key(half.clone())
    assert content_key(half) != content_key(half + 0.5)


def test_an_object_keeps_its_key_and_hands_it_to_no_other() -> None:
    assert content_key(NETWORK) == content_key(NETWORK)
    seen = set()
    for _ in range(50):
        # Each is gone before the next, which may well come to lie at the same address.
        seen.add(content_key(Network()))
    assert len(seen) == 50


def test_what_cannot_be_referred_to_weakly_is_never_found_again() -> None:
    value = object()
    assert content_key(value) != content_key(value)
