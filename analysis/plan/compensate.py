"""Commands that make the response homogeneous, from kicks around one gait.

Let w be the wanted wave, x = (d psi_c, d ln ``|c|``) the deviation of m commands from it and
y = (d psi, d ln ``|a|``) that of the responses. Kicks give dy = M dx with ::

    M = ( P  S )
        ( R  G ),

shape (2 m, 2 m), each element with a standard error; errors of different columns are independent.
All joints are to respond with the same gain, at any time: with C taking the mean off the phases and
``y* = (0, ln g*)``, commands x that gave y are followed by x + dx with the least ::

    E |C (y - y* + (M + E) dx)|^2 + k^2 |x + dx|^2
        = |C (y - y* + M dx)|^2 + dx' D dx + k^2 |x + dx|^2,    D_jj = sum_i var(M_ij).

D regularises by the errors of M: nothing is moved that the kicks do not show to help.
``identified`` is the trace of its resolution matrix. k is the price of a change. In contact there
are patterns of commands that the body hardly follows (13 yaw joints: singular values 0.04 and
0.06, the next 0.37); with k = 0 they are driven by whatever is left, far beyond the range of M, at
great expense of energy. With k a pattern of singular value s keeps 1/(1 + s^2/k^2) of its spread
and is commanded at most 1/(2 k) times that.

The step goes no farther than M holds (``valid_to`` of the kicks), and no amplitude beyond the
limits of position and rate of its servo. A contact is not linear, so the step is repeated from the
response that was measured: M need not be measured again while it is near enough for the step to
contract.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.robot.model import Robot

from ..experiment.pooling import pool_runs
from ..parts.heterogeneity.measure import response_indices
from ..parts.heterogeneity.result import Index
from ..response.response import Response
from ..results.coupling import LocalCoupling
from ..session.runs import SAME_COMMAND, SAME_FREQUENCY, GaitRun, command_change
from .runs import BaseGait

RESERVE = 0.01
"""Share of a servo's limit that commands leave free."""

KEEP = 0.15
"""k, unless another is chosen."""

LEAST_STEP = 0.05
"""Step that is always allowed [rad or log amplitude]: the size of a usual kick."""


@dataclass(frozen=True)
class DrivenStart:
    """Commands that were driven, and their response; both against the wanted wave.

    Attributes:
        x: d ln ``|c|`` + j d psi_c, mean phase 0, shape (m,).
        response: a/w, shape (m,).
    """

    x: ComplexArray
    response: Response


@dataclass(frozen=True)
class Spreads:
    """How unlike the joints respond to the wanted wave.

    Attributes:
        gain_cv: Coefficient of variation of ``|a|/|w|``, what noise adds taken off.
        lag_sd: Circular standard deviation of the lag behind w [rad], likewise.
    """

    gain_cv: Index
    lag_sd: Index


@dataclass(frozen=True)
class JointCommand:
    """What a joint is commanded now.

    Attributes:
        phase_rad: Of its command against the wanted wave, positive = earlier [rad].
        log_amplitude: ln of its amplitude over the wanted wave's.
        limit_rad: Largest amplitude that the servo allows [rad]; None without a description.
        limited_by: ``position`` or ``rate``, whichever sets the limit; None without.
        margin: Share of the limit that is left; None without.
        lacking: ln of the amplitude that homogeneity would need over that commanded; 0 where the
            joint is not at its limit.
    """

    name: str
    phase_rad: float
    log_amplitude: float
    amplitude_rad: float
    limit_rad: float | None
    limited_by: str | None
    margin: float | None
    lacking: float


@dataclass(frozen=True)
class Compensation:
    """The next commands.

    Attributes:
        target_gain: ``g*``, ``|a|/|w|`` that all joints are to have.
        kicked: Response to the wanted wave itself, as the kicks' runs without a kick gave it.
        now: Response to the commands that the step starts from; the same without earlier ones.
        predicted_gain_cv: Of the commands written here, by M.
        predicted_lag_sd: The same [rad].
        prediction_error: Root mean square of what the errors of M leave open, a joint.
        identified: Directions that the kicks identify, of ``directions`` = 2 m - 1: all phases
            together are a shift of time.
        keep: k, the price of a change of the commands.
        largest_step: Largest step of a phase [rad] or log amplitude.
        step_limit: Largest that is allowed; where it is reached, the command is to be given again.
        nonlinearity: Of the kicks; what a step is off by, in shares of it.
    """

    target_gain: float
    kicked: Spreads
    now: Spreads
    predicted_gain_cv: float
    predicted_lag_sd: float
    prediction_error: float
    identified: float
    directions: int
    keep: float
    largest_step: float
    step_limit: float
    nonlinearity: float | None
    joints: tuple[JointCommand, ...]


