"""Radius and centre of a painted mirror ball, fitted to the photograph that it mirrors.

Half a pixel of radius moves a light near the rim by degrees. The edge itself is no use: the rim of a mirror ball shows
what lies right behind it, so that there is nothing to see there. But the ring inside it is a compressed picture of the
photograph around the ball, which is known. So the ring is predicted for a radius and a centre, and these are fitted by
robust least squares. Free beside them are what a painter may get wrong without the ball being elsewhere: reflectance
of each channel, focal length, blur.

The error bar is a sandwich estimate over sectors of azimuth: neighbouring pixels err together, sectors hardly do.

Sources: Levenberg, A method for the solution of certain non-linear problems in least squares (1944); Huber, Robust
Statistics (1981), Ch. 7; Liang and Zeger, Longitudinal data analysis using generalized linear models (1986), for the
sandwich over clusters; Roberts, The unreasonable effectiveness of quasirandom sequences (2018), for the samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from .ball import Ball
from .errors import ImageError, OptionError
from .exposure import decode_display, encode_display
from .projection import ORTHOGRAPHIC, Lens, Projection
from .shapes import Directions, Disc, Image

__all__ = ["BallFit", "fit_ball", "nominal_fit"]

REACH: Final = 2.0
"""Pixels by which radius and each coordinate may differ from the nominal ones."""
SECTORS: Final = 24
SAMPLES: Final = 48
"""Points of a pixel; they lie on a lattice, so that in any direction all are apart."""
EDGE: Final = 0.25
"""Width in pixels over which a sample passes from the ball to the background: makes coverage differentiable."""
STEPS: Final = (0.15, 0.15, 0.15, 0.02, 0.1, 0.05, 0.05, 0.05)
"""Of the numeric derivatives: radius, x, y (pixels), log focal length, variance of blur (px²), log reflectances.

Shorter ones measure the grain of the samples, which makes the problem look stiffer than it is."""
PRIOR: Final = (math.inf, math.inf, math.inf, 0.02, 0.5, 0.3, 0.3, 0.3)
"""Standard deviations that are expected of the same."""
CLIPPED: Final = 0.995
FLOOR: Final = 0.01
"""Standard deviation, pixels, of what is not in the residuals: sampling, the encoding in which a painter mixes."""
GRAIN: Final = 8 / 255
"""Error of one value of the ring: an 8-bit step or two, and sixteen values erring together."""
LARGEST_ERROR: Final = 0.03
"""Standard deviation, pixels, up to which a fit is used: three are half a degree, 20 degrees from straight ahead."""
LARGEST_BLUR: Final = 0.1
"""Variance of blur, px², from which a fit is not used: how values of a rim mix in a painter is not known, and radii
were off by a tenth of a pixel at 0.3. Balls that were not blurred measure at most 0.01.
"""
LEAST_EXPLAINED: Final = 0.8
LEAST_SECTORS: Final = 12


@dataclass(frozen=True)
class BallFit:
    """Where a ball is.

    Attributes:
        radius: pixels.
        centre: (x, y) in canvas coordinates, pixels.
        sigma: standard deviations of radius, x and y in pixels; infinite where nothing was measured.
        clear: whether radius and centre were measured; otherwise they are the nominal circle's.
        reason: why it is not clear; empty if it is.
        explained: share of the ring's variance that the fit explains, 0 to 1.
    """

    radius: float
    centre: tuple[float, float]
    sigma: tuple[float, float, float]
    clear: bool
    reason: str
    explained: float


def nominal_fit(ball: Ball, reason: str, explained: float = 0.0) -> BallFit:
    """The circle a ball was asked for, with the reason why it is not known better."""
    return BallFit(ball.diameter / 2, ball.centre, (math.inf,) * 3, clear=False, reason=reason, explained=explained)


def fit_ball(
    painted_ldr: Image,
    ball: Ball,
    *,
    fov: float = 60.0,
    projection: Projection = ORTHOGRAPHIC,
    photograph_ldr: Float[Tensor, "k y x c"] | None = None,
) -> BallFit:
    """Fit radius and centre of a painted ball.

    Args:
        painted_ldr: (1, S, S, 3) the painted canvas, display-encoded in [0, 1]: as the painter left it, not pasted
            through a disc.
        ball: where the ball was to be painted.
        fov: field of view across the canvas, degrees; fitted, too, within a few percent.
        projection: of the camera, for the whole canvas.
        photograph_ldr: (1, S, S, 3) the canvas before painting; without it the painted one is used outside the inpaint
            disc.

    Returns:
        The fit; the nominal circle with a reason where the evidence is not clear.

    Raises:
        ImageError: pictures that are not one canvas of the ball's size.
        OptionError: a field of view not above 0 and below 180 degrees.
    """
    if not 0 < fov < 180:
        raise OptionError("fov", fov, "above 0 and below 180 degrees")
    for name, picture in (("painted", painted_ldr), ("photograph", photograph_ldr)):
        if picture is not None and picture.shape != (1, ball.canvas, ball.canvas, 3):
            raise ImageError(name, f"has shape {tuple(picture.shape)}; (1, {ball.canvas}, {ball.canvas}, 3) is wanted")
    if ball.diameter < 32:
        return nominal_fit(ball, "the ball is smaller than 32 pixels")
    scene = _Scene(painted_ldr.detach().float().cpu(), ball, fov, projection, photograph_ldr)
    return _judged(scene, ball, _solution(scene))


@dataclass(frozen=True)
class _Mixed:
    """Light of pixels: what a perfect mirror reflects, what is behind it, and how far both are known."""

    reflected: Float[Tensor, "n 3"]
    behind: Float[Tensor, "n 3"]
    known: Float[Tensor, "n"]

    def display(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Display values with the reflectances of the parameters, and `known`."""
        return encode_display(self.reflected * parameters[5:].float().exp() + self.behind), self.known


