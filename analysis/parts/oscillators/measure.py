"""The couplings of a chain of oscillators, and whether its commands follow the sensors.

Where a controller feeds measured motion back into the commands, it feeds back the sensors' noise,
too. With commands u = C (r - y) and positions y = G u + v the response estimated from u to y tends,
where v has the larger power, to -1 / C, the inverse of the controller, instead of G (Forssell &
Ljung, Automatica 35, 1999, doi 10.1016/S0005-1098(99)00022-9).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from scipy.special import fdtrc

from undulog.capture import SessionView
from undulog.capture.common.arrays import NS, BoolArray, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError

from ...common.answer import beyond, percent
from ...common.estimate import Estimate, leaves_out_zero
from ...common.remarks import Note
from ...estimators.intervals import CONFIDENCE, around, t_factor
from ...signals.stretch import GAIT_TOPIC, Options
from ..frequency_response.result import DIRECT, INDIRECT, JointFrequencyResponse
from .result import ChainCoupling, OscillatorLink, Rate
from .weak_form import KickInterval, OscillatorFit, fit_oscillator, read_phases, window_length

LEAST_KICK = 0.1
"""A phase that jumps by less between two samples, against those beside them, isn't kicked [rad]."""

BEYOND_NOISE = 8.0
"""A jump must stand out of the noise of the steps by this many standard deviations, too."""

_SIGMA_OF_MAD = 1.4826

MOST_CONDITION = 500.0
"""Condition number beyond which couplings are refused: random kicks of up to 1 rad every 5 s give
40 to 200, of up to 0.3 rad 500 to 2000, locked phases without noise more than 1e6."""

MOST_NOISE = 0.5
"""Standard errors beyond this share of the couplings, both root mean square, are refused: noise
alone moves locked phases too, but so little that only its size can be estimated."""

RECORD = (
    "the chain kicked as it runs: each phase turned at once by random amounts up to 1 rad, every "
    "few seconds, for a minute (kick_every_s = 5, kick_size = 1 in the scenario's gait)"
)

_ADAPTIVE = {
    "steer": "steering",
    "shrink": "amplitudes by obstacles beside it",
    "haste": "frequency by an obstacle behind it",
    "course": "course",
}
"""First parts of the names on ``/gait`` that only a controller logs."""


def kicked_steps(phases: FloatArray) -> BoolArray:
    """Find the steps from sample to sample that hold a kick.

    Args:
        phases: Of n oscillators, without wrap-around [rad], shape (k, n).

    Returns:
        Shape (k - 1,).
    """
    steps = np.diff(phases, axis=0)
    if len(steps) < 3:
        return np.zeros(len(steps), dtype=np.bool_)
    # Against the smaller of the two differences, so that the step after a kick isn't one, too.
    change = np.abs(np.diff(steps, axis=0))
    edge = np.zeros((1, phases.shape[1]))  # the first step and the last have one side only
    lone = np.minimum(np.concatenate([edge, change]), np.concatenate([change, edge]))
    usual = _SIGMA_OF_MAD * np.median(lone, axis=0)
    return np.any(lone > np.maximum(LEAST_KICK, BEYOND_NOISE * usual), axis=1)


def between_kicks(
    phases: FloatArray, whole: BoolArray, inputs: FloatArray | None = None
) -> tuple[KickInterval, ...]:
    """Cut a record where a phase jumps or a sample is missing.

    Args:
        phases: [rad], shape (k, n).
        whole: Whether each step from sample to sample lasts one period, shape (k - 1,).
        inputs: What else turns the oscillators, shape (k, n).

    Returns:
        The pieces, in order; those of a single sample are left out.
    """
    cut = np.flatnonzero(kicked_steps(phases) | ~whole) + 1
    bounds = [0, *cut.tolist(), len(phases)]
    return tuple(
        KickInterval(phases[i:j], None if inputs is None else inputs[i:j])
        for i, j in pairwise(bounds)
        if j - i > 1
    )


