"""Gain, lag and energy of each joint in each cycle of the analysed window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray, frozen

from ..estimators.demodulation import (
    amplitudes,
    weigh,
)
from .measurement import SessionMeasurement

LEAST_COVERED = 0.9
"""A cycle with samples over less of its length is missing."""


@dataclass(frozen=True)
class CycleMaps:
    """Joints against cycles; NaN where a cycle is missing. Arrays are read-only.

    Attributes:
        start_s: Start of each of c cycles, from the session's start [s], shape (c,).
        period_s: Length of a cycle [s].
        driven: Names of the driven joints, head to tail, m.
        gain: Shape (m, c).
        lag_rad: Within pi of the joint's mean, positive = late, shape (m, c).
        powered: Names of the joints with a mechanical energy, head to tail, k.
        power_w: Mean mechanical power, negative = driven by the rest of the body, shape (k, c).
    """

    start_s: FloatArray
    period_s: float
    driven: tuple[str, ...]
    gain: FloatArray
    lag_rad: FloatArray
    powered: tuple[str, ...]
    power_w: FloatArray


def cycle_maps(measured: SessionMeasurement) -> CycleMaps | None:
    """Follow a steady gait cycle by cycle.

    Args:
        measured: A session's numbers with what they were computed from.

    Returns:
        The maps, or None where there is no gait or not one whole cycle of it.
    """
    gait, span = measured.gait, measured.span
    if gait is None or span.cycles < 1:
        return None
    parts = {
        name: measured.responses[name].between(span.start_s, span.stop_s)
        for name in dict.fromkeys((*gait.driven, *measured.energies))
        if name in measured.responses
    }
    whole: dict[str, BoolArray] = {}
    starts: dict[str, IntArray] = {}
    for name, part in parts.items():
        weighed = weigh(part.t_s, span.start_s, span.stop_s, span.cycles)
        whole[name], starts[name] = weighed.covered >= LEAST_COVERED, weighed.starts
    nothing = np.full(span.cycles, np.nan, dtype=np.complex128)
    ratio: list[ComplexArray] = []
    for name in gait.driven:
        command = gait.fit.fundamental[gait.driven.index(name)]
        if name in whole and name in gait.answered and abs(command) > 0:
            amplitude = amplitudes(
                parts[name].t_s, parts[name].values, starts[name], gait.fit.omega
            )
            ratio.append(np.where(whole[name], amplitude / command, nothing))
        else:
            ratio.append(nothing)
    power = {
        name: np.where(whole[name], energy.mechanical.net_j, np.nan)
        for name, energy in measured.energies.items()
        if energy.mechanical is not None and name in whole
    }
    period = (span.stop_s - span.start_s) / span.cycles
    edges = np.linspace(span.start_s, span.stop_s, span.cycles + 1)
    shift_s = (span.origin_ns - measured.analysis.session.start_ns) * 1e-9
    response = np.array(ratio, dtype=np.complex128).reshape(-1, span.cycles)
    return CycleMaps(
        start_s=frozen(edges[:-1] + shift_s),
        period_s=period,
        driven=gait.driven,
        gain=frozen(np.abs(response)),
        lag_rad=frozen(_lag(response)),
        powered=tuple(power),
        power_w=frozen(np.array(list(power.values())).reshape(-1, span.cycles) / period),
    )


def _lag(response: ComplexArray) -> FloatArray:
    """Return the lag within pi of each joint's mean [rad], shape (m, c)."""
    size = np.abs(response)
    unit = np.divide(response, size, out=np.zeros_like(response), where=size > 0)
    mean = np.angle(unit.sum(axis=1, keepdims=True))
    lag: FloatArray = -(mean + np.angle(response * np.exp(-1j * mean)))
    return lag
