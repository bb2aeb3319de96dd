"""Stick or play: what a joint's effort or a second sensor shows while the joint rests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.log.read.signals import Signal

from ..estimators.series import Series
from ..results.dead_band import EITHER, PLAY, STICK
from ..signals.reading import Columns
from .fit import Fitted
from .model import DELAY, WIDTH, Cycles

_RAMP = 0.5
"""Change of the effort over a plateau that is a ramp, as a share of the effort in motion."""

_NONE = 0.2
"""Effort in a plateau that is none, as a share of the effort in motion."""

_ALONG = 0.5
"""Share of the command's travel that a second sensor goes along with, before the play."""

_INNER = 0.6
"""Part of a plateau away from arrest and onset."""

_SURE = 3.0
_FEW = 3


@dataclass(frozen=True)
class Witness:
    """What else is recorded of a joint.

    Attributes:
        effort: Motor current, or else effort, or None.
        quantity: Its name.
        second: Positions by a second sensor, or None.
    """

    effort: Series | None
    quantity: str
    second: Series | None

    @classmethod
    def of(cls, columns: Columns, name: str, series: Callable[[Signal], Series]) -> Witness:
        """Look for it.

        Args:
            columns: The session's columns.
            name: Of the joint.
            series: Takes a signal into the form of the estimators.

        Returns:
            The motor's current before the effort, which may be the gear's.
        """
        effort, quantity = None, ""
        for key in ("current", "effort"):
            signal = columns.of(key).get(name)
            if effort is None and signal is not None and np.isfinite(signal.values).any():
                effort, quantity = series(signal), key
        second = columns.reference.get(name)
        return cls(effort, quantity, None if second is None else series(second))


def decide(cycles: Cycles, joint: int, one: Fitted, witness: Witness) -> tuple[str, str]:
    """Tell stick from play, if the data do.

    A motor that dry friction holds pulls ever harder, from one direction to the other, while the
    command crosses the band; one that crosses a gear's play has nothing to pull.

    Args:
        cycles: The motion.
        joint: Index.
        one: Its fit.
        witness: What else is recorded.

    Returns:
        The kind, and what decides it.
    """
    fitted = slice(cycles.first, None)
    times, rests = cycles.t_s[:, fitted], one.rests[:, fitted]
    command = cycles.commanded(joint, float(one.parameters[DELAY]))[:, fitted]
    across = (command - one.follower[:, fitted]) / max(float(one.parameters[WIDTH]) / 2, 1e-12)
    if witness.second is not None:
        along = _slopes(command, witness.second.at(times.ravel()).reshape(times.shape), rests)
        if _mean_beyond(along, _ALONG):
            return PLAY, "a second sensor goes along with the command meanwhile"
    if witness.effort is None:
        return EITHER, "no current and no effort is recorded"
    effort = witness.effort.at(times.ravel()).reshape(times.shape)
    moving = float(np.mean(np.abs(effort[~rests]))) if np.any(~rests) else 0.0
    if moving == 0:
        return EITHER, f"the {witness.quantity} is zero in motion"
    signed, unsigned = (_slopes(one, effort, rests) / moving for one in (across, np.abs(across)))
    ramps = _sure(signed) and 2 * abs(float(signed.mean())) > _RAMP
    rises = _sure(unsigned) and float(unsigned.mean()) > _RAMP and float(effort.min()) >= 0
    if ramps or rises:
        return STICK, f"the {witness.quantity} ramps while the joint rests"
    inner = rests & (np.abs(across) < _INNER)
    if np.count_nonzero(inner) >= _FEW and float(np.mean(np.abs(effort[inner]))) < _NONE * moving:
        return PLAY, f"the {witness.quantity} is near zero while the joint rests"
    return EITHER, f"the {witness.quantity} neither ramps clearly nor vanishes"


def _slopes(over: FloatArray, values: FloatArray, rests: BoolArray) -> FloatArray:
    """Slope of values over another quantity while the joint rests, a cycle each, shape (k,)."""
    found: list[float] = []
    for x, y, inside in zip(over, values, rests, strict=True):
        a, b = x[inside], y[inside]
        if a.size < _FEW or np.ptp(a) == 0:
            continue
        own = a - a.mean()
        found.append(float(own @ (b - b.mean()) / (own @ own)))
    return np.array(found or [0.0])


def _sure(values: FloatArray) -> bool:
    """Whether a mean over cycles differs from zero."""
    if values.size < _FEW:
        return False
    error = float(values.std(ddof=1)) / values.size**0.5
    return abs(float(values.mean())) > _SURE * error


def _mean_beyond(values: FloatArray, bound: float) -> bool:
    return values.size >= _FEW and float(values.mean()) > bound and _sure(values)
