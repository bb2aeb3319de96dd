"""Intervals beside a limit cycle: a joint that hunts at a frequency of its own."""

import numpy as np
import pytest

from undulog.analysis.common.remarks import Remarks
from undulog.analysis.estimators.series import Series
from undulog.analysis.response.fitting import fit_gait
from undulog.analysis.response.response import gain_estimate, lag_estimate

GAIT_HZ, DURATION_S, GAIN, LAG_RAD = 0.5, 30.0, 0.9, 0.3


def covered(rng, bins, wander):
    """Return whether the intervals of gain and lag of three joints hold the truth, shape (3, 2).

    Args:
        bins: Distances of the limit cycle from the gait [1 / duration], from and to.
        wander: Random walk of its phase [rad / sqrt(s)].
    """
    t_s = np.arange(0, DURATION_S, 0.02)
    commands, responses = {}, {}
    for k in range(3):
        phase = 2 * np.pi * GAIT_HZ * t_s - 0.7 * k
        apart = rng.uniform(*bins) * rng.choice([-1, 1]) / DURATION_S
        walk = wander * np.sqrt(0.02) * np.cumsum(rng.standard_normal(t_s.size))
        hunting = np.sin(2 * np.pi * (GAIT_HZ + apart) * t_s + rng.uniform(0, 6.3) + walk)
        moved = GAIN * 0.4 * np.sin(phase - LAG_RAD) + 0.04 * hunting
        moved += 0.002 * rng.standard_normal(t_s.size)
        commands[f"j{k}"] = Series(f"j{k}", t_s, 0.4 * np.sin(phase))
        responses[f"j{k}"] = Series(f"j{k}", t_s, moved)
    response = fit_gait(commands, responses, DURATION_S, Remarks()).response
    ends = [(gain_estimate(response, k).ci95, lag_estimate(response, k).ci95) for k in range(3)]
    return [[a <= GAIN <= b, c <= LAG_RAD <= d] for (a, b), (c, d) in ends]


@pytest.mark.parametrize("wander", [0.0, 0.5])
@pytest.mark.parametrize("bins", [(1.0, 3.0), (3.0, 10.0)])
def test_intervals_hold_the_truth_beside_a_limit_cycle(bins, wander):
    rng = np.random.default_rng(int(10 * bins[0] + 2 * wander))
    share = np.mean([covered(rng, bins, wander) for _ in range(40)], axis=(0, 1))
    assert np.all(share > 0.88)  # 92 to 100 % of 450; of 120 values fewer in one draw of twenty
