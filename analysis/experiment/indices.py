"""Heterogeneity indices of several runs, their noise told by the scatter of the runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from undulog.capture.common.arrays import ComplexArray

from ..results.analysis import Index
from ..results.estimate import Interval
from ..results.experiment import Reversal
from ..session.heterogeneity import spread
from .reversal.mirror import MIN_RUNS, parts


def experiment_indices(
    forward: ComplexArray, reverse: ComplexArray, reversal: Reversal | None
) -> dict[str, Index]:
    """H0, H1 and H2 as indices.

    Args:
        forward: y of the runs one way, shape (r1, m).
        reverse: y of the runs the other way, shape (r2, m).
        reversal: The test of both, or None.

    Returns:
        ``common_response`` (H0: the same gain and delay at every joint, in each way that has
        runs enough), ``mirror_response`` (H1: T of identical modules), ``module_share`` and
        ``boundary_share`` (H2), ``equivalence_mirror_gain`` and ``equivalence_mirror_lag``. None
        where they can't be computed.
    """
    indices = {
        "common_response": _common_response([forward, reverse]),
        "mirror_response": Index(None, None, None, "1", "T of H1: identical modules, by reversal"),
        "module_share": Index(None, None, None, "1", "share of the spread due to the modules"),
        "boundary_share": Index(
            None, None, None, "1", "share of the spread that identical modules show, too"
        ),
        "equivalence_mirror_gain": Index(
            None, None, None, "1", "largest difference of ln gain from the mirror; H1: all in 2 %"
        ),
        "equivalence_mirror_lag": Index(
            None,
            None,
            None,
            "rad",
            "largest difference of lag from the mirror; H1: all in 1 degree",
        ),
    }
    if reversal is None:
        return indices
    module, boundary = reversal.module_share, reversal.boundary_share
    gains = [one.log_gain_difference.value or 0.0 for one in reversal.joints]
    lags = [one.lag_difference_rad.value or 0.0 for one in reversal.joints]
    found: dict[str, tuple[float | None, Interval | None, float | None]] = {
        "mirror_response": (reversal.statistic, None, reversal.p),
        "module_share": (module.value, module.ci95, reversal.p),
        "boundary_share": (boundary.value, boundary.ci95, None),
        "equivalence_mirror_gain": (max(map(abs, gains)), None, reversal.equivalence_gain_p),
        "equivalence_mirror_lag": (max(map(abs, lags)), None, reversal.equivalence_lag_p),
    }
    return indices | {
        name: replace(indices[name], value=value, ci95=ci95, p=p)
        for name, (value, ci95, p) in found.items()
    }


def _common_response(ways: list[ComplexArray]) -> Index:
    """F of H0 over the means of each way's runs; gain and lag of each way about their own mean."""
    known = [one for one in ways if len(one) >= MIN_RUNS and one.shape[1] > 1]
    label = "F of H0: all joints have the same gain and delay, noise from run to run"
    if not known:
        return Index(None, None, None, "1", label)
    values = np.concatenate([parts(one.mean(axis=0)) for one in known])
    variance = np.concatenate([parts(one).var(axis=0, ddof=1) / len(one) for one in known])
    dof = np.full(known[0].shape[1], min(len(one) for one in known) - 1.0)
    found = spread(values, variance, dof, blocks=2 * len(known))
    if found.expected == 0:
        return Index(None, None, None, "1", label)
    return Index(found.ratio, None, found.p, "1", label)
