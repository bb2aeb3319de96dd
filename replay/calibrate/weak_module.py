"""Which single module's servo differs? Each is freed by itself; the best one is fitted, and tested.

At the fit of the shared parameters a module's own factor would lessen Q by about b_j^2 (A_j^-1)_jj,
b_j its column's product with the weighted residuals and A_j the normal matrix with that column. The
largest is fitted in full; its p-value is that of its logarithm over its standard error, times the
number of modules that were tried (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .answers import Answers
from .least_squares import LeastSquares
from .parameters import module_unknown
from .solve import Solution, derivatives, solve

SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Search:
    """What came of it.

    Attributes:
        module: The joint that fits best with a servo of its own.
        p: Family-wise p-value.
    """

    module: str
    p: float
    tried: int

    @property
    def named(self) -> bool:
        """Whether it is shown to differ."""
        return self.p < SIGNIFICANT


def find_weak_module(
    answers: Answers,
    shared: Solution,
    spread: float,
    on_iteration: Callable[[int, float], None],
) -> tuple[Search, Solution]:
    """Try every module.

    Args:
        answers: The twin under the commands.
        shared: The fit of identical modules.
        spread: Prior standard deviation of a module's ln factor.
        on_iteration: As :func:`.replay.calibrate.solve.solve` has it.

    Returns:
        The search, and the fit with that module's own factor.
    """
    moved = {joint for session in answers.sessions for joint in session.measured.joints}
    joints = [joint for joint in answers.scenario.robot.joint_names if joint in moved]
    gains: list[float] = []
    for joint in joints:
        parameters = (*shared.unknowns, module_unknown(answers.scenario, joint, spread))
        added = derivatives(answers, parameters, np.append(shared.x, 0.0), [len(shared.x)])
        columns = [np.hstack(pair) for pair in zip(shared.columns, added, strict=True)]
        whole, alone = (
            LeastSquares(of, shared.after, shared.sigma, np.append(shared.precision, spread**-2))
            for of in (columns, added)
        )
        gains.append(float(alone.slope[0]) ** 2 * float(np.linalg.inv(whole.normal)[-1, -1]))
    best = joints[int(np.argmax(gains))]
    parameters = (*shared.unknowns, module_unknown(answers.scenario, best, spread))
    fitted = solve(answers, parameters, start=np.append(shared.x, 0.0), on_iteration=on_iteration)
    z = abs(float(fitted.x[-1])) / math.sqrt(float(fitted.covariance[-1, -1]))
    p = min(1.0, len(joints) * math.erfc(z / math.sqrt(2.0)))
    return Search(best, p, len(joints)), fitted
