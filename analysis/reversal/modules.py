"""From the reversal test to a result: the modules that deviate, bounds, shares of the spread."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from capture.arrays import ComplexArray, FloatArray

from ..estimators.equivalence import EQUIVALENT_GAIN, EQUIVALENT_LAG_RAD, equivalence_p
from ..response import around
from ..results.analysis import Estimate
from ..results.experiment import MirrorJoint, Reversal, WeakModule
from .mirror import MirrorTest, mirror_test
from .shares import variance_shares

SIGNIFICANT = 0.05
"""Family-wise level at which a module is named."""


def reversal_of(names: Sequence[str], forward: ComplexArray, reverse: ComplexArray) -> Reversal:
    """Test identical modules, name those that deviate, and split the spread.

    Args:
        names: Of m joints, head to tail.
        forward: y = ln(response/command) of the runs with the wave from head to tail, (r1, m).
        reverse: y of the runs from tail to head, shape (r2, m), joints from head to tail too.

    Returns:
        The result.

    Raises:
        UsageError: If a way has fewer than two runs.
    """
    test = mirror_test(forward, reverse)
    shares = variance_shares(forward, reverse)
    half = test.critical * test.error
    bounds = (np.abs([test.difference.real, test.difference.imag]) + half).max(axis=1)
    return Reversal(
        forward_runs=len(forward),
        reverse_runs=len(reverse),
        statistic=test.statistic,
        p=test.p,
        p_floor=test.floor,
        labellings=test.labellings,
        labellings_tried=test.tried,
        joints=_joints(names, test),
        weak=weak_modules(names, test),
        gain_bound=float(np.expm1(bounds[0])),
        lag_bound_rad=float(bounds[1]),
        equivalence_gain_p=equivalence_p(
            test.difference.real, test.error[0], test.dof[0], EQUIVALENT_GAIN
        ),
        equivalence_lag_p=equivalence_p(
            test.difference.imag, test.error[1], test.dof[1], EQUIVALENT_LAG_RAD
        ),
        module_variance=shares.module_variance,
        boundary_variance=shares.boundary_variance,
        noise_variance=shares.noise_variance,
        module_share=shares.module_share,
        boundary_share=shares.boundary_share,
    )


def weak_modules(names: Sequence[str], test: MirrorTest) -> tuple[WeakModule, ...]:
    """The weaker joint of each mirror pair that differs beyond doubt.

    The weaker one has less gain or more lag, whichever the pair's contrast shows more clearly. A
    pair that does the same at both of its joints, only otherwise when the wave runs the other way,
    names no module.

    Args:
        names: Of m joints, head to tail.
        test: Of the same joints.

    Returns:
        The largest contrast first: a weak module changes what its neighbours do, but less.
    """
    m = len(names)
    found: list[tuple[float, WeakModule]] = []
    for i in range(m // 2):
        if test.pair_p[i] >= SIGNIFICANT or abs(test.contrast[i]) < abs(test.common[i]):
            continue
        seen = np.array([test.contrast[i].real, test.contrast[i].imag])
        clear = np.abs(seen) / np.maximum(test.contrast_error[:, i], np.finfo(np.float64).tiny)
        part = int(np.argmax(clear))
        # Less gain and more lag are both a negative part of ln H.
        k = i if seen[part] < 0 else m - 1 - i
        gain, lag = _estimates(test.contrast[k], test.critical * test.contrast_error[:, k])
        by = ("gain", "lag")[part]
        one = WeakModule(names[k], names[m - 1 - k], by, gain, lag, float(test.pair_p[i]))
        found.append((abs(test.contrast[i]), one))
    found.sort(key=lambda pair: pair[0], reverse=True)
    return tuple(one for _, one in found)


def _joints(names: Sequence[str], test: MirrorTest) -> tuple[MirrorJoint, ...]:
    own = test.p_adjusted.min(axis=0)
    result: list[MirrorJoint] = []
    for i, name in enumerate(names):
        gain, lag = _estimates(test.difference[i], test.critical * test.error[:, i])
        result.append(MirrorJoint(name, names[-1 - i], gain, lag, float(own[i])))
    return tuple(result)


def _estimates(value: complex, half: FloatArray) -> tuple[Estimate, Estimate]:
    """Log gain and lag, positive when late, with their half widths."""
    gain, lag = float(value.real), -float(value.imag)
    return (
        Estimate(gain, around(gain, float(half[0]))),
        Estimate(lag, around(lag, float(half[1]))),
    )
