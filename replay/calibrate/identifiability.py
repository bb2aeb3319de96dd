"""Which parameters a session determines, and which it doesn't.

In units of the prior's deviations, x = P^1/2 z, the fit's covariance has eigenvalues between 0 (the
session tells all about that direction) and 1 (nothing). A direction whose deviation is still more
than half of the prior's is a ridge: along it the parameters can be changed together, and the twin
answers alike. A single parameter is determined if its own 95 % interval is narrow enough.

Would another law fit better? Each is tried as a direction beside the fitted parameters.

A test of what is left in general has little power against one law in particular. With q the twin's
angles at the fit and q* those under another law with the same parameters, the robot is taken as

    measured = q + J (x - x_hat) + weight (q* - q) + noise,

to first order; weight is 0 under the twin's law and about 1 under the other one, its prior variance
is 1. Where it is shown not to be 0 the twin's law is wrong. Where it isn't, the parameters are as
uncertain as the weight makes them: their intervals take in those of this wider model, and where the
weight may be 1, those of a fit under the other law.

Laws are the ground's other dry ones, by a run of the twin each, and play in one joint's gear or
sensor, w/2 against the direction of motion (per rad of w).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SimulationError
from undulog.sim.scenario.scenario import Scenario
from undulog.sim.scenario.world import FrictionLaw

from .parameters import DELAY, Answers, Unknown, with_values
from .solve import LeastSquares, Solution, solve

Z95 = 1.959963984540054

_RIDGE = 0.5
_MOVED = 0.01

_FULL_VOLTAGE = (
    "commands that bring the servos to full voltage: a larger amplitude, a higher frequency, or a "
    "stronger load"
)
_TELLS = {
    "stall_torque": _FULL_VOLTAGE,
    "proportional_gain": _FULL_VOLTAGE,
    "coulomb_friction": "slow motion without contact",
    "viscous_friction": "fast motion without contact, up to full voltage",
    "gear_stiffness": "a stronger load, or frequencies near the gear's resonance",
    "gear_damping": "frequencies near the gear's resonance",
    "mu_tangential": "a longer stretch in contact, with another lag or amplitude",
    "mu_normal": "a longer stretch in contact, with a larger amplitude or stronger servos",
    "drag_tangential": "a longer stretch in contact, with another lag or amplitude",
    "drag_normal": "a longer stretch in contact, with a larger amplitude or stronger servos",
    DELAY: "another frequency",
}


@dataclass(frozen=True)
class CorrelatedParameters:
    """A direction in the parameters that a session doesn't determine.

    Attributes:
        left: Standard deviation along it, as a share of the prior's: 1 where nothing is known.
        factors: Parameter to the factor (of a dead time: the change in seconds) by which it goes
            along, one prior deviation up the ridge; those that hardly move are left out.
    """

    left: float
    factors: dict[str, float]


def half_widths(covariance: FloatArray) -> FloatArray:
    """Half the 95 % intervals of x, shape (K,)."""
    return Z95 * np.sqrt(np.diag(covariance))


def ridges(unknowns: Sequence[Unknown], covariance: FloatArray) -> tuple[CorrelatedParameters, ...]:
    """The directions that are left open.

    Args:
        unknowns: K of them.
        covariance: Of x, shape (K, K).

    Returns:
        The most open one first.
    """
    spread = np.array([one.spread for one in unknowns])
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    found: list[CorrelatedParameters] = []
    for k in np.argsort(values)[::-1].tolist():
        left = float(np.sqrt(max(values[k], 0.0)))
        if left <= _RIDGE:
            break
        way = vectors[:, k] * spread
        way = way * np.sign(way[np.argmax(np.abs(way))])
        order: list[int] = np.argsort(-np.abs(way)).tolist()
        moved = [(unknowns[i], float(way[i])) for i in order if abs(way[i]) > _MOVED]
        factors = {one.label: one.value(size) / (one.start or 1.0) for one, size in moved}
        found.append(CorrelatedParameters(left, factors))
    return tuple(found)


def suggested_recordings(unknowns: Sequence[Unknown], open_ones: Sequence[int]) -> tuple[str, ...]:
    """What else to record.

    Args:
        unknowns: K of them.
        open_ones: Indices of those that aren't determined.

    Returns:
        ``parameters: experiment``, one a kind of experiment.
    """
    by_experiment: dict[str, list[str]] = {}
    for i in open_ones:
        by_experiment.setdefault(_TELLS[unknowns[i].name], []).append(unknowns[i].label)
    return tuple(f"{', '.join(names)}: {what}" for what, names in by_experiment.items())


PLAY_RAD = 0.02
"""A play, as a worn gear has it [rad]."""

PLAY_SPREAD_RAD = 0.05
"""Prior standard deviation of a play [rad]."""

_ITERATIONS = 4  # of a fit under another law; it starts from the fit under the twin's

_MOVES = 1e-3  # a joint that moves less shows no play [rad, RMS]


@dataclass(frozen=True)
class Alternative:
    """One other law.

    Attributes:
        label: What it is, e.g. ``transeth friction`` or ``play at joint02``.
        size: Its weight, or the play [rad].
        p: Of 'it is 0', alone.
        shift: Change of x with it, shape (K,).
        covariance: Of x with it, shape (K, K).
        widens: Whether intervals take it in: a law that any ground may have, not a defect.
    """

    label: str
    size: float
    error: float
    p: float
    shift: FloatArray
    covariance: FloatArray
    widens: bool

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % interval of its size."""
        return self.size - Z95 * self.error, self.size + Z95 * self.error

    @property
    def could_be(self) -> bool:
        """Whether its interval (95 %) has the weight that the other law has."""
        return abs(self.size - 1.0) <= Z95 * self.error