def compensation(
    coupling: LocalCoupling,
    base: BaseGait,
    robot: Robot | None,
    after: Sequence[GaitRun] = (),
    *,
    target_gain: float | None = None,
    keep: float = KEEP,
) -> tuple[Compensation, ComplexArray]:
    """Return the next commands.

    Args:
        coupling: From kicks of phase and amplitude around the gait.
        base: The wanted wave: the gait that was kicked, or one near it.
        robot: Its limits are kept; None keeps none.
        after: Runs of one compensation of this wave; several are averaged.
        target_gain: The geometric mean of the kicks' runs without a kick if None.
        keep: k, the price of a change of the commands.

    Returns:
        The compensation, and the complex amplitudes of its commands [rad], shape (m,).

    Raises:
        DataError: If the kicks lack those of amplitude or the response to the gait.
        UsageError: If joints or runs do not fit each other, a command is beyond its limits already
            the target is not positive or the price negative.
    """
    M, variance = _matrix(coupling)
    m = len(coupling.joints)
    names = tuple(base.names[k] for k in base.driven)
    if names != coupling.joints:
        raise UsageError(
            f"--like drives {', '.join(names)}, the kicks are of {', '.join(coupling.joints)}; "
            "name a session of the gait that was kicked"
        )
    kicked = _kicked(coupling)
    start = (
        _driven(base, names, after) if after else DrivenStart(np.zeros(m, np.complex128), kicked)
    )
    gain = float(np.exp(np.mean(np.log(kicked.gain)))) if target_gain is None else target_gain
    if not gain > 0 or not keep >= 0:
        raise UsageError(f"--gain {gain:g} has to be above 0, --keep {keep:g} at least 0")
    limits = _limits(base, robot)
    over = np.abs(base.amplitude) > limits.min(axis=0)
    if over.any():
        worst = int(np.argmax(over))
        raise UsageError(
            f"{names[worst]} is commanded more than its servo's limit of "
            f"{limits[:, worst].min():.3g} rad already; name a gait of less amplitude"
        )
    most = max(coupling.valid_to or 0.0, LEAST_STEP)
    allowed = np.log((1 - RESERVE) * limits.min(axis=0) / np.abs(base.amplitude)) - start.x.real
    allowed = np.maximum(allowed, -most / 2)  # of a joint at its limit it is about 0
    y = np.concatenate([-start.response.lag_near_mean_rad, np.log(start.response.gain / gain)])
    here = np.concatenate([start.x.imag, start.x.real])
    A = np.vstack([_centred(M), np.diag(np.sqrt(variance)), keep * np.eye(2 * m)])
    b = -np.concatenate([_centred(y), np.zeros(2 * m), keep * here])
    free = _bounded(A, b, np.full(m, most), most)
    step = _bounded(A, b, allowed, most)
    x = start.x + step[m:] + 1j * (step[:m] - step[:m].mean())
    commands = (base.amplitude * np.exp(x)).astype(np.complex128)
    left = y + M @ step
    lag, relative = left[:m] - left[:m].mean(), np.exp(left[m:])
    lacking = np.where(step[m:] > allowed - 1e-6, np.maximum(free - step, 0.0)[m:], 0.0)
    sizes = np.abs(commands)
    return Compensation(
        target_gain=gain,
        kicked=_spreads(kicked),
        now=_spreads(start.response),
        predicted_gain_cv=float(relative.std() / relative.mean()),
        predicted_lag_sd=float(lag.std()),
        prediction_error=float(variance @ step**2 / m) ** 0.5,
        identified=_identified(M, variance),
        keep=keep,
        directions=2 * m - 1,
        largest_step=float(np.abs(step).max()),
        step_limit=most,
        nonlinearity=coupling.nonlinearity.value,
        joints=tuple(_joint(names[k], x[k], sizes[k], limits[:, k], lacking[k]) for k in range(m)),
    ), commands


def _centred(values: FloatArray) -> FloatArray:
    """Take the mean off the phases, the first half of the rows."""
    m = len(values) // 2
    return np.concatenate([values[:m] - values[:m].mean(axis=0), values[m:]])


def _bounded(A: FloatArray, b: FloatArray, allowed: FloatArray, most: float) -> FloatArray:
    """Return the step dx of least squares within its bounds, shape (2 m,)."""
    upper = np.concatenate([np.full(len(allowed), most), np.minimum(allowed, most)])
    solution = lsq_linear(A, b, bounds=(np.full(len(upper), -most), upper), method="bvls")
    return np.asarray(solution.x, dtype=np.float64)


