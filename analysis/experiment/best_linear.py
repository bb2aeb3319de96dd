"""Best linear approximations, noise and distortion of the runs of a multisine experiment.

Of a nonlinear system driven by a random-phase multisine,

    Y(k) / U(k) = G_BLA(k) + S(k) / U(k) + V(k) / U(k),                                  (1)

where V, the noise, differs from period to period, and S, the stochastic nonlinear distortion, only
from one realisation of the phases to the next. The scatter over periods therefore gives the noise,
and what the scatter over realisations is above it the distortion (the robust method). A multisine
of odd lines, some of them left out, shows the kind of distortion already in one realisation: a
nonlinearity of even order puts power into even lines, one of odd order into the odd ones that
were left out.

With m inputs, U(k) is a matrix of at least m experiments of one realisation, and Y(k) / U(k) is
Y(k) U(k)^+.

Source: Pintelon & Schoukens, System Identification, 2nd ed. (Wiley 2012), sections 4.3 and 7.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.console import Warn

from ..common import formats
from ..common.estimate import Estimate
from ..parts.frequency_response.excitation import ExcitationKind
from ..parts.frequency_response.measure import joint_response, sound_lines
from ..parts.frequency_response.nonparametric import LineResponse, line_power, noise_power
from ..results.best_linear import BestLinearJoint, BestLinearResponses, CrossResponse
from .distortion_spread import DistortionSpread, LevelSpread, distortion_spread
from .multisine_runs import MultisineRun
from .sweep_runs import MOST_CONDITION

NO_SPREAD, NO_SPREADS = LevelSpread(), DistortionSpread()

IMPURE = 0.01
"""Share of the commands at lines that the plan leaves out from which a warning is given."""


def best_linear_responses(runs: Sequence[MultisineRun], warn: Warn) -> BestLinearResponses | None:
    """Estimate the response of each joint.

    Args:
        runs: Of one experiment, at least one.

    Returns:
        None where no realisation can be used; warnings say why.
    """
    design, names = runs[0].design, runs[0].names
    periods = min(run.periods for run in runs)
    if periods < max(run.periods for run in runs):
        warn(f"some run has {periods} steady periods only: of all of them so many are used")
    orthogonal = design.inputs == "orthogonal" and len(names) > 1
    groups = _realisations(runs, warn, orthogonal=orthogonal)
    if not groups:
        return None
    joints = [name for name in names if all(name in run.response for run in runs)]
    if lost := [name for name in names if name not in joints]:
        warn(f"without a response in every run: {', '.join(lost)}")
    _warn_inputs(runs, (len(groups), periods), warn)
    lines: IntArray = np.array(design.lines)
    freedom = len(groups) - 1 or (periods - 1) * len(groups[0])
    whole = [_inverse(group, range(len(names))) for group in groups] if orthogonal else None
    results: list[BestLinearJoint] = []
    cross: list[CrossResponse] = []
    for joint in joints:
        place = names.index(joint)
        inverses = whole or [_inverse(group, [place]) for group in groups]
        spectra = [
            np.stack([run.response[joint][:periods] for run in group]) for group in groups
        ]  # (E, P, n) each
        estimates = [
            realisation_response(inverse, spectrum[:, :, lines])
            for inverse, spectrum in zip(inverses, spectra, strict=True)
        ]
        spread = _spread(groups, place, lines)
        every = [
            over_realisations(
                np.stack([value[k] for value, _ in estimates]),
                np.stack([noise[k] for _, noise in estimates]),
                spread.excited,
            )
            for k in range(len(estimates[0][0]))
        ]
        approximation = every[place if orthogonal else 0]
        sharing = () if orthogonal else tuple(name for name in names if name != joint)
        result = _joint(joint, sharing, approximation, freedom, lines / design.period_s)
        if result is None:
            warn(f"{joint}: no line has a response with an interval; it is left out")
            continue
        if periods > 1 and (lines % 2 == 1).all():
            powers = [line_power(y).mean(axis=0) for y in spectra]
            beside = detection_lines(powers, lines, spread)
            result = replace(result, odd=beside.odd, even=beside.even)
        results.append(result)
        if orthogonal:
            cross += [
                _cross(joint, name, other)
                for name, other in zip(names, every, strict=True)
                if name != joint
            ]
    if not results:
        return None
    return BestLinearResponses(
        inputs="orthogonal" if orthogonal else "same",
        realisations=len(groups),
        periods=periods,
        period_s=design.period_s,
        lines=design.lines,
        joints=tuple(results),
        cross=tuple(cross),
    )


def _realisations(
    runs: Sequence[MultisineRun], warn: Warn, *, orthogonal: bool
) -> list[list[MultisineRun]]:
    """Return the runs of each realisation that can be used."""
    by_number: dict[int, list[MultisineRun]] = {}
    for run in runs:
        by_number.setdefault(run.design.realisation, []).append(run)
    m = len(runs[0].names)
    usable: list[list[MultisineRun]] = []
    for number, group in sorted(by_number.items()):
        if not orthogonal:
            if all(run.shared for run in group):
                usable.append(group)
            else:
                warn(
                    f"realisation {number} is left out: its joints have different commands, though "
                    "one for all was expected"
                )
            continue
        regular = len(group) >= m
        if regular:
            matrices = np.moveaxis(np.stack([run.command for run in group], axis=1), 2, 0)
            regular = bool(np.linalg.cond(matrices).max() <= MOST_CONDITION)
        if regular:
            usable.append(group)
        else:
            warn(
                f"realisation {number} is left out: its {len(group)} runs don't have the {m} "
                f"independent commands of {m} joints"
            )
    return usable


def _spread(
    groups: Sequence[Sequence[MultisineRun]], place: int, lines: IntArray
) -> DistortionSpread:
    """Return the spread of distortion of one joint, by the amplitudes of its command."""
    sizes = [np.abs(run.command[place]) for group in groups for run in group]
    return distortion_spread(lines, np.mean(sizes, axis=0), len(groups))


def _inverse(group: Sequence[MultisineRun], inputs: Sequence[int]) -> ComplexArray:
    return input_inverse(np.stack([run.command[[*inputs]] for run in group], axis=1))


def _warn_inputs(runs: Sequence[MultisineRun], counts: tuple[int, int], warn: Warn) -> None:
    impurity = max(run.impurity for run in runs)
    if impurity > IMPURE:
        warn(
            f"the commands have {100 * impurity:.2g} % of their size at lines that they should "
            "leave out: distortion of odd and even order holds what the joints make of that"
        )
    if min(counts) < 2:
        unit = "realisation" if counts[0] < 2 else "period"
        warn(f"one {unit}: nonlinear distortion is not separable from noise")


def _joint(
    joint: str,
    sharing: tuple[str, ...],
    approximation: BestLinearApproximation,
    freedom: int,
    frequency_hz: FloatArray,
) -> BestLinearJoint | None:
    """Return the result of one joint; None where no line has an interval."""
    variance = approximation.total if approximation.realisations > 1 else approximation.noise
    every = np.full(frequency_hz.size, float(freedom))
    lines = sound_lines(LineResponse(frequency_hz, approximation.value, variance, every))
    if not lines.frequency_hz.size:
        return None
    kept = np.isin(frequency_hz, lines.frequency_hz)
    response = joint_response(joint, str(ExcitationKind.PERIODIC), sharing, lines)
    separable = approximation.relative_distortion.value is not None
    return BestLinearJoint(
        response=replace(response, distortion=approximation.relative_distortion.value),
        noise_sd=_root(approximation.noise[kept]),
        distortion_sd=_root(approximation.distortion[kept]) if separable else None,
        distortion=approximation.relative_distortion,
        odd=Estimate(),
        even=Estimate(),
    )


def _root(variance: FloatArray) -> tuple[float, ...] | None:
    if not np.isfinite(variance).all():
        return None
    return tuple(np.sqrt(np.maximum(variance, 0.0)).tolist())


def _cross(joint: str, command: str, approximation: BestLinearApproximation) -> CrossResponse:
    variance = approximation.total if approximation.realisations > 1 else approximation.noise
    return CrossResponse(
        joint,
        command,
        tuple(np.abs(approximation.value).tolist()),
        tuple((-np.angle(approximation.value)).tolist()),
        _root(variance) or (),
    )


def multisine_answer(responses: BestLinearResponses | None) -> str:
    """Answer from the responses.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if responses is None:
        return "no best linear approximation: the warnings say why"
    count = len(responses.joints)
    low, high = (line / responses.period_s for line in (responses.lines[0], responses.lines[-1]))
    lead = (
        f"best linear approximation of {count} joint{'s' if count > 1 else ''} at "
        f"{len(responses.lines)} lines from {low:.3g} to {high:.3g} Hz, "
        f"{responses.realisations} realisation{'s' if responses.realisations > 1 else ''} of "
        f"{responses.periods} period{'s' if responses.periods > 1 else ''}"
    )
    worst = max(responses.joints, key=lambda joint: joint.distortion.value or 0.0)
    if worst.distortion.value is None:
        return f"{lead}: nonlinear distortion is not separable from noise"
    return f"{lead}: {_distortion(worst, count)}"


