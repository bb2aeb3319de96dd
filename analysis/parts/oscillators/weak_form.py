"""K of a chain of oscillators from its phases, in weak form.

    phi_i' = omega_i + sum_j K_ij sin(phi_j - phi_i - psi_ij) + eps_i u_i + noise     (Eq. 1)

is linear in omega_i, eps_i, K_ij cos(psi_ij) and K_ij sin(psi_ij). It is multiplied by test
functions w that vanish outside short windows, and integrated: the phases are never differentiated,
w takes the difference. With w constant over each sampling period the left side is exact, and what
state noise leaves of each window is independent of every other.

Least squares would be biased all the same: noise early in a window moves the regressors later in
it. The regressors at the window's start cannot know it, so they serve as instruments (Wooldridge,
Econometric Analysis of Cross Section and Panel Data, 2010, ch. 5): b = (Z'X)^-1 Z'y.

Of locked phases every regressor is constant, and X is singular: its condition number says how far
the data are from telling anything.

The oscillators' phases that a session logged, plane by plane, and the feedback from their servos.

A generator of oscillators logs every joint's own phase on ``/gait``. With feedback, the
angles enter as u_i = 2 (q_i - Y_i) / A cos phi_i (:mod:`.predictions`); each is taken a sample's
period old, as the generator has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import NS, BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import MissingChannelError, UsageError
from undulog.capture.log.read.joint_topics import RESPONSE_TOPIC
from undulog.capture.log.read.sample_times import JointSignals, Signal

from ...signals.columns import planes_of

GAIT_TOPIC = "/gait"


_SAME = 1e-6
"""Relative change of a rate that counts as none."""

_JITTER = 0.5
"""A step that is off by this share of a period, or more, is a gap."""

WINDOW_S = 0.1
"""Length of a test function: short beside 1/K, long beside the noise of a reading."""

LEAST_SAMPLES = 4
"""Sampling periods in a window, at least."""

SINGULAR = 1e7
"""Condition number beyond which nothing is solved: Z'X has its square."""


@dataclass(frozen=True)
class PhaseLog:
    """Phases of one plane's oscillators.

    Attributes:
        names: Of its n joints, head to tail.
        phases: Without wrap-around [rad], shape (k, n).
        period_s: From sample to sample [s].
        whole: Whether each step is one period long, at the plane's usual rate, shape (k - 1,).
        inputs: u, None where no angles were logged, shape (k, n).
    """

    plane: str
    names: tuple[str, ...]
    phases: FloatArray
    period_s: float
    whole: BoolArray
    inputs: FloatArray | None


def read_phases(
    session: SessionView, start_ns: int | None = None, stop_ns: int | None = None
) -> tuple[PhaseLog, ...]:
    """Read the phases of oscillators.

    Args:
        start_ns: From when on [Unix ns]; from the start if None.
        stop_ns: Until when, not included; until the end if None.

    Returns:
        One log for each plane with at least two joints whose phases were logged.
    """
    if GAIT_TOPIC not in session.channels:
        return ()
    gait = session.joints(GAIT_TOPIC)
    planes: dict[str, list[str]] = {}
    for joint, plane in planes_of(session.robot).items():
        if f"{joint}.phase" in gait.names:
            planes.setdefault(plane, []).append(joint)
    if not any(len(joints) > 1 for joints in planes.values()):
        return ()
    angles = _angles(session)
    logs = (
        _log(gait, plane, tuple(joints), angles, (start_ns, stop_ns))
        for plane, joints in planes.items()
        if len(joints) > 1
    )
    return tuple(log for log in logs if log is not None)


