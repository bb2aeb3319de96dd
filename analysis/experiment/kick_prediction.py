"""Predict the closed loop: how generators with feedback relax on a body that was kicked.

:mod:`.analysis.oscillators.predictions` has the equations. P, R and the response to the gait have
errors, those of one run shared by all joints; draws of them give intervals of the modes' rates and
of the rest of a kick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.linalg import expm

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import DataError, UsageError

from ..common import formats
from ..common.estimate import Estimate
from ..estimators.intervals import TAILS, NoisyMatrix, noise_draws
from ..oscillators.laplacian import intervals_of, spectrum
from ..oscillators.predictions import felt_response, measured, relaxation
from ..results.coupling import BaseResponse, LocalCoupling, rows_of
from ..results.oscillators import ClosedLoop, LoopMode, Relaxation
from .local_coupling import stacked

POINTS = 50
"""Times at which the rest of a kick is predicted."""

SLOW = 0.1
"""Rates above this share of the gait's angular frequency leave the average over a cycle."""

SEED = 61


def closed_loop(
    coupling: LocalCoupling,
    eps: float,
    *,
    age_s: float = 0.0,
    kick: Mapping[str, float] | None = None,
    until_s: float | None = None,
) -> ClosedLoop:
    """Predict how phase oscillators with feedback from their servos relax, with nothing fitted.

    Args:
        coupling: From kicks of the open loop around one gait.
        eps: Of the feedback [1/s].
        age_s: How old an angle is on average when it is used [s].
        kick: Joint to the angle that its oscillator is turned by [rad]; none if None.
        until_s: How long to follow it [s]; three times the slowest relaxation's if None, at most
            100 cycles.

    Raises:
        UsageError: If eps isn't positive, the age or the time is negative, or there is no such
            joint.
        DataError: If the result is of an earlier version, without the response to the gait.
    """
    if not eps > 0 or not math.isfinite(eps):
        raise UsageError(f"--eps {eps:g}: the feedback has a positive rate [1/s], e.g. 0.3")
    if age_s < 0 or (until_s is not None and not until_s > 0):
        raise UsageError("--age is at least 0, --until more than 0")
    strange = [name for name in kick or {} if name not in coupling.joints]
    if strange:
        raise UsageError(f"--kick {strange[0]}: the joints are {', '.join(coupling.joints)}")
    base = coupling.base
    if base is None:
        raise DataError(
            "the result has no response to the gait without a kick; analyse the sessions again"
        )
    here, drawn = _generators(coupling, base, age_s)
    m = len(here)
    modes_here, ends = spectrum(np.eye(m) + here), intervals_of(np.eye(m) + here, np.eye(m) + drawn)
    modes = tuple(
        LoopMode(
            rate=_scaled(float(rate.real), ends.real[k], eps),
            turning=_scaled(float(rate.imag), ends.imag[k], eps),
            pattern_abs=tuple(np.abs(modes_here.patterns[:, k]).tolist()),
            pattern_rad=tuple(np.angle(modes_here.patterns[:, k]).tolist()),
        )
        for k, rate in enumerate(modes_here.rates.tolist())
    )
    omega = 2 * math.pi * base.frequency_hz
    fastest = eps * float(np.linalg.norm(here - here.mean(axis=0), ord=2))
    relaxed = None
    if kick:
        turned = np.array([kick.get(name, 0.0) for name in coupling.joints])
        slowest = eps * max(abs(modes_here.gap), 1e-9)
        end = min(3 / slowest, 100 / base.frequency_hz) if until_s is None else until_s
        relaxed = _relaxed(eps * here, eps * drawn, turned, end)
    return ClosedLoop(
        answer=_answer(modes, eps),
        joints=coupling.joints,
        eps=eps,
        age_s=age_s,
        frequency_hz=base.frequency_hz,
        bias=tuple(_felt(base, age_s).imag.tolist()),
        J=rows_of(eps * here),
        J_standard_error=rows_of(eps * drawn.std(axis=0)),
        modes=modes,
        relaxation=relaxed,
        valid_to=coupling.valid_to,
        fastest=fastest,
        limits=tuple(_limits(coupling, fastest, omega, kick or {})),
    )


def _felt(base: BaseResponse, age_s: float) -> ComplexArray:
    ratio = np.array(base.gain) * np.exp(-1j * np.array(base.lag_rad))
    return felt_response(ratio.astype(np.complex128), 2 * math.pi * base.frequency_hz, age_s)


