r"""Changes and outliers of joints over sessions.

Each joint's series, less the median of the joints of its session, is held against the model

.. math:: y_i = X_i \beta + \sum_k \delta_k \, b_k(i) + e_i

in which X has the conditions (one column each), e the noise of :mod:`.session_noise`, and a shape b
is a pulse in one session (an outlier), or rises from 0 to 1 from a session on: at once, over a part
of the time that is left, or until the last session (a change). Both sides are whitened by the
lag-one correlation, so that the statistic of a shape, its size over its standard error, is the same
wherever it is. The scatter is taken from differences and so holds with changes in the series.

A joint's shapes are found one after the other, the largest statistic first (binary segmentation;
Vostrikova, Soviet Math. Doklady 24, 1981), each beside those before, and then each anew beside all
others. Thresholds are those of fleets that are simulated at the upper limit of the memory, for the
largest statistic over all joints, shapes and sessions: 1 % of the fleets without changes and
outliers have any, which the quantities share evenly, and changes and outliers of each. Beyond the
largest tenth of the simulations the tail is that of a generalised Pareto distribution, so that a
share of 0.2 % needs no 5,000 of them.

The interval of a change is the set of sessions that the likelihood ratio doesn't reject; its
critical value is simulated at the fit, as no limit distribution holds for change points in short
series.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ..common.estimate import Interval
from .session_noise import SessionNoise, estimate_noise, scatter, simulate

LEVEL = 0.01
"""Family-wise level at which a joint is named: a wrong name costs somebody a repair."""
_CONFIDENCE = 0.95
_POWER = 0.9
"""Share of changes of the stated smallest size that are found."""
LEAST_SESSIONS = 8
"""Sessions of a robot from which on changes are looked for: two more than a change has beside it,
from which the memory is estimated."""
_LEAST_BESIDE = 3  # sessions before and after a change
_PARTS = (0.125, 0.25, 0.5, 1.0)  # of the time that is left, which a change may take
_SIMULATIONS = 999
"""Fleets: the mean excess in their largest tenth then has a standard error of 10 %."""
_REFITS = 499
_SHARE = 0.1
"""Share of the simulated fleets, the largest, that the tail is fitted to."""
_MOST_VALUES = 2_000_000
"""Simulated values that are held at a time, 16 MB."""
_MOST_SHAPES = 10
"""Changes and outliers of a joint; one with more has another kind of noise."""
_ROUNDS = 2
"""How often each shape is found anew beside the others, which were found with fewer beside them."""


class DepartureKind(StrEnum):
    """Shape of a departure."""

    OUTLIER = "outlier"
    STEP = "step"
    GRADUAL = "gradual"


@dataclass(frozen=True)
class ChangePoint:
    """A joint that responds differently from a session on, or in one session.

    Attributes:
        joint: Column of the series.
        kind: An outlier is a session by itself.
        session: Index of the first session after the change, or of the outlier.
        first: Index of the earliest session that the 95 % interval includes.
        last: Index of the latest one.
        change: From before the change to its end.
        change_ci95: Its 95 % interval.
        t: Size over its standard error.
        p: Family-wise p-value over all series that were given.
    """

    joint: int
    kind: DepartureKind
    session: int
    first: int
    last: int
    change: float
    change_ci95: Interval
    t: float
    p: float


@dataclass(frozen=True)
class JudgedQuantity:
    """A quantity of the joints of a robot over its sessions.

    Attributes:
        points: Changes and outliers, the largest t first.
        noise: None if no joint has enough sessions; then nothing is decided.
        smallest: Step in the middle of all sessions that is found in 9 of 10 robots.
    """

    points: tuple[ChangePoint, ...] = ()
    noise: SessionNoise | None = None
    smallest: float = float("inf")


@dataclass(frozen=True)
class _Shapes:
    """Shapes that the series of a joint may have.

    Attributes:
        starts: Index, in the series, of the first session after the change, shape (n_shapes,).
        kinds: Shape (n_shapes,).
        raw: Values, shape (n_shapes, n).
        white: Turns a series into one of independent values, shape (n, n).
        unit: Whitened, orthogonal to the design and of norm 1, shape (n_shapes, n); 0 for those
            that the design has already.
        norm: Norm before, shape (n_shapes,).
        basis: Orthonormal, of the whitened design, shape (n, any).
    """

    starts: IntArray
    kinds: NDArray[np.str_]
    raw: FloatArray
    white: FloatArray
    unit: FloatArray
    norm: FloatArray
    basis: FloatArray

    def residuals(self, values: FloatArray) -> FloatArray:
        """Whiten values and subtract their projection on the design; shape (n, any)."""
        white = self.white @ values
        return white - self.basis @ (self.basis.T @ white)


@dataclass(frozen=True)
class _Tail:
    """Upper tail of a null distribution: generalised Pareto (Pickands, Ann. Stat. 3, 1975).

    Attributes:
        start: Where it begins: its probability is ``_SHARE`` there.
        scale: Of the excesses.
        shape: Positive; near 0 for a tail as that of the exponential distribution.
    """

    start: float
    scale: float
    shape: float

    def p(self, value: float) -> float:
        """Return the probability of a value at least as large; 1 before the tail."""
        excess = (value - self.start) / self.scale
        return _SHARE * (1 + self.shape * excess) ** (-1 / self.shape) if excess > 0 else 1.0

    def threshold(self, p: float) -> float:
        """Return the value that is exceeded with a probability."""
        return self.start + self.scale / self.shape * ((_SHARE / p) ** self.shape - 1)


def find_change_points(
    series: Sequence[FloatArray], times_s: FloatArray, conditions: IntArray
) -> list[JudgedQuantity]:
    """Find joints whose series change, and sessions of a joint by themselves.

    Args:
        series: Quantities, each of shape (n_sessions, n_joints), as :func:`.relative_to_others`
            gives them, NaN where unknown.
        times_s: Of the sessions, in increasing order [s], shape (n_sessions,).
        conditions: Number of each session's condition, shape (n_sessions,).

    Returns:
        For each quantity what is found at a family-wise level of :data:`LEVEL`; nothing is decided
        for a joint with fewer than :data:`LEAST_SESSIONS` sessions.
    """
    columns = [_columns(values) for values in series]
    tested = [k for k, joints in enumerate(columns) if joints.size]
    rng = np.random.default_rng(0)
    noises = estimate_noise([series[k] for k in tested], conditions, rng)
    judged = [JudgedQuantity() for _ in series]
    for k, noise in zip(tested, noises, strict=True):
        families = 2 * len(tested)
        judged[k] = _judge(series[k], columns[k], noise, times_s, conditions, families=families)
    return judged


def _columns(values: FloatArray) -> IntArray:
    """Return the joints with enough sessions that are not constant."""
    enough = np.isfinite(values).sum(axis=0) >= LEAST_SESSIONS
    return np.array([k for k in np.flatnonzero(enough) if np.nanstd(values[:, k]) > 0], np.int64)


def _judge(
    values: FloatArray,
    columns: IntArray,
    noise: SessionNoise,
    times_s: FloatArray,
    conditions: IntArray,
    *,
    families: int,
) -> JudgedQuantity:
    columns = columns[noise.scatter[columns] > 0]
    present = np.isfinite(values)
    shapes = {
        rows.tobytes(): _shapes(times_s, rows, conditions, noise.rho, np.empty((0, rows.sum())))
        for rows in present[:, columns].T
    }
    if not any(of_joint.unit.any() for of_joint in shapes.values()):  # a condition a session
        return JudgedQuantity()
    tails = _tails(noise, columns, present, conditions, shapes)
    points: list[ChangePoint] = []
    for column in columns.tolist():
        rows = present[:, column]
        size = float(noise.scatter[column])
        series = _Series(times_s, rows, conditions, noise.rho, values[rows, column], size)
        points += [replace(point, joint=column) for point in _search(series, tails, families)]
    longest = max(shapes.values(), key=lambda of_joint: of_joint.raw.shape[1])
    middle = np.flatnonzero(longest.kinds == DepartureKind.STEP)
    middle = middle[np.argmax(longest.norm[middle])]
    needed = tails[False].threshold(LEVEL / families) + float(ndtri(_POWER))
    smallest = needed * float(np.median(noise.scatter[columns])) / longest.norm[middle]
    return JudgedQuantity(tuple(sorted(points, key=lambda point: -point.t)), noise, float(smallest))


def _shapes(
    times_s: FloatArray, rows: BoolArray, conditions: IntArray, rho: float, others: FloatArray
) -> _Shapes:
    """Return the shapes of a joint that has values in some sessions, beside others of it."""
    starts, kinds, raw = _raw_shapes(times_s[rows])
    white = _whitening(np.flatnonzero(rows), rho)
    condition = conditions[rows]
    design = np.vstack([np.unique(condition)[:, None] == condition[None, :], others])
    left, sizes, _ = np.linalg.svd(white @ design.T, full_matrices=False)
    basis = left[:, sizes > 1e-9 * sizes[0]]
    across = white @ raw.T
    across = (across - basis @ (basis.T @ across)).T
    norm = np.linalg.norm(across, axis=1)
    free = norm > 1e-6 * np.linalg.norm(raw @ white.T, axis=1)
    unit = np.where(free[:, None], across / np.where(free, norm, 1.0)[:, None], 0.0)
    return _Shapes(starts, kinds, raw, white, unit, norm, basis)


def _raw_shapes(times_s: FloatArray) -> tuple[IntArray, NDArray[np.str_], FloatArray]:
    """Return starts, kinds and values of outliers, steps and gradual changes."""
    n = len(times_s)
    starts = np.arange(_LEAST_BESIDE, n - _LEAST_BESIDE + 1)
    steps = (np.arange(n)[None, :] >= starts[:, None]).astype(float)
    begin_s = times_s[starts - 1][:, None]
    left_s = np.maximum(times_s[-1] - begin_s, np.finfo(float).tiny)
    since_s = times_s[None, :] - begin_s
    ramps = [np.clip(since_s / (part * left_s), 0.0, 1.0) for part in _PARTS]
    counts = {
        DepartureKind.OUTLIER: n,
        DepartureKind.STEP: len(starts),
        DepartureKind.GRADUAL: len(_PARTS) * len(starts),
    }
    return (
        np.concatenate([np.arange(n), np.tile(starts, 1 + len(_PARTS))]),
        np.repeat([str(kind) for kind in counts], list(counts.values())),
        np.concatenate([np.eye(n), steps, *ramps]),
    )


def _whitening(sessions: IntArray, rho: float) -> FloatArray:
    """Return the matrix that makes AR(1) noise of variance 1 independent, shape (n, n).

    Args:
        sessions: Numbers of the sessions with a value; noise forgets over those without, too.
    """
    memory = rho ** np.diff(sessions)
    scale = 1 / np.sqrt(1 - memory**2)
    return np.diag(np.append(1.0, scale)) + np.diag(-memory * scale, -1)


def _tails(
    noise: SessionNoise,
    columns: IntArray,
    present: BoolArray,
    conditions: IntArray,
    of_joints: Mapping[bytes, _Shapes],
) -> dict[bool, _Tail]:
    """Return the null distributions of the largest t of a fleet: of outliers (True), of changes.

    Tails make outliers, and hardly move the mean of the sessions of a change.
    """
    rng = np.random.default_rng(1)
    tails = {True: noise.tail, False: noise.least_tail}
    largest: dict[bool, list[FloatArray]] = {True: [], False: []}
    draws = max(1, min(_SIMULATIONS, _MOST_VALUES // present.size))
    for first in range(0, _SIMULATIONS, draws):
        normal = rng.standard_normal((min(draws, _SIMULATIONS - first), *present.shape))
        for outlier, tail in tails.items():
            residuals = simulate(noise, tail, present, conditions, normal)
            t = np.zeros(len(normal))
            size = scatter(residuals, noise.rho, noise.sampling)
            size[size <= 0] = np.inf  # a joint that is constant isn't looked at
            for column in columns:
                rows = present[:, column]
                shapes = of_joints[rows.tobytes()]
                chosen = (
                    shapes.unit[(shapes.kinds == DepartureKind.OUTLIER) == outlier] @ shapes.white
                )
                fitted = np.abs(residuals[:, rows, column] @ chosen.T).max(axis=1)
                np.maximum(t, fitted / size[:, column], out=t)
            largest[outlier].append(t)
    return {k: _tail(np.concatenate(parts), tails[k]) for k, parts in largest.items()}


def _tail(values: FloatArray, shape: float) -> _Tail:
    """Fit the upper tail of a distribution; its shape is that of the noise, which maxima keep."""
    start = float(np.quantile(values, 1 - _SHARE))
    shape = max(shape, 1e-6)
    return _Tail(start, float((values[values > start] - start).mean()) * (1 - shape), shape)


@dataclass(frozen=True)
class _Series:
    """A joint's values and what is the same in all searches for its shapes.

    Attributes:
        rows: Whether the joint has a value in a session, shape (n_sessions,).
        values: Of the sessions that have one, shape (n,).
        scatter: Standard deviation of its noise.
    """

    times_s: FloatArray
    rows: BoolArray
    conditions: IntArray
    rho: float
    values: FloatArray
    scatter: float

    def beside(self, others: Sequence[int]) -> tuple[_Shapes, FloatArray]:
        """Return the shapes beside others, given by their index, and the t of each."""
        raw = _raw_shapes(self.times_s[self.rows])[2][list(others)]
        shapes = _shapes(self.times_s, self.rows, self.conditions, self.rho, raw)
        return shapes, np.abs(shapes.unit @ shapes.residuals(self.values)) / self.scatter


def _search(series: _Series, tails: Mapping[bool, _Tail], families: int) -> list[ChangePoint]:
    """Find the shapes of a joint; its column is not known here."""
    chosen: list[int] = []
    limits = {outlier: tail.threshold(LEVEL / families) for outlier, tail in tails.items()}
    while len(chosen) < _MOST_SHAPES:
        shapes, t = series.beside(chosen)
        tried = t.copy()
        for outlier, limit in limits.items():
            t[((shapes.kinds == DepartureKind.OUTLIER) == outlier) & (t < limit)] = 0.0
        is_change = shapes.kinds != DepartureKind.OUTLIER
        if t[is_change].any():  # a change isn't that of one session: most of it is left without
            farthest = int(np.where(is_change, 0.0, tried).argmax())
            t[is_change & (series.beside([*chosen, farthest])[1] < tails[False].start)] = 0.0
        if not t.any():
            break
        chosen.append(int(t.argmax()))
    for k in [*range(len(chosen))] * _ROUNDS:
        shapes, t = series.beside([*chosen[:k], *chosen[k + 1 :]])
        is_outlier = shapes.kinds == DepartureKind.OUTLIER
        chosen[k] = int(np.where(is_outlier == is_outlier[chosen[k]], t, 0.0).argmax())
    rng = np.random.default_rng(0)
    points: list[ChangePoint] = []
    for k, index in enumerate(chosen):
        shapes, t = series.beside([*chosen[:k], *chosen[k + 1 :]])
        p = families * tails[bool(shapes.kinds[index] == DepartureKind.OUTLIER)].p(float(t[index]))
        if p <= LEVEL:
            points.append(replace(_fit(series, shapes, index, rng), t=float(t[index]), p=p))
    return points


def _fit(series: _Series, shapes: _Shapes, index: int, rng: np.random.Generator) -> ChangePoint:
    """Return a shape with its intervals; its joint, t and p-value are not known here."""
    residual = shapes.residuals(series.values)
    signal: FloatArray = (shapes.unit[index] @ residual) * shapes.unit[index]
    noise = residual - signal
    n, columns = shapes.basis.shape
    noise *= np.sqrt(n / max(1, n - columns - 2))
    # The likelihood ratio of the true shape, where there is such a change in such noise.
    drawn = noise[rng.integers(n, size=(n, _REFITS))]
    simulated = signal[:, None] + drawn - shapes.basis @ (shapes.basis.T @ drawn)
    alike = (shapes.kinds == DepartureKind.OUTLIER) == (
        shapes.kinds[index] == DepartureKind.OUTLIER
    )
    left = np.where(alike, _left(residual[:, None], shapes)[:, 0], np.inf)
    left_simulated = np.where(alike[:, None], _left(simulated, shapes), np.inf)
    best = left_simulated.argmin(axis=0)
    ratio = n * np.log(left_simulated[index] / left_simulated.min(axis=0))
    starts = shapes.starts[n * np.log(left / left[index]) <= np.quantile(ratio, _CONFIDENCE)]
    sizes = np.sum(shapes.unit[best].T * simulated, axis=0) / shapes.norm[best]
    size = float(shapes.unit[index] @ residual / shapes.norm[index])
    low, high = np.quantile(sizes, [(1 - _CONFIDENCE) / 2, (1 + _CONFIDENCE) / 2])
    sessions = np.flatnonzero(series.rows)
    return ChangePoint(
        joint=-1,
        kind=DepartureKind(shapes.kinds[index]),
        session=int(sessions[shapes.starts[index]]),
        first=int(sessions[starts.min()]),
        last=int(sessions[starts.max()]),
        change=size,
        change_ci95=(float(2 * size - high), float(2 * size - low)),
        t=math.nan,
        p=math.nan,
    )


def _left(residual: FloatArray, shapes: _Shapes) -> FloatArray:
    """Return the residual sum of squares with each shape; shape (n_shapes, any)."""
    total = np.sum(residual**2, axis=0)
    return np.maximum(total - (shapes.unit @ residual) ** 2, 1e-12 * total)