def _distortion(worst: BestLinearJoint, count: int) -> str:
    where = f"at {worst.response.joint}" if count == 1 else f"largest at {worst.response.joint}"
    low = 0.0 if worst.distortion.ci95 is None else worst.distortion.ci95[0]
    if low <= 0:
        end = worst.distortion.value if worst.distortion.ci95 is None else worst.distortion.ci95[1]
        most = formats.number(100 * (end or 0.0), 2)
        return f"no nonlinear distortion is shown ({where} at most {most} %)"
    parts = [
        f"{name} order {formats.percent(level)}"
        for name, level in (("odd", worst.odd), ("even", worst.even))
        if level.value is not None
    ]
    orders = f" ({', '.join(parts)} of the response at the lines left out)" if parts else ""
    return f"nonlinear distortion {where}, {formats.percent(worst.distortion)} of the gain{orders}"


def multisine_method(responses: BestLinearResponses) -> str:
    """Return the method as one sentence, beginning in lower case."""
    inputs = (
        "all commands the same"
        if responses.inputs == "same"
        else "orthogonal commands of all joints, so that the response to each is known (--json)"
    )
    return (
        f"random-phase multisines, {inputs}: robust method (Pintelon & Schoukens 2012, 4.3); noise "
        "from the scatter of periods, noise and distortion together from that of realisations, "
        "odd and even order from the lines that the commands leave out; intervals at 95 % over "
        "the realisations (Student's t)."
    )


