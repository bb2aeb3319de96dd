"""Offsets of the joints of a gait: the mean of each response less that of its command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...estimators.harmonic import HarmonicFit
from ...estimators.intervals import around
from ...estimators.series import Series
from ...response.fitting import GaitFit
from .errors import errors_of
from .estimate import MOST_SAMPLES, Value


@dataclass(frozen=True)
class GaitOffset:
    """Offset of one joint in the middle of the fitted window.

    Attributes:
        offset_rad: Mean of the response less that of the command [rad].
        command_rad: Mean of the command [rad].
    """

    offset_rad: Value
    command_rad: float


def gait_offsets(gait: GaitFit, responses: Mapping[str, Series]) -> dict[str, GaitOffset]:
    """Return the offset of each joint with a response.

    Args:
        responses: Those that the gait was fitted to [rad], by joint.
    """
    return {
        name: _offset(group.fit, group.driven.index(name), len(group.driven) + k, responses[name])
        for group in gait.groups
        for k, name in enumerate(group.answered)
        if name in responses
    }


def _offset(fit: HarmonicFit, command: int, response: int, series: Series) -> GaitOffset:
    """Return the offset of one joint, its error by the residual's autocorrelation."""
    middle_s = float(fit.mean_time_s[response])
    powers = middle_s ** np.arange(fit.trend.shape[1], dtype=np.float64)
    mean, asked = (float(fit.trend[k] @ powers) for k in (response, command))
    offset = mean - asked
    every = slice(None, None, -(-series.count // MOST_SAMPLES))
    t_s = series.t_s[every]
    residual = series.values[every] - fit.predict(response, t_s)
    design = np.stack([np.ones(t_s.size), t_s - middle_s], axis=1)
    errors = errors_of(t_s, design, residual, np.array([[1.0, 0.0]]))
    if errors is None:
        return GaitOffset(Value(offset), asked)
    ci95 = around(offset, errors.half(0))
    return GaitOffset(Value(offset, ci95, float(errors.freedom[0])), asked)