class _Scene:
    """Ring of pixels to explain, and the photograph that explains it."""

    def __init__(
        self, painted: Image, ball: Ball, fov: float, projection: Projection, photograph: Image | None
    ) -> None:
        source = painted if photograph is None else photograph.detach().float().cpu()
        self.projection, self.size = projection, ball.canvas
        self.focal = ball.canvas / 2 / math.tan(math.radians(fov) / 2)
        self.nominal = torch.tensor([ball.diameter / 2, *ball.centre], dtype=torch.float64)
        known = _known(source, ball, hidden=photograph is None)
        radiance = decode_display(source)
        table = torch.cat((radiance * known, known), dim=-1).permute(0, 3, 1, 2)
        # A pixel of the ring spans a dozen pixels of the photograph and more: block means alias less.
        self.block = max(1, round(ball.canvas / 256))
        self.table = F.avg_pool2d(table, self.block, ceil_mode=True)
        positions = torch.arange(ball.canvas) + 0.5
        y, x = torch.meshgrid(positions, positions, indexing="ij")
        distance = torch.hypot(x - ball.centre[0], y - ball.centre[1])
        radius = ball.diameter / 2
        inner = radius * (1 - 0.066) - REACH
        ring = (distance > inner) & (distance < radius + REACH + 1)
        self.points = torch.stack((x[ring], y[ring]), dim=-1)
        self.observed = painted[0][ring]
        self.background, self.background_known = radiance[0][ring], known[0, ..., 0][ring]
        self.inner = distance[ring] < radius - 3
        angle = torch.atan2(self.points[:, 1] - ball.centre[1], self.points[:, 0] - ball.centre[0])
        self.sector = ((angle / (2 * math.pi) + 0.5) * SECTORS).long().clamp(0, SECTORS - 1)

    def predict(self, parameters: Tensor, samples: int, every: int = 1) -> tuple[Tensor, Tensor]:
        """Display values (n, 3) of every so many pixels of the ring, and how far each is known, 0 to 1 (n,)."""
        return self.mixed(parameters, samples, every).display(parameters)

    def mixed(self, parameters: Tensor, samples: int, every: int = 1) -> _Mixed:
        """Both parts of the light of the pixels, before the reflectances; the costly half of a prediction."""
        radius, x, y, log_focal, blur = parameters[:5].tolist()
        centre, points = (x, y), self.points[::every]
        lens = self.projection.lens(radius, centre, self.size)
        offsets = _lattice(samples, math.sqrt(max(0.0, blur)))
        disc = (points[:, None] + offsets - torch.tensor(centre)) / radius * torch.tensor([1.0, -1.0])
        gap = (_outline(lens, disc.mean(dim=1))[:, None] - torch.linalg.norm(disc, dim=-1)) * radius
        on_ball = (gap / EDGE + 0.5).clamp(0, 1)
        values = self._look_up(lens.reflect(disc), self.focal * math.exp(log_focal)) * on_ball[..., None]
        coverage, total = on_ball.mean(dim=1), values.mean(dim=1)
        seen = total[:, 3] / coverage.clamp(min=1e-6)
        reflected = total[:, :3] / seen.clamp(min=1e-3)[:, None]
        outside = 1 - coverage
        known = torch.where(coverage > 1e-3, ((seen - 0.9) / 0.1).clamp(0, 1), torch.ones_like(seen))
        known = known * (1 - outside * (1 - self.background_known[::every]) / 0.02).clamp(0, 1)
        # The background alone says nothing.
        return _Mixed(reflected, outside[:, None] * self.background[::every], known * (coverage > 1e-3))

    def _look_up(self, directions: Directions, focal: float) -> Float[Tensor, "n s 4"]:
        """Radiance times known, and known, of the photograph in some directions; zero off the frame."""
        ahead = (-directions[..., 2]).clamp(min=1e-6)
        x = directions[..., 0] / ahead * (focal * 2 / self.size)
        y = -directions[..., 1] / ahead * (focal * 2 / self.size)
        grid = torch.stack((x, y), dim=-1)[None].clamp(-4, 4)
        values = F.grid_sample(self.table, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
        return values[0].permute(1, 2, 0) * (directions[..., 2:] < 0)


def _known(source: Image, ball: Ball, *, hidden: bool) -> Float[Tensor, "1 s s 1"]:
    """Where a canvas shows the radiance of the scene: not in black bars, not clipped, not painted over."""
    known = (source.amax(dim=-1, keepdim=True) < CLIPPED).float()
    lit = source.amax(dim=-1)[0] > 0
    for along in (0, 1):
        lines = torch.nonzero(lit.any(dim=1 - along)).flatten()
        if len(lines):
            inside = torch.zeros(ball.canvas)
            inside[int(lines[0]) : int(lines[-1]) + 1] = 1
            known = known * (inside[:, None, None] if along == 0 else inside[None, :, None])
    if hidden:
        positions = torch.arange(ball.canvas) + 0.5
        squared = (positions[None] - ball.centre[0]) ** 2 + (positions[:, None] - ball.centre[1]) ** 2
        known = known * (squared > (ball.diameter / 2 + ball.dilation + 1) ** 2)[None, ..., None]
    return known


def _lattice(samples: int, blur: float) -> Float[Tensor, "s 2"]:
    """Points of a pixel about its middle, spread by a Gaussian of `blur` pixels: a rank-one lattice."""
    index = torch.arange(samples, dtype=torch.float64)[:, None]
    root = 1.1673039782614187  # of x^5 = x + 1: the most even steps in four dimensions
    steps = torch.tensor([root**-1, root**-2, root**-3, root**-4], dtype=torch.float64)
    points = (index * steps + 0.5) % 1
    spread = torch.special.ndtri(points[:, 2:].clamp(1e-3, 1 - 1e-3)) * blur + points[:, :2]
    return (spread - spread.mean(dim=0)).float()  # their mean off the middle would move the ball


def _outline(lens: Lens, disc: Disc) -> Float[Tensor, "n"]:
    """Distance of the outline from the ball's centre, in radii, in the direction of points of the disc."""
    toward = F.normalize(disc, dim=-1)
    if lens.equal_area:  # only a ball seen by parallel rays is, and its outline is the unit circle
        return torch.ones_like(toward[:, 0])
    low, high = torch.full_like(toward[:, 0], 0.8), torch.full_like(toward[:, 0], 2.0)
    for _ in range(22):
        middle = (low + high) / 2
        inside = lens.on_ball(toward * middle[:, None])
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return (low + high) / 2


# --- least squares -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Solution:
    parameters: Tensor
    residuals: Float[Tensor, "n 3"]
    weights: Float[Tensor, "n 3"]
    jacobian: Float[Tensor, "n 3 p"]


SETTLED: Final = 3e-3
"""Pixels: a step of radius and centre below a third of FLOOR ends the search."""
THINNED: Final = 4
"""One of so many pixels of the ring serves until the last rounds, which have all of them."""


def _robust(residuals: Tensor, known: Tensor) -> Tensor:
    """Weights (n, 3) of residuals for a loss that is linear for large ones, so that it has few minima.

    Their scale is 1.5 median deviations, at least one 8-bit step.
    """
    there = residuals[known > 0.5]
    scale = 1 / 255 if len(there) == 0 else max(1 / 255, 1.5 * float(there.abs().median()))
    return known[:, None] / torch.sqrt(1 + (residuals / (2 * scale)).square())


def _solution(scene: _Scene) -> _Solution:
    """The best of a coarse grid, refined."""
    grid = _grid(scene)
    starts = sorted((_coarse(scene, start), index) for index, start in enumerate(grid))
    refined = [_refine(scene, grid[index], 3, THINNED) for _, index in starts[:2]]
    best = _refine(scene, min(refined, key=_loss).parameters, 16, THINNED)
    return _refine(scene, best.parameters, 4)


def _grid(scene: _Scene) -> list[Tensor]:
    offsets = torch.tensor([-1.2, -0.6, 0.0, 0.6, 1.2], dtype=torch.float64)
    return [
        torch.cat((scene.nominal + offset, torch.tensor([0.0, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64)))
        for offset in torch.cartesian_prod(offsets, offsets, offsets)
    ]


def _coarse(scene: _Scene, start: Tensor) -> float:
    """Mean robust residual of a start on a seventh of the ring, with the reflectances that suit it."""
    predicted, known = scene.predict(start, 12, every=7)
    observed = scene.observed[::7]
    there = known > 0.5
    if int(there.sum()) < 60:
        return math.inf
    gain = torch.stack(
        [(o / p.clamp(min=1e-3)).median() for o, p in zip(observed[there].T, predicted[there].T, strict=True)]
    )
    rest = (observed - predicted * gain)[there].abs()
    return float((rest / (rest + 0.03)).mean())


def _loss(solution: _Solution) -> float:
    rest = solution.residuals[solution.weights.amax(dim=-1) > 0].abs()
    return float((rest / (rest + 0.02)).mean()) if len(rest) else math.inf


def _refine(scene: _Scene, start: Tensor, rounds: int, every: int = 1) -> _Solution:
    """Levenberg-Marquardt with weights of the round before, on every so many pixels."""
    parameters, damping = start, 1e-6
    solution = _linearized(scene, parameters, every)
    for _ in range(rounds):
        rise, curvature = _normal(solution)
        step = torch.linalg.solve(curvature + damping * torch.diag(curvature.diagonal()), rise)
        step = step * min(1.0, 0.7 / max(1e-9, float(step[:3].abs().max())))
        trial = solution.parameters + step
        residuals = scene.observed[::every] - scene.predict(trial, SAMPLES, every)[0]
        before = float((solution.weights * solution.residuals.square()).sum())
        if float((solution.weights * residuals.square()).sum()) > before * (1 + 1e-3):
            damping *= 10
            continue
        damping = max(1e-9, damping / 10)
        solution = _linearized(scene, trial, every)
        if float(step[:3].abs().max()) < SETTLED:
            break
    return solution


def _linearized(scene: _Scene, parameters: Tensor, every: int) -> _Solution:
    """Residuals, weights and derivatives at a point."""
    here = scene.mixed(parameters, SAMPLES, every)
    predicted, known = here.display(parameters)
    residuals = scene.observed[::every] - predicted
    columns = []
    for index, step in enumerate(STEPS):
        shift = torch.zeros_like(parameters)
        shift[index] = step
        around = (parameters + shift, parameters - shift)
        ahead, behind = (
            # Reflectances come last and change nothing but how both parts are mixed.
            (here if index >= 5 else scene.mixed(point, SAMPLES, every)).display(point)[0]
            for point in around
        )
        columns.append((ahead - behind) / (2 * step))
    return _Solution(parameters, residuals, _robust(residuals, known), torch.stack(columns, dim=-1))


def _normal(solution: _Solution) -> tuple[Tensor, Tensor]:
    """Right side and matrix of the normal equations, what is expected of the parameters included."""
    jacobian, weights = solution.jacobian.double(), solution.weights.double()[..., None]
    there = solution.weights > 0
    variance = max(1e-6, float((solution.weights * solution.residuals.square()).sum() / there.sum().clamp(min=1)))
    # Neighbouring pixels and channels say the same: a prior counts like ten of them.
    prior = torch.tensor([10 * variance / width**2 for width in PRIOR], dtype=torch.float64)
    rise = (jacobian * weights * solution.residuals.double()[..., None]).sum(dim=(0, 1))
    offset = torch.cat((torch.zeros(3, dtype=torch.float64), solution.parameters[3:]))
    curvature = torch.einsum("nkp,nkq->pq", jacobian * weights, jacobian)
    return rise - prior * offset, curvature + torch.diag(prior + 1e-9)


# --- judgement ---------------------------------------------------------------------------------------------------


def _judged(scene: _Scene, ball: Ball, solution: _Solution) -> BallFit:
    """The fit, or the nominal circle and why."""
    used = torch.bincount(scene.sector, solution.weights.amax(dim=-1) > 0.2, minlength=SECTORS)
    explained = _explained(scene, solution)
    sigma = _standard_errors(scene, solution)
    offset = solution.parameters[:3] - scene.nominal
    faults = {
        "too little of the ring shows what the photograph does": int((used > 20).sum()) < LEAST_SECTORS,
        "the ring is not a mirror image of the photograph": explained < LEAST_EXPLAINED,
        "the best fit is at the border of the search": float(offset.abs().max()) > REACH - 0.2,
        "the ring is blurred": float(solution.parameters[4]) > LARGEST_BLUR,
        "the ring leaves radius or centre open": not max(sigma) < LARGEST_ERROR,
    }
    reason = next((text for text, fault in faults.items() if fault), "")
    if reason:
        return nominal_fit(ball, reason, explained)
    radius, x, y = solution.parameters[:3].tolist()
    return BallFit(radius, (x, y), sigma, clear=True, reason="", explained=explained)


def _explained(scene: _Scene, solution: _Solution) -> float:
    """Share of the ring's variance, over channels and known pixels alike, that is not residual or rounding."""
    there = solution.weights.amax(dim=-1) > 0
    if int(there.sum()) < 100:
        return 0.0
    spread = (scene.observed - scene.observed[there].mean(dim=0))[there]
    rest = solution.residuals[there]
    return max(0.0, 1 - float((rest.square().mean() + 1 / 255**2) / spread.square().mean().clamp(min=1e-9)))


def _standard_errors(scene: _Scene, solution: _Solution) -> tuple[float, float, float]:
    """Sandwich over sectors of azimuth, corrected for their number, and what inner and outer ring disagree by.

    A wrong model of the ball errs in the same way in all sectors, but not at all distances from the rim.
    """
    _, curvature = _normal(solution)
    scores = (solution.jacobian * (solution.weights * solution.residuals)[..., None]).sum(dim=1).double()
    by_sector = torch.zeros(SECTORS, scores.shape[1], dtype=torch.float64).index_add_(0, scene.sector, scores)
    inverse = torch.linalg.inv(curvature)
    covariance = inverse @ (by_sector.T @ by_sector) @ inverse * (SECTORS / (SECTORS - len(STEPS)))
    apart = (_step_of(solution, scene.inner) - _step_of(solution, ~scene.inner))[:3] / 2
    # A ring without texture leaves no residual, and everything open: it counts as read to GRAIN.
    read = inverse.diagonal()[:3].clamp(min=0) * GRAIN**2
    variance = covariance.diagonal()[:3].clamp(min=0) + apart.square() + read + FLOOR**2
    radius, x, y = variance.sqrt().tolist()
    return radius, x, y


def _step_of(solution: _Solution, part: Bool[Tensor, "n"]) -> Tensor:
    """By how much the parameters would change if only a part of the ring were there."""
    kept = solution.weights * part[:, None]
    rise, curvature = _normal(replace(solution, weights=kept))
    return torch.linalg.solve(curvature, rise)