@dataclass(frozen=True)
class BestLinearApproximation:
    """Response at k excited lines, from M realisations of P periods.

    Attributes:
        value: G_BLA, shape (k,).
        noise: E|e|^2 of ``value`` made by noise, shape (k,); NaN from one period.
        total: E|e|^2 of ``value`` made by noise and distortion, shape (k,); NaN from one
            realisation.
        distortion: E|S / U|^2 of one realisation, unbiased, so that it may be below zero, shape
            (k,); NaN from one realisation or period, where it can't be separated from noise.
        relative_distortion: Root mean square of the distortion over that of G_BLA, over the lines;
            0 where the unbiased square is below zero. Its interval is from the scatter of the
            realisations; empty where the distortion is NaN.
        realisations: M.
    """

    value: ComplexArray
    noise: FloatArray
    total: FloatArray
    distortion: FloatArray
    relative_distortion: Estimate
    realisations: int


def input_inverse(inputs: ComplexArray) -> ComplexArray:
    """Return U^+ at each line.

    Args:
        inputs: U of E experiments of one realisation, mean of the periods, shape (m, E, k), E at
            least m.

    Returns:
        Shape (k, E, m).
    """
    return np.asarray(np.linalg.pinv(np.moveaxis(inputs, 2, 0)), dtype=np.complex128)


def realisation_response(
    inverse: ComplexArray, output: ComplexArray
) -> tuple[ComplexArray, FloatArray]:
    """Estimate the response of one output to m inputs from one realisation.

    Args:
        inverse: Of :func:`input_inverse`, shape (k, E, m).
        output: Y of each period, shape (E, P, k).

    Returns:
        Y U^+, and E|e|^2 of it made by noise, NaN from one period; both of shape (m, k).
    """
    value = np.einsum("ek,kem->mk", output.mean(axis=1), inverse)
    noise = np.einsum("ek,kem->mk", noise_power(output), np.abs(inverse) ** 2)
    return value, noise