def _identified(M: FloatArray, variance: FloatArray) -> float:
    """Return the trace of the resolution matrix of M's errors."""
    seen = _centred(M).T @ _centred(M)
    resolution = np.linalg.pinv(seen + np.diag(variance), hermitian=True) @ seen
    return float(np.trace(resolution))


def _matrix(coupling: LocalCoupling) -> tuple[FloatArray, FloatArray]:
    """Return M, and the sum over each column of the variances of its elements."""
    P, R, G, S = coupling.P, coupling.R, coupling.G, coupling.S
    if G is None or S is None:
        raise DataError(
            "the kicks have no amplitude kicks, so how amplitudes respond is not known; record "
            "those of undulog plan phase-kicks"
        )
    value, error = (
        np.block([[np.array(getattr(matrix, part)) for matrix in row] for row in ((P, S), (R, G))])
        for part in ("value", "standard_error")
    )
    return value, np.sum(np.square(error), axis=0)


def _kicked(coupling: LocalCoupling) -> Response:
    """Return the response to the gait without a kick."""
    base, scatter = coupling.base, coupling.scatter
    if base is None or scatter is None:
        raise DataError(
            "the result has no response to the gait without a kick; analyse the sessions again"
        )
    gain, gain_error = np.array(base.gain), np.array(base.gain_error)
    ratio = (gain * np.exp(-1j * np.array(base.lag_rad))).astype(np.complex128)
    dof = np.full(len(gain), float(max(scatter.dof, 1)))
    return Response(ratio, (gain_error / gain) ** 2, np.square(base.lag_error), dof)


def _driven(base: BaseGait, names: Sequence[str], after: Sequence[GaitRun]) -> DrivenStart:
    """Return commands and response of the runs of a compensation, against the wanted wave."""
    first = after[0]
    for run in after:
        off = abs(2 * math.pi * run.frequency_hz - base.omega) > SAME_FREQUENCY * base.omega
        if run.names != tuple(names) or off:
            raise UsageError(f"--after {run.label}: it drives other joints or another frequency")
        if np.abs(command_change(run.command, first.command) - 1).max() > SAME_COMMAND:
            raise UsageError(
                f"--after {run.label} and {first.label} have other commands; name runs of the "
                "newest compensation only"
            )
    pooled = pool_runs(names, [run.response for run in after])
    if pooled.names != tuple(names):
        lost = [name for name in names if name not in pooled.names]
        raise UsageError(f"--after {first.label}: no gain and lag of {', '.join(lost)}")
    change: ComplexArray = first.command / base.amplitude
    change = change * np.exp(-1j * np.angle(np.sum(change / np.abs(change))))  # an earlier start
    phase = np.angle(change)
    x = (np.log(np.abs(change)) + 1j * (phase - phase.mean())).astype(np.complex128)
    response = pooled.response
    ratio = (response.ratio * np.exp(x)).astype(np.complex128)
    return DrivenStart(
        x, Response(ratio, response.log_gain_variance, response.lag_variance, response.dof)
    )


def _limits(base: BaseGait, robot: Robot | None) -> FloatArray:
    """Return the largest amplitudes by position and by rate [rad], inf where none, shape (2, m)."""
    limits = np.full((2, len(base.driven)), np.inf)
    joints = {} if robot is None else {joint.name: joint for joint in robot.joints}
    for row, k in enumerate(base.driven):
        joint = joints.get(base.names[k])
        if joint is not None:
            middle = float(base.offset[k])
            limits[:, row] = (
                min(joint.upper - middle, middle - joint.lower),
                joint.max_velocity / base.omega,
            )
    return limits


def _spreads(response: Response) -> Spreads:
    indices = response_indices(response)
    return Spreads(indices["gain_cv"], indices["lag_sd"])


def _joint(
    name: str, x: complex, amplitude: float, limits: FloatArray, lacking: float
) -> JointCommand:
    limit = float(limits.min())
    limited = math.isfinite(limit)
    return JointCommand(
        name=name,
        phase_rad=float(x.imag),
        log_amplitude=float(x.real),
        amplitude_rad=float(amplitude),
        limit_rad=limit if limited else None,
        limited_by=("position", "rate")[int(np.argmin(limits))] if limited else None,
        margin=1 - float(amplitude) / limit if limited else None,
        lacking=float(lacking),
    )
