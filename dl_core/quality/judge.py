"""Scores of measured balls: how likely a ball with these numbers is a good one rather than one with a fault.

Each check is a logistic of a few of the numbers, fitted to balls rendered from panoramas: good ones, and ones with the
fault that the check is for. A score of 0.5 is where both were equally frequent. The weights lie in `data/quality.json`
with what they were measured on; `lightprobe bench quality --calibrate` makes them anew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from ..errors import ModelError
from ..json_text import read_json
from ..shapes import BallImage
from .features import BallFeatures, ball_features

__all__ = [
    "CHECKS",
    "DOUBT",
    "OVERALL",
    "QUALITY_FILE",
    "RANGES",
    "Check",
    "Judge",
    "Kind",
    "Logistic",
    "Range",
    "shipped_judge",
    "verdict",
    "worst_of",
]

QUALITY_FILE: Final = Path(__file__).parent.parent / "data" / "quality.json"
DOUBT: Final = 0.5
"""Score below which a check has something to suggest: a fault is likelier than not."""


@dataclass(frozen=True)
class Check:
    """What a check found.

    Attributes:
        name: short, for programs.
        score: 0 to 1; 1 is good.
        message: a sentence for people.
        suggestion: what to do, a sentence; empty where nothing needs doing.
    """

    name: str
    score: float
    message: str
    suggestion: str = ""

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)

    def line(self) -> str:
        """One line for people."""
        return f"{self.score:.2f}  {self.name:10}  {self.message}. {self.suggestion}".rstrip()


@dataclass(frozen=True)
class Kind:
    """A kind of check of a ball by itself.

    Attributes:
        faults: of the bench's, that it is fitted to tell from good balls.
        features: of `BallFeatures`, that it looks at.
        good: sentence on a ball that passes.
        bad: sentence on one that does not.
        suggestion: what to do then.
    """

    faults: tuple[str, ...]
    features: tuple[str, ...]
    good: str
    bad: str
    suggestion: str


CHECKS: Final[dict[str, Kind]] = {
    "place": Kind(
        ("off-centre",),
        ("squeeze", "elsewhere", "weakest", "busy"),
        "the ball is where it was asked for",
        "the ball is beside its place",
        "Paint with other seeds, raise the ControlNet's strength, or measure the ball with Fit Ball.",
    ),
    "whole": Kind(
        ("partial",),
        ("squeeze", "weakest", "cut", "grain", "busy"),
        "the ball fills its disc",
        "a part of the disc shows no ball",
        "Paint with other seeds, or raise the ControlNet's strength.",
    ),
    "mirror": Kind(
        ("disco",),
        ("squeeze", "edges", "busy"),
        "it squeezes the scene towards its rim, as a mirror ball does",
        "it does not squeeze the scene towards its rim: facets, or no mirror ball",
        "Take a median of more balls, or leave such balls out of it (tolerance).",
    ),
    "gloss": Kind(
        ("matte",),
        ("detail", "edges", "grain", "busy"),
        "it shows detail, as polished metal does",
        "it shows hardly any detail: matte, or a scene without any",
        "Keep 'matte, diffuse' in the negative prompt, raise guidance, or refine the median (final).",
    ),
    "tint": Kind(
        ("tinted",),
        ("colour",),
        "its colour is one that scenes have",
        "it is strongly coloured: tinted metal, or coloured light",
        "If the scene's light is not coloured, name silver or chrome in the prompt and paint with other seeds.",
    ),
}
"""Checks of a ball by itself, by name."""

OVERALL: Final = ("place", "whole", "mirror", "gloss")
"""Checks that the score of a ball is the worst of. Its colour may be the scene's, and does not count."""


def _sigmoid(total: float) -> float:
    """0 to 1; beyond 60 it is as near the ends as doubles tell."""
    return 1 / (1 + math.exp(-max(-60.0, min(60.0, total))))