def over_realisations(
    values: ComplexArray, noises: FloatArray, spread: LevelSpread = NO_SPREAD
) -> BestLinearApproximation:
    """Combine the responses of the realisations.

    Args:
        values: Response to one input in each, shape (M, k).
        noises: E|e|^2 of each, made by noise, shape (M, k).
        spread: Of the distortion in as many realisations.
    """
    realisations = len(values)
    value = values.mean(axis=0)
    noise = noises.mean(axis=0) / realisations
    if realisations < 2:
        nothing = np.full(value.size, np.nan)
        return BestLinearApproximation(value, noise, nothing, nothing, Estimate(), realisations)
    # Each term has the expectation of the scatter, its deviations being from their own mean.
    squares = np.abs(values - value) ** 2 * realisations / (realisations - 1)
    excess = squares - noises
    scatter = squares.mean(axis=0)
    power = float(np.sum(np.abs(value) ** 2) - np.sum(scatter) / realisations)
    # Of few realisations the squares depend on one another by their mean: circular normal errors
    # have at least this variance.
    variance = np.sum(scatter**2 + np.nan_to_num(noises.var(axis=0))) / realisations
    return BestLinearApproximation(
        value,
        noise,
        scatter / realisations,
        excess.mean(axis=0),
        root_of_mean(excess.sum(axis=1) / power, float(variance) ** 0.5 / power, spread)
        if power > 0
        else Estimate(),
        realisations,
    )


def root_of_mean(
    squares: FloatArray, least_sd: float = 0.0, spread: LevelSpread = NO_SPREAD
) -> Estimate:
    """Return the root of a mean square with its interval, by Student's t and a known spread.

    Args:
        squares: Unbiased estimates of the square, some of which may be below zero, shape (n,).
        least_sd: Least standard deviation of their mean.
        spread: Of the mean's expectation, which the interval covers at least.

    Returns:
        0 where the mean is below zero; empty where some square is NaN; without interval of one.
    """
    mean = float(np.mean(squares))
    if not np.isfinite(mean):
        return Estimate()
    if squares.size < 2:
        return Estimate(max(mean, 0.0) ** 0.5)
    reach = float(stdtrit(squares.size - 1, 0.975) * np.std(squares, ddof=1))
    reach = max(reach / squares.size**0.5, 1.96 * least_sd)
    level = max(mean, 0.0)
    low, high = min(mean - reach, level / spread.high), max(mean + reach, level / spread.low)
    return Estimate(level**0.5, (max(low, 0.0) ** 0.5, max(high, 0.0) ** 0.5))


@dataclass(frozen=True)
class DetectionLines:
    """Root mean square of the output at lines that aren't excited, over that at those that are.

    Without the noise. Both are empty where there are no such lines, or one period.

    Attributes:
        odd: Of odd lines: what nonlinearities of odd order make there.
        even: The same of even lines.
    """

    odd: Estimate
    even: Estimate


def detection_lines(
    powers: Sequence[FloatArray], lines: IntArray, spread: DistortionSpread = NO_SPREADS
) -> DetectionLines:
    """Measure what an odd multisine leaves at the lines within its band that it doesn't excite.

    Args:
        powers: :func:`line_power` of each realisation, from line 0 on, shape (n,).
        lines: Excited lines, all odd.
        spread: Of distortion in as many realisations.

    Returns:
        With intervals from the scatter of the realisations, of one from that of the lines, and as
        wide as the spread at least.
    """
    power = np.stack(powers)
    excited = float(power[:, lines].mean())
    free = np.setdiff1d(np.arange(int(lines[0]), int(lines[-1])), lines)

    def level(parity: int, least: LevelSpread) -> Estimate:
        chosen = power[:, free[free % 2 == parity]]
        if not chosen.size or not excited > 0:
            return Estimate()
        squares = (chosen[0] if len(chosen) == 1 else chosen.mean(axis=1)) / excited
        return root_of_mean(squares, spread=least)

    return DetectionLines(level(1, spread.odd), level(0, spread.even))