def chain_coupling(
    plane: str,
    names: Sequence[str],
    phases: FloatArray,
    period_s: float,
    *,
    whole: BoolArray | None = None,
    inputs: FloatArray | None = None,
    reach: int = 1,
) -> ChainCoupling:
    """Estimate the couplings of a chain from its phases.

    Args:
        plane: Of the chain's joints.
        names: Of the n oscillators, head to tail.
        phases: [rad], without wrap-around, shape (k, n).
        period_s: From sample to sample [s].
        whole: Whether each step lasts one period, shape (k - 1,); all do if None.
        inputs: u, what else turns the oscillators, shape (k, n).
        reach: Couplings are looked for up to abs(i - j) = reach; Eq. 1 has 1.

    Returns:
        The couplings, or why they can't be estimated and what to record.
    """
    n = len(names)
    steps = np.ones(len(phases) - 1, dtype=np.bool_) if whole is None else whole
    pieces = between_kicks(phases, steps, inputs)
    kicks = sum(1 for _ in pairwise(pieces)) - int(np.count_nonzero(~steps))
    duration_s = period_s * sum(len(piece.phases) - 1 for piece in pieces)

    def refused(why: str, condition: float | None) -> ChainCoupling:
        return ChainCoupling(plane, False, why, RECORD, condition, max(kicks, 0), duration_s, reach)

    length = window_length(period_s)
    windows = sum((len(piece.phases) - 1) // length for piece in pieces)
    unknowns = 1 + 2 * min(2 * reach, n - 1) + (inputs is not None)
    if windows <= 2 * unknowns:
        why = f"{duration_s:.3g} s of phases are too short for {unknowns} unknowns an oscillator"
        return refused(why, None)
    fits = [
        fit_oscillator(pieces, period_s, i, [j for j in range(n) if j != i and abs(i - j) <= reach])
        for i in range(n)
    ]
    condition = max(fit.condition_number for fit in fits)
    finite = condition if np.isfinite(condition) else None
    if condition > MOST_CONDITION:
        return refused(
            f"the phases are locked: condition number {beyond(condition, MOST_CONDITION)}, at "
            f"most {MOST_CONDITION:g} is taken",
            finite,
        )
    share = _noise_share(fits)
    if share > MOST_NOISE:
        return refused(
            f"the phases are all but locked (condition number {condition:.2g}): standard errors "
            f"are {percent(share, MOST_NOISE)} of the couplings, at most {100 * MOST_NOISE:.0f} % "
            "is taken",
            finite,
        )
    return ChainCoupling(
        plane=plane,
        identifiable=True,
        why=f"weak form over {windows} windows of {length * period_s:.2g} s between {kicks} kicks",
        record=None,
        condition_number=finite,
        kicks=kicks,
        duration_s=duration_s,
        reach=reach,
        links=tuple(
            _link(names[j], names[i], fit, k)
            for i, fit in enumerate(fits)
            for k, j in enumerate(fit.sources)
        ),
        oscillators=tuple(_rate(name, fit) for name, fit in zip(names, fits, strict=True)),
    )


def _noise_share(fits: Sequence[OscillatorFit]) -> float:
    """Return the root mean square of the standard errors over that of the couplings."""
    squared = sum(float(np.square([fit.in_phase, fit.quadrature]).sum()) for fit in fits)
    errors = sum(float(np.sum(np.trace(fit.covariance, axis1=1, axis2=2))) for fit in fits)
    return (errors / squared) ** 0.5


def _link(source: str, target: str, fit: OscillatorFit, k: int) -> OscillatorLink:
    """Return K and psi from (K cos psi, K sin psi), to first order in their errors."""
    pair: FloatArray = np.array([fit.in_phase[k], fit.quadrature[k]])
    size = float(np.hypot(pair[0], pair[1]))
    covariance: FloatArray = fit.covariance[k]
    along, across = pair / size, np.array([-pair[1], pair[0]]) / size
    factor = t_factor(fit.dof)
    half = factor * float(along @ covariance @ along) ** 0.5
    turn = factor * float(across @ covariance @ across) ** 0.5 / size
    # Does the pair differ from zero? A length is never below zero.
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), pair)
    F = float(np.square(whitened).sum()) / 2
    shown = bool(fdtrc(2, fit.dof, F) < 1 - CONFIDENCE)
    low = max(0.0, size - half) if shown else 0.0
    lag = float(np.arctan2(pair[1], pair[0]))
    return OscillatorLink(
        source,
        target,
        Estimate(size, (low, size + half)),
        Estimate(lag, around(lag, turn)) if shown and turn < np.pi else Estimate(),
    )


