"""Would another law fit better? Each is tried as a direction beside the fitted parameters.

A test of what is left in general has little power against one law in particular. With q the twin's
angles at the fit and q* those under another law with the same parameters, the robot is taken as

    measured = q + J (x - x_hat) + weight (q* - q) + noise,

to first order; weight is 0 under the twin's law and about 1 under the other one, its prior variance
is 1. Where it is shown not to be 0 the twin's law is wrong. Where it isn't, the parameters are as
uncertain as the weight makes them: their intervals take in those of this wider model.

Laws are the ground's other dry ones, by a run of the twin each, and play in one joint's gear or
sensor, w/2 against the direction of motion (q* - q = -sgn(q')/2 per rad of w).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import FloatArray
from capture.errors import SimulationError
from sim.world import FrictionLaw

from .answers import Answers
from .parameters import with_values
from .solve import Solution, covariance_with

PLAY_RAD = 0.05
"""Prior standard deviation of a play [rad]."""

_MOVES = 1e-3
"""A joint that moves less shows no play [rad, RMS]."""


@dataclass(frozen=True)
class Alternative:
    """One other law.

    Attributes:
        label: What it is, e.g. ``transeth friction`` or ``play at joint02``.
        size: Its weight, or the play [rad].
        error: Standard error.
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


def alternatives(answers: Answers, solution: Solution) -> tuple[Alternative, ...]:
    """Try the other laws at a fit.

    Args:
        answers: The twin under the commands; one run for each law of the ground.
        solution: The fit.

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
            world = dataclasses.replace(scenario.world, ground=dataclasses.replace(ground, law=law))
            try:
                track = answers.run(dataclasses.replace(scenario, world=world))
            except SimulationError:  # too stiff with these parameters
                continue
            there = answers.sampled(track)
            column = [b - a for a, b in zip(here, there, strict=True)]
            found.append(_tried(f"{law.value} friction", column, 1.0, solution, widens=True))
    for k, joint in enumerate(answers.measured.joints):
        if np.sqrt(np.mean(here[k] ** 2)) < _MOVES:
            continue
        column = [np.zeros_like(one) for one in here]
        column[k] = play_direction(answers.measured.times_s[k], here[k])
        found.append(_tried(f"play at {joint}", column, PLAY_RAD, solution, widens=False))
    return tuple(found)


def play_direction(times_s: FloatArray, angle: FloatArray) -> FloatArray:
    """What play does to an angle, per rad of its width: it lags by half of it.

    Args:
        times_s: Shape (n,).
        angle: [rad], shape (n,).

    Returns:
        Less its mean, shape (n,).
    """
    column = -0.5 * np.sign(np.gradient(angle, times_s))
    return column - column.mean()


def _tried(
    label: str, column: Sequence[FloatArray], spread: float, solution: Solution, *, widens: bool
) -> Alternative:
    columns = [np.column_stack([J, own]) for J, own in zip(solution.columns, column, strict=True)]
    precision = np.append(solution.precision, spread**-2)
    prior = precision * np.append(solution.x, 0.0)
    step, covariance = covariance_with(columns, solution.after, solution.sigma, precision, prior)
    size, error = float(step[-1]), math.sqrt(float(covariance[-1, -1]))
    p = math.erfc(abs(size) / error / math.sqrt(2.0))
    return Alternative(label, size, error, p, step[:-1], covariance[:-1, :-1], widens)
