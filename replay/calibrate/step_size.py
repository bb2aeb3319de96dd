"""What the twin's physics step does to a fit: the same parameters at half the step.

The twin's integrator is of first order: its angles at the step h are off by about h e, at half the
step by half of that, so that d = q(h/2) - q(h) is half of what a step of zero would change
(Richardson, *Phil. Trans. R. Soc. A* 210, 1911). To first order a fit at half the step would give x
plus::

    shift = -A^-1 J' W d

and one without any step twice that. Intervals hold for the robot, which has no step: they reach
from the fit at h to twice the shift. Whether the twin fits at all is tested with a share of d as
one more parameter.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.sim.scenario.scenario import Scenario

from .answers import Answers
from .least_squares import LinearFit, deviations
from .solve import Solution

_TO_ZERO = 2.0
"""The change to a step of zero over that to half the step: an error of first order."""


_SPREAD = 2.0
"""Prior standard deviation of the share of the change that a session shows: 0 of a session of the
twin at that step, 2 of a robot."""


@dataclass(frozen=True)
class StepSize:
    """What half the physics step changes.

    Attributes:
        change: Of the twin's angles [rad], shapes (n_j,).
        shift: Of x, shape (K,).
    """

    change: tuple[FloatArray, ...]
    shift: FloatArray

    @property
    def rms(self) -> float:
        """Of the change [rad]."""
        return float(np.sqrt(np.mean(np.concatenate(self.change) ** 2)))

    def widened(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ends of intervals of x that reach to a step of zero, too, shapes (K,)."""
        ending = _TO_ZERO * self.shift
        return low + np.minimum(ending, 0.0), high + np.maximum(ending, 0.0)

    def freed(self, solution: Solution) -> LinearFit:
        """The fit with a share of the change as one more parameter.

        What is left there lacks nothing that a smaller step would give, and is weighted anew: the
        step alone is no reason to refuse the twin's laws.
        """
        fit = solution.local.extended(self.change, _SPREAD)
        sigma = deviations(fit.problem.residuals)
        return dataclasses.replace(fit, problem=dataclasses.replace(fit.problem, sigma=sigma))


def step_size(answers: Answers, solution: Solution) -> StepSize:
    """Run the twin at half the step with the fitted parameters.

    Raises:
        SimulationError: If it fails there.
    """
    finer = answers.changed(_halved).at(solution.unknowns, solution.x)
    angles = zip(answers.measured.angles, solution.after, finer, strict=True)
    change = tuple(fine - (measured - rest) for measured, rest, fine in angles)
    problem = dataclasses.replace(solution.local.problem, residuals=change)
    shift = -np.linalg.solve(problem.normal, problem.slope)
    return StepSize(change, np.asarray(shift, dtype=np.float64))


def _halved(scenario: Scenario) -> Scenario:
    return dataclasses.replace(scenario, physics_rate_hz=2 * scenario.physics_rate_hz)