def _log(
    gait: JointSignals,
    plane: str,
    names: tuple[str, ...],
    angles: JointSignals | None,
    span: tuple[int | None, int | None],
) -> PhaseLog | None:
    t_ns = gait.signal(f"{names[0]}.phase").t_ns
    columns = np.stack([gait.signal(f"{name}.phase").values for name in names], axis=1)
    complete = np.isfinite(columns).all(axis=1)
    complete &= t_ns >= (t_ns[0] if span[0] is None else span[0])
    complete &= t_ns < (t_ns[-1] + 1 if span[1] is None else span[1])
    if np.count_nonzero(complete) < 3:
        return None
    t_ns = t_ns[complete]
    phases = np.unwrap(columns[complete], axis=0)
    steps = np.diff(t_ns).astype(np.float64) / NS
    period_s = float(np.median(steps))
    whole: BoolArray = np.abs(steps - period_s) < _JITTER * period_s
    whole &= _steady(gait, plane, complete)
    inputs = None
    if angles is not None and set(names) <= set(angles.names):
        inputs = _inputs(gait, plane, names, angles, (t_ns, phases, complete, period_s))
    return PhaseLog(plane, names, phases, period_s, whole, inputs)


def _steady(gait: JointSignals, plane: str, complete: BoolArray) -> BoolArray:
    """Return the steps over which the plane's rate is the usual one."""
    rate = _value(gait, f"{plane}.omega", complete)
    if rate is None:
        return np.ones(np.count_nonzero(complete) - 1, dtype=np.bool_)
    usual = float(np.median(rate))
    same = np.abs(rate - usual) <= _SAME * abs(usual)
    return same[:-1]


def _inputs(
    gait: JointSignals,
    plane: str,
    names: tuple[str, ...],
    angles: JointSignals,
    at: tuple[IntArray, FloatArray, BoolArray, float],
) -> FloatArray | None:
    """Return 2 (q - Y) / A cos phi of all joints; None where a value is missing."""
    t_ns, phases, complete, period_s = at
    amplitude = _value(gait, f"{plane}.A", complete)
    size = 0.0 if amplitude is None else float(np.median(amplitude))
    if size <= 0.0:
        return None
    then_ns = t_ns - round(period_s * NS)
    felt = np.zeros_like(phases)
    for i, name in enumerate(names):
        offset = _value(gait, f"{name}.offset", complete)
        if offset is None:
            return None
        felt[:, i] = _held(angles.signal(name), then_ns) - offset
    # A joint without an angle so far has no feedback.
    return 2.0 * np.nan_to_num(felt) / size * np.cos(phases)


def _value(gait: JointSignals, name: str, complete: BoolArray) -> FloatArray | None:
    if name not in gait.names:
        return None
    return gait.signal(name).values[complete]


def _held(signal: Signal, t_ns: IntArray) -> FloatArray:
    """Return the newest value at each time; NaN before the first."""
    values = np.concatenate([[np.nan], signal.values])
    return values[np.searchsorted(signal.t_ns, t_ns, side="right")]


def _angles(session: SessionView) -> JointSignals | None:
    if RESPONSE_TOPIC not in session.channels:
        return None
    try:
        return session.joints(RESPONSE_TOPIC)
    except MissingChannelError:
        return None


@dataclass(frozen=True)
class KickInterval:
    """Phases between two kicks.

    Attributes:
        phases: Without jumps [rad], shape (k, n).
        inputs: u, what else turns each oscillator, shape (k, n); None where there is nothing.
    """

    phases: FloatArray
    inputs: FloatArray | None = None


@dataclass(frozen=True)
class OscillatorFit:
    """One oscillator's equation.

    Attributes:
        sources: Oscillators j that may act on it, p of them.
        omega: Its own rate [rad/s].
        omega_error: Standard error [rad/s].
        in_phase: K_ij cos(psi_ij) [1/s], shape (p,).
        quadrature: K_ij sin(psi_ij) [1/s], shape (p,).
        covariance: Of each pair (in phase, quadrature), shape (p, 2, 2).
        gain: eps_i [1/s] where there are inputs.
        noise: Of the state [rad/sqrt(s)].
        condition_number: Of the regressors, each of which is of size 1 at most.
    """

    sources: tuple[int, ...]
    omega: float
    omega_error: float
    in_phase: FloatArray
    quadrature: FloatArray
    covariance: FloatArray
    gain: float | None
    gain_error: float | None
    dof: int
    noise: float
    condition_number: float


