"""The oscillators' phases that a session logged, plane by plane, and what their servos told them.

A generator of oscillators tells every joint's own phase on ``/gait``. If it feels its servos, the
angles enter as u_i = 2 (q_i - Y_i) / A cos phi_i (:mod:`.embodied`); each is taken a sample's
period old, as the generator has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import MissingChannelError
from undulog.capture.log.read.signals import JointSignals, Signal

from ..signals.reading import RESPONSE_TOPIC, planes_of

GAIT_TOPIC = "/gait"

_NS = 1e9

_SAME = 1e-6
"""Relative change of a rate that counts as none."""

_JITTER = 0.5
"""A step that is off by this share of a period, or more, is a gap."""


@dataclass(frozen=True)
class PhaseLog:
    """Phases of one plane's oscillators.

    Attributes:
        plane: Its name.
        names: Of its n joints, head to tail.
        t_ns: Times [Unix ns], shape (k,).
        phases: Without wrap-around [rad], shape (k, n).
        period_s: From sample to sample [s].
        whole: Whether each step is one period long, at the plane's usual rate, shape (k - 1,).
        inputs: u, None where no angles were logged, shape (k, n).
    """

    plane: str
    names: tuple[str, ...]
    t_ns: IntArray
    phases: FloatArray
    period_s: float
    whole: BoolArray
    inputs: FloatArray | None


def read_phases(
    session: SessionView, start_ns: int | None = None, stop_ns: int | None = None
) -> tuple[PhaseLog, ...]:
    """Read the phases of oscillators.

    Args:
        session: An open session.
        start_ns: From when on [Unix ns]; from the start if None.
        stop_ns: Until when, not included; until the end if None.

    Returns:
        One log for each plane with at least two joints whose phases were logged.
    """
    if GAIT_TOPIC not in session.channels:
        return ()
    told = session.joints(GAIT_TOPIC)
    planes: dict[str, list[str]] = {}
    for joint, plane in planes_of(session.robot).items():
        if f"{joint}.phase" in told.names:
            planes.setdefault(plane, []).append(joint)
    if not any(len(joints) > 1 for joints in planes.values()):
        return ()
    angles = _angles(session)
    logs = (
        _log(told, plane, tuple(joints), angles, (start_ns, stop_ns))
        for plane, joints in planes.items()
        if len(joints) > 1
    )
    return tuple(one for one in logs if one is not None)


def _log(
    told: JointSignals,
    plane: str,
    names: tuple[str, ...],
    angles: JointSignals | None,
    span: tuple[int | None, int | None],
) -> PhaseLog | None:
    t_ns = told.signal(f"{names[0]}.phase").t_ns
    columns = np.stack([told.signal(f"{name}.phase").values for name in names], axis=1)
    known = np.isfinite(columns).all(axis=1)
    known &= t_ns >= (t_ns[0] if span[0] is None else span[0])
    known &= t_ns < (t_ns[-1] + 1 if span[1] is None else span[1])
    if np.count_nonzero(known) < 3:
        return None
    t_ns = t_ns[known]
    phases = np.unwrap(columns[known], axis=0)
    steps = np.diff(t_ns).astype(np.float64) / _NS
    period_s = float(np.median(steps))
    whole: BoolArray = np.abs(steps - period_s) < _JITTER * period_s
    whole &= _steady(told, plane, known)
    inputs = None
    if angles is not None and set(names) <= set(angles.names):
        inputs = _inputs(told, plane, names, angles, (t_ns, phases, known, period_s))
    return PhaseLog(plane, names, t_ns, phases, period_s, whole, inputs)


def _steady(told: JointSignals, plane: str, known: BoolArray) -> BoolArray:
    """Steps over which the plane's rate is the usual one."""
    rate = _value(told, f"{plane}.omega", known)
    if rate is None:
        return np.ones(np.count_nonzero(known) - 1, dtype=np.bool_)
    usual = float(np.median(rate))
    same = np.abs(rate - usual) <= _SAME * abs(usual)
    return same[:-1]


def _inputs(
    told: JointSignals,
    plane: str,
    names: tuple[str, ...],
    angles: JointSignals,
    at: tuple[IntArray, FloatArray, BoolArray, float],
) -> FloatArray | None:
    """Of all joints, 2 (q - Y) / A cos phi; None where something of it is missing."""
    t_ns, phases, known, period_s = at
    amplitude = _value(told, f"{plane}.A", known)
    size = 0.0 if amplitude is None else float(np.median(amplitude))
    if size <= 0.0:
        return None
    then_ns = t_ns - round(period_s * _NS)
    felt = np.zeros_like(phases)
    for i, name in enumerate(names):
        offset = _value(told, f"{name}.offset", known)
        if offset is None:
            return None
        felt[:, i] = _held(angles.signal(name), then_ns) - offset
    # A joint that hasn't told its angle yet isn't fed back.
    return 2.0 * np.nan_to_num(felt) / size * np.cos(phases)


def _value(told: JointSignals, name: str, known: BoolArray) -> FloatArray | None:
    if name not in told.names:
        return None
    return told.signal(name).values[known]


def _held(signal: Signal, t_ns: IntArray) -> FloatArray:
    """The newest value at each time; NaN before the first."""
    values = np.concatenate([[np.nan], signal.values])
    return values[np.searchsorted(signal.t_ns, t_ns, side="right")]


def _angles(session: SessionView) -> JointSignals | None:
    if RESPONSE_TOPIC not in session.channels:
        return None
    try:
        return session.joints(RESPONSE_TOPIC)
    except MissingChannelError:
        return None