def _generators(
    coupling: LocalCoupling, base: BaseResponse, age_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return J / eps, shape (m, m), and draws of it with errors, shape (DRAWS, m, m)."""
    m = len(coupling.joints)
    correlation = None if coupling.scatter is None else np.array(coupling.scatter.correlation)
    P, R = measured(coupling.P), measured(coupling.R)
    noise = noise_draws(stacked(((P,), (R,)), correlation), SEED)
    felt = _felt(base, age_s)
    gain, lag = np.array(base.gain), np.array(base.lag_error)
    error = np.concatenate([lag, np.array(base.gain_error) / gain])[:, None]
    dof = np.full_like(error, coupling.scatter.dof if coupling.scatter is not None else np.inf)
    dof = np.minimum(dof, 1e6)
    of_base = NoisyMatrix(np.zeros_like(error), error, dof, correlation)
    base_noise = noise_draws(of_base, SEED + 1)[..., 0]
    turned = felt * np.exp(base_noise[:, m:] + 1j * base_noise[:, :m])
    drawn = relaxation(P.value + noise[:, :m], R.value + noise[:, m:], turned)
    return relaxation(P.value, R.value, felt), drawn


def _relaxed(J: FloatArray, drawn: FloatArray, kick: FloatArray, until_s: float) -> Relaxation:
    """Return d phi(t) = exp(J t) d phi(0), and 95 % intervals from the draws."""
    times = np.linspace(0.0, until_s, POINTS + 1)
    step = float(times[1])

    def followed(generator: FloatArray) -> FloatArray:
        along = np.asarray(expm(generator * step), dtype=np.float64)
        now = np.broadcast_to(kick, (*generator.shape[:-2], len(kick))).copy()
        rows = [now]
        for _ in range(POINTS):
            now = np.einsum("...ij,...j->...i", along, now)
            rows.append(now)
        return np.stack(rows, axis=-2)

    here, there = followed(J), followed(drawn)
    low, high = np.quantile(there, TAILS, axis=0)
    return Relaxation(
        tuple(times.tolist()),
        rows_of(here),
        rows_of(np.minimum(2 * here - high, here)),
        rows_of(np.maximum(2 * here - low, here)),
    )


def _limits(
    coupling: LocalCoupling, fastest: float, omega: float, kick: Mapping[str, float]
) -> list[str]:
    """List the limits of the prediction, worst first."""
    limits: list[str] = []
    if not coupling.checks_pass:
        limits.append("P's rows don't sum to 1 within their errors: the prediction is doubtful")
    size = coupling.kick_size
    if size is not None and size.why is not None:
        limits.append(size.why)
    if fastest > SLOW * omega:
        limits.append(
            f"phases relax at up to {fastest:.2g} 1/s, more than {SLOW:g} of the gait's "
            f"{omega:.2g} rad/s: the average over a cycle doesn't hold; take a smaller eps"
        )
    largest = max((abs(deviation) for deviation in kick.values()), default=0.0)
    if coupling.valid_to is None:
        limits.append("how far from the gait it holds isn't known: no held-out run shows it")
    elif largest > coupling.valid_to:
        limits.append(
            f"the kick of {largest:.2g} rad is beyond {coupling.valid_to:.2g} rad, as far as "
            "held-out runs were predicted"
        )
    else:
        limits.append(
            f"holds for deviations up to {coupling.valid_to:.2g} rad, as held-out runs do"
        )
    limits.append(
        "holds around the gait that was kicked alone, and for phases that move slowly against the "
        "time in which the body settles"
    )
    return limits


def _answer(modes: tuple[LoopMode, ...], eps: float) -> str:
    slowest = modes[0].rate
    grows = sum(mode.rate.ci95 is not None and mode.rate.ci95[1] < 0 for mode in modes)
    relaxes = sum(mode.rate.ci95 is not None and mode.rate.ci95[0] > 0 for mode in modes)
    counts = (
        (relaxes, "relaxes", "relax"),
        (grows, "grows", "grow"),
        (len(modes) - grows - relaxes, "may do either", "may do either"),
    )
    parts = [
        f"{count} {singular if count == 1 else more}" for count, singular, more in counts if count
    ]
    return (
        f"with feedback of {eps:g} 1/s and the body as the only coupling, of {len(modes)} patterns "
        f"of the phases {', '.join(parts)}; the slowest has the rate "
        f"{formats.estimate(slowest, ' 1/s', most=5)}"
    )


def _scaled(value: float, ends: FloatArray, eps: float) -> Estimate:
    return Estimate(eps * value, (eps * float(ends[0]), eps * float(ends[1])))