def _rate(name: str, fit: OscillatorFit) -> Rate:
    factor = t_factor(fit.dof)
    feedback = Estimate()
    if fit.gain is not None and fit.gain_error is not None:
        feedback = Estimate(fit.gain, around(fit.gain, factor * fit.gain_error))
    omega = Estimate(fit.omega, around(fit.omega, factor * fit.omega_error))
    return Rate(name, omega, feedback, fit.noise)


def session_couplings(
    session: SessionView, start_s: float | None = None, stop_s: float | None = None
) -> tuple[ChainCoupling, ...]:
    """Estimate the couplings of each plane's oscillators.

    Args:
        start_s: From when on, from the session's start [s]; all of it if None.
        stop_s: Until when [s].

    Returns:
        One a plane; none where no oscillator's phase was logged.
    """
    start_ns, stop_ns = (
        None if time_s is None else session.start_ns + round(time_s * NS)
        for time_s in (start_s, stop_s)
    )
    return tuple(
        chain_coupling(
            log.plane, log.names, log.phases, log.period_s, whole=log.whole, inputs=log.inputs
        )
        for log in read_phases(session, start_ns, stop_ns)
    )


def closed_loop(
    session: SessionView, options: Options, responses: Sequence[JointFrequencyResponse], warn: Warn
) -> str | None:
    """Find what makes the commands depend on measured motion, and warn of its bias.

    Args:
        responses: The frequency responses; those by the indirect method have no such bias.

    Returns:
        A noun phrase, or None where the log shows nothing of the kind.
    """
    if not responses:
        if options.excitation_topic is not None:
            warn(f"{options.excitation_topic}: not used, as there are no frequency responses")
        return None
    cause = _cause(session, options)
    direct = [response.joint for response in responses if response.method == DIRECT]
    if indirect := [response.joint for response in responses if response.method == INDIRECT]:
        warn(
            Note(
                f"{', '.join(indirect)}: frequency response by the indirect method, response over "
                f"command, each to {options.excitation_topic}: noise that a loop feeds back does "
                "not bias it"
            )
        )
    if direct and options.excitation_topic is not None:
        warn(
            f"{', '.join(direct)}: no samples that move on {options.excitation_topic}; the "
            "frequency response is by the direct method"
        )
    if cause is not None and direct:
        warn(
            f"the commands depend on measured motion, through {cause}: noise that the loop feeds "
            "back biases a frequency response from command to position towards the inverse of the "
            "controller; record with commands from a plan instead, or name the topic of what the "
            "commands follow from outside (--excitation-topic)"
        )
    return cause


def _cause(session: SessionView, options: Options) -> str | None:
    if GAIT_TOPIC in session.channels:
        try:
            names = session.joints(GAIT_TOPIC).names
        except (DataError, LogError):
            names = ()  # the warning is given where gain and lag over time are read
        if adaptive := adaptive_parts(names):
            return f"an adaptive controller ({', '.join(adaptive)})"
    chains = session_couplings(session, options.start_s, options.stop_s)
    rates = [rate for chain in chains for rate in chain.oscillators]
    fed = [rate.name for rate in rates if leaves_out_zero(rate.feedback.ci95)]
    return f"oscillators with feedback from their servos ({', '.join(fed)})" if fed else None


def adaptive_parts(names: Iterable[str]) -> list[str]:
    """Return what a controller adapts, by the names that it logs on ``/gait``."""
    logged = {name.partition(".")[0] for name in names}
    return [text for part, text in _ADAPTIVE.items() if part in logged]