def alternatives(answers: Answers, solution: Solution) -> tuple[Alternative, ...]:
    """Try the other laws at a fit.

    Args:
        answers: The twin under the commands; one run for each law of the ground.

    Returns:
        Those that could be run, in no order.
    """
    found: list[Alternative] = []
    here = [a - r for a, r in zip(answers.measured.angles, solution.after, strict=True)]
    scenario = with_values(answers.scenario, solution.unknowns, solution.x)
    ground = scenario.world.ground
    if ground is not None and ground.law is not FrictionLaw.VISCOUS:
        for law in (FrictionLaw.ELLIPSE, FrictionLaw.BOX, FrictionLaw.TRANSETH):
            if law is ground.law:
                continue
            try:
                track = answers.run(_under(scenario, law))
            except SimulationError:  # too stiff with these parameters
                continue
            there = answers.sampled(track)
            column = [b - a for a, b in zip(here, there, strict=True)]
            one = _tried(f"{law.value} friction", column, 1.0, solution, widens=True)
            found.append(_refitted(one, law, answers, solution) if one.could_be else one)
    for k, joint in enumerate(answers.measured.joints):
        if np.sqrt(np.mean(here[k] ** 2)) < _MOVES:
            continue
        column = [np.zeros_like(one) for one in here]
        column[k] = play_direction(here[k])
        found.append(_tried(f"play at {joint}", column, PLAY_SPREAD_RAD, solution, widens=False))
    return tuple(found)


def _under(scenario: Scenario, law: FrictionLaw) -> Scenario:
    """The scenario, which has a ground, under another law."""
    assert scenario.world.ground is not None  # noqa: S101 - the caller looked at its law
    ground = dataclasses.replace(scenario.world.ground, law=law)
    return dataclasses.replace(scenario, world=dataclasses.replace(scenario.world, ground=ground))


def _refitted(
    one: Alternative, law: FrictionLaw, answers: Answers, solution: Solution
) -> Alternative:
    """Shift and covariance from a fit under the other law itself."""
    others = dataclasses.replace(answers, scenario=_under(answers.scenario, law))
    try:
        there = solve(others, solution.unknowns, start=solution.x, most=_ITERATIONS)
    except SimulationError:
        return one
    finally:
        answers.runs, answers.work_s = others.runs, others.work_s
    return dataclasses.replace(one, shift=there.x - solution.x, covariance=there.covariance)


def play_direction(angle: FloatArray) -> FloatArray:
    """What play does to an angle, per rad of its width: it lags by half of it, and rests at turns.

    Args:
        angle: In the order of time [rad], shape (n,).

    Returns:
        That of a play of ``PLAY_RAD``, or a tenth of the joint's travel if that is less; its mean
        taken off.
    """
    width = min(PLAY_RAD, 0.1 * float(np.ptp(angle)))
    low, high = (angle - width / 2).tolist(), (angle + width / 2).tolist()
    after: list[float] = []
    at = float(angle[0])
    for least, most in zip(low, high, strict=True):
        at = min(max(at, least), most)
        after.append(at)
    column = (np.array(after) - angle) / width
    return column - column.mean()


def _tried(
    label: str, column: Sequence[FloatArray], spread: float, solution: Solution, *, widens: bool
) -> Alternative:
    columns = [np.column_stack([J, own]) for J, own in zip(solution.columns, column, strict=True)]
    precision = np.append(solution.precision, spread**-2)
    prior = precision * np.append(solution.x, 0.0)
    problem = LeastSquares(columns, solution.after, solution.sigma, precision)
    step, covariance = problem.step(prior)
    size, error = float(step[-1]), math.sqrt(float(covariance[-1, -1]))
    p = math.erfc(abs(size) / error / math.sqrt(2.0))
    return Alternative(label, size, error, p, step[:-1], covariance[:-1, :-1], widens)
