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

from .answers import Answers
from .least_squares import LinearFit
from .parameters import DELAY, Unknown
from .solve import Solution, solve

Z95 = 1.959963984540054

_RIDGE = 0.5
_MOVED = 0.01

_FULL_VOLTAGE = (
    "commands that bring the servos to full voltage: a larger amplitude, a higher frequency, or a "
    "stronger load"
)
_FINER = "no other recording, but a smaller physics step: a larger physics_rate_hz of the scenario"
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

PLAY_RAD = 0.02
"""A play, as a worn gear has it [rad]."""

PLAY_SPREAD_RAD = 0.05
"""Prior standard deviation of a play [rad]."""

_ITERATIONS = 4  # of a fit under another law; it starts from the fit under the twin's

_LINEAR = 0.8
"""How far a law's weight, which is of first order, may be from 1: laws that were the robot's came
out at 0.4 to 1.7, and play in the gears at -4 to -0.5."""

_MOVES = 1e-3  # a joint that moves less shows no play [rad, RMS]


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
    spread = np.array([parameter.spread for parameter in unknowns])
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    parameters: list[CorrelatedParameters] = []
    for k in np.argsort(values)[::-1].tolist():
        left = float(np.sqrt(max(values[k], 0.0)))
        if left <= _RIDGE:
            break
        way = vectors[:, k] * spread
        way = way * np.sign(way[np.argmax(np.abs(way))])
        order: list[int] = np.argsort(-np.abs(way)).tolist()
        moved = [(unknowns[i], float(way[i])) for i in order if abs(way[i]) > _MOVED]
        factors = {
            parameter.label: parameter.value(size) / (parameter.start or 1.0)
            for parameter, size in moved
        }
        parameters.append(CorrelatedParameters(left, factors))
    return tuple(parameters)


def suggested_recordings(
    unknowns: Sequence[Unknown], open_ones: Sequence[int], by_step: Sequence[int] = ()
) -> tuple[str, ...]:
    """What else to record.

    Args:
        unknowns: K of them.
        open_ones: Indices of those that the recording doesn't determine.
        by_step: Indices of those that only the twin's physics step leaves open.

    Returns:
        ``parameters: experiment``, one a kind of experiment.
    """
    by_experiment: dict[str, list[str]] = {}
    for i in open_ones:
        by_experiment.setdefault(_TELLS[unknowns[i].name], []).append(unknowns[i].label)
    if by_step:
        by_experiment[_FINER] = [unknowns[i].label for i in by_step]
    return tuple(f"{', '.join(names)}: {what}" for what, names in by_experiment.items())


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
        left: Weighted sum of squares that is left with it, as a share of that without it.
    """

    label: str
    size: float
    error: float
    p: float
    shift: FloatArray
    covariance: FloatArray
    widens: bool
    left: float

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % interval of its size."""
        return self.size - Z95 * self.error, self.size + Z95 * self.error

    @property
    def could_be(self) -> bool:
        """Whether its interval (95 %) has the weight that the other law has."""
        return abs(self.size - 1.0) <= Z95 * self.error

    @property
    def could_explain(self) -> bool:
        """Whether it may be named as what the robot has: no play or law has a negative size."""
        low, high = self.ci95
        is_law = low <= 1.0 + _LINEAR and high >= 1.0 - _LINEAR
        return self.size > 0.0 and (is_law or not self.widens)


def alternatives(answers: Answers, solution: Solution, freed: LinearFit) -> tuple[Alternative, ...]:
    """Try the other laws at a fit.

    Args:
        answers: The twin under the commands; one run for each law of the ground.
        freed: The fit with the physics step freed, where laws are tested.

    Returns:
        Those that could be run, in no order.
    """
    tried: list[Alternative] = []
    fits = solution.local, freed
    here = [a - r for a, r in zip(answers.measured.angles, solution.after, strict=True)]
    ground = answers.scenario.world.ground
    if ground is not None and ground.law is not FrictionLaw.VISCOUS:
        for law in (FrictionLaw.ELLIPSE, FrictionLaw.BOX, FrictionLaw.TRANSETH):
            if law is not ground.law:
                tried += _of_ground(law, here, answers, solution, fits)
    joints = [joint for session in answers.sessions for joint in session.measured.joints]
    moves = [bool(np.sqrt(np.mean(angle**2)) >= _MOVES) for angle in here]
    for joint in dict.fromkeys(joint for joint, moved in zip(joints, moves, strict=True) if moved):
        rows = zip(joints, moves, here, strict=True)
        column = [
            play_direction(angle) if moved and name == joint else np.zeros_like(angle)
            for name, moved, angle in rows
        ]
        tried.append(_tried(f"play at {joint}", column, PLAY_SPREAD_RAD, fits, widens=False))
    return tuple(tried)


def _of_ground(
    law: FrictionLaw,
    here: Sequence[FloatArray],
    answers: Answers,
    solution: Solution,
    fits: tuple[LinearFit, LinearFit],
) -> list[Alternative]:
    """Another law of the ground; nothing where it can't be run."""

    def under(scenario: Scenario) -> Scenario:
        assert scenario.world.ground is not None  # noqa: S101 - the caller looked at its law
        ground = dataclasses.replace(scenario.world.ground, law=law)
        world = dataclasses.replace(scenario.world, ground=ground)
        return dataclasses.replace(scenario, world=world)

    others = answers.changed(under)
    try:
        there = others.at(solution.unknowns, solution.x)
    except SimulationError:  # too stiff with these parameters
        return []
    column = [b - a for a, b in zip(here, there, strict=True)]
    tried = _tried(f"{law.value} friction", column, 1.0, fits, widens=True)
    if not tried.could_be:
        return [tried]
    try:
        fitted = solve(others, solution.unknowns, start=solution.x, most=_ITERATIONS)
    except SimulationError:
        return [tried]
    shift = fitted.x - solution.x
    return [dataclasses.replace(tried, shift=shift, covariance=fitted.covariance)]


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
    label: str,
    column: Sequence[FloatArray],
    spread: float,
    fits: tuple[LinearFit, LinearFit],
    *,
    widens: bool,
) -> Alternative:
    """Free the size of a law; test it where the physics step is free, too."""
    plain, tested = (fit.extended(column, spread) for fit in fits)
    count = len(fits[0].x)
    size = float(tested.x[-1])
    error = math.sqrt(float(tested.problem.covariance()[-1, -1]))
    return Alternative(
        label=label,
        size=size,
        error=error,
        p=math.erfc(abs(size) / error / math.sqrt(2.0)),
        shift=plain.x[:count] - fits[0].x,
        covariance=plain.problem.covariance()[:count, :count],
        widens=widens,
        left=tested.problem.squares / fits[1].problem.squares,
    )