@dataclass(frozen=True)
class Logistic:
    """1 / (1 + exp(-(offset + weights · values))).

    Attributes:
        weights: by name of the value.
        offset: added to their sum.
    """

    weights: Mapping[str, float]
    offset: float

    def __call__(self, values: Mapping[str, float]) -> float:
        """The score of values."""
        return _sigmoid(self.offset + sum(weight * values[name] for name, weight in self.weights.items()))


@dataclass(frozen=True)
class Range:
    """What is usual of a value.

    Attributes:
        typical: half of good balls, or of photographs, have more (or less, where much is bad).
        limit: 19 of 20 do.
    """

    typical: float
    limit: float

    def score(self, value: float) -> float:
        """0.5 at the limit, 0.9 where it is typical, a logistic between and beyond."""
        return _sigmoid(math.log(9) * (value - self.limit) / (self.typical - self.limit))

    def __post_init__(self) -> None:
        if not (math.isfinite(self.typical) and math.isfinite(self.limit)) or self.typical == self.limit:
            raise ValueError(f"typical {self.typical}, limit {self.limit}")


RANGES: Final = ("contrast", "upright", "rim")
"""Values that are judged by how usual they are: see `surroundings`."""


@dataclass(frozen=True)
class Judge:
    """Everything that was fitted.

    Attributes:
        checks: by name of the check.
        ranges: by name, of values that are judged by how usual they are.
        measured_on: one sentence.
    """

    checks: Mapping[str, Logistic]
    ranges: Mapping[str, Range]
    measured_on: str

    @staticmethod
    def read(path: Path) -> Judge:
        """A judge from a file.

        Raises:
            ModelError: it cannot be read, or is none.
        """
        try:
            content = read_json(path)
            checks = {name: _logistic(content["checks"][name]) for name in CHECKS}
            ranges = {name: Range(**content["ranges"][name]) for name in RANGES}
            return Judge(checks, ranges, str(content["measured_on"]))
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ModelError(path, f"cannot be used to judge balls by ({error!r})") from error

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "checks": {name: asdict(logistic) for name, logistic in self.checks.items()},
            "ranges": {name: asdict(values) for name, values in self.ranges.items()},
            "measured_on": self.measured_on,
        }

    def scores(self, values: Mapping[str, float]) -> dict[str, float]:
        """The score of each check, of the numbers of a ball by name."""
        return {name: logistic(values) for name, logistic in self.checks.items()}

    def score(self, features: BallFeatures) -> float:
        """How good a mirror ball it is, 0 to 1, as `worst_of` says."""
        return worst_of(self.scores(features.values()))

    def ball_checks(self, features: BallFeatures) -> list[Check]:
        """What a ball by itself shows."""
        scores = self.scores(features.values())
        return [verdict(name, scores[name], kind.good, kind.bad, kind.suggestion) for name, kind in CHECKS.items()]

    def judge(self, ball_ldr: BallImage) -> tuple[float, list[Check]]:
        """Score and checks of a ball, (1, D, D, 3) display-encoded.

        Raises:
            ImageError: as `ball_features`.
        """
        features = ball_features(ball_ldr)
        return self.score(features), self.ball_checks(features)


def _logistic(content: Any) -> Logistic:
    known = BallFeatures.__dataclass_fields__
    weights = {str(name): float(weight) for name, weight in content["weights"].items()}
    if unknown := weights.keys() - known.keys():
        raise ValueError(f"unknown numbers {sorted(unknown)}")
    return Logistic(weights, float(content["offset"]))


def worst_of(scores: Mapping[str, float]) -> float:
    """The worst of the checks in `OVERALL`, of the scores of all checks."""
    return min(scores[name] for name in OVERALL)


def verdict(name: str, score: float, good: str, bad: str, suggestion: str) -> Check:
    """A check with the sentence that belongs to its score, and a suggestion where it fails."""
    return Check(name, score, good) if score >= DOUBT else Check(name, score, bad, suggestion)


@cache
def shipped_judge() -> Judge:
    """The judge that comes along.

    Raises:
        ModelError: its file is damaged.
    """
    return Judge.read(QUALITY_FILE)