def window_length(period_s: float) -> int:
    """Return sampling periods in a test function.

    Args:
        period_s: Of the samples [s].

    Returns:
        ``WINDOW_S``, and at least ``LEAST_SAMPLES`` periods.
    """
    return max(LEAST_SAMPLES, round(WINDOW_S / period_s))


def fit_oscillator(
    pieces: Sequence[KickInterval], period_s: float, target: int, sources: Sequence[int]
) -> OscillatorFit:
    """Estimate what turns one oscillator.

    Args:
        period_s: Of their samples [s].
        target: Which oscillator, i.
        sources: Which may act on it, j.

    Returns:
        The estimate; all but the condition number is NaN where that is above ``SINGULAR``.

    Raises:
        UsageError: If there are fewer windows than unknowns.
    """
    length = window_length(period_s)
    place = (np.arange(length) + 0.5) / length
    test = place * (1.0 - place)  # a parabola; its mean is 1 from here on
    test = test / test.mean()
    rows = [_equations(piece, period_s, target, sources, test) for piece in pieces]
    X, Z, y = (np.concatenate(part) for part in zip(*rows, strict=True))
    count, unknowns = X.shape
    if count <= unknowns:
        raise UsageError(
            f"{count} windows of {length * period_s:g} s for {unknowns} unknowns of each "
            "oscillator; record longer"
        )
    condition = float(np.linalg.cond(X))
    solved = condition < SINGULAR
    inverse = np.linalg.inv(Z.T @ X) if solved else np.full((unknowns, unknowns), np.nan)
    b = inverse @ (Z.T @ y)
    residual = y - X @ b
    variance = float(residual @ residual) / (count - unknowns)
    covariance = variance * inverse @ (Z.T @ Z) @ inverse.T
    error = np.sqrt(np.diag(covariance))
    pairs = 1 + 2 * np.arange(len(sources))
    extra = unknowns > 1 + 2 * len(sources)
    return OscillatorFit(
        sources=tuple(sources),
        omega=float(b[0]),
        omega_error=float(error[0]),
        in_phase=b[pairs],
        quadrature=-b[pairs + 1],
        covariance=np.array(
            [_mirrored(covariance[k : k + 2, k : k + 2]) for k in pairs.tolist()]
        ).reshape(-1, 2, 2),
        gain=float(b[-1]) if extra else None,
        gain_error=float(error[-1]) if extra else None,
        dof=count - unknowns,
        # y is a window's mean rate: its noise is that of the state times sqrt(sum w^2 / dt) / span.
        noise=(variance / float(np.square(test).mean()) * length * period_s) ** 0.5,
        condition_number=condition,
    )


def _mirrored(covariance: FloatArray) -> FloatArray:
    """Return the covariance of (a, -b) from that of (a, b)."""
    return covariance * np.array([[1.0, -1.0], [-1.0, 1.0]])


def _equations(
    piece: KickInterval, period_s: float, target: int, sources: Sequence[int], test: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Regressors, instruments and left sides of a piece's windows, as mean rates."""
    length = test.size
    count = (len(piece.phases) - 1) // length
    phases = piece.phases[: count * length + 1]
    columns = [np.ones(len(phases))]
    for source in sources:
        ahead = phases[:, source] - phases[:, target]
        columns += [np.sin(ahead), np.cos(ahead)]
    if piece.inputs is not None:
        columns.append(piece.inputs[: count * length + 1, target])
    x = np.stack(columns, axis=1)
    if count == 0:
        return x[:0], x[:0], np.zeros(0)
    means = _period_means(x).reshape(count, length, -1)
    steps = np.diff(phases[:, target]).reshape(count, length)
    weight = test / length
    return (np.einsum("l,wlc->wc", weight, means), x[:-1:length], steps @ weight / period_s)


def _period_means(x: FloatArray) -> FloatArray:
    """Average smooth columns over each sampling period, to fourth order (Euler-Maclaurin)."""
    slope = np.gradient(x, axis=0, edge_order=2)
    return (x[1:] + x[:-1]) / 2 - np.diff(slope, axis=0) / 12
