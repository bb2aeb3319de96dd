"""Angles and rates of a log's joints, to begin a description of its robot with."""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import NS, FloatArray, IntArray
from ...common.errors import DataError, MissingChannelError
from ...robot.draft import SeenJoint
from .joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC
from .sample_times import JointSignals
from .session_view import SessionView

_SCALES = {"rad": 1.0, "deg": math.radians(1.0)}


def seen_joints(session: SessionView) -> list[SeenJoint]:
    """Return the joints of a log with the ranges of their angles and their greatest rates.

    Commands count too, if the log has some.

    Returns:
        In the order of the log. The rate is that of the measured velocities, or else between two
        samples of an angle, which noise makes larger.

    Raises:
        MissingChannelError: If the log has no such responses.
        DataError: If their angles are neither in rad nor in deg.
    """
    measured = session.joints(RESPONSE_TOPIC)
    scale = _scale(session, measured)
    try:
        rates = session.joints(RESPONSE_TOPIC, "velocity")
    except MissingChannelError:
        rates = None
    commands: JointSignals | None = None
    if COMMAND_TOPIC in session.channels:
        commands = session.joints(COMMAND_TOPIC)
    found: list[SeenJoint] = []
    for name in measured.names:
        angle = measured.signal(name)
        values = [angle.values * scale]
        if commands is not None and name in commands.names:
            values.append(commands.signal(name).values * _scale(session, commands))
        if rates is not None and name in rates.names:
            rate = np.abs(rates.signal(name).values)
        else:
            rate = _rates(angle.t_ns, values[0])
        known = np.concatenate(values)
        known, rate = known[np.isfinite(known)], rate[np.isfinite(rate)]
        if len(known):
            fastest = float(rate.max(initial=0.0))
            found.append(SeenJoint(name, float(known.min()), float(known.max()), fastest))
    if not found:
        raise DataError(f"{session.path}: {measured.topic} has no angle of any joint")
    return found


def _scale(session: SessionView, signals: JointSignals) -> float:
    if signals.unit not in _SCALES:
        raise DataError(
            f"{session.path}: the angles of {signals.topic} are in {signals.unit!r}; a description "
            "has rad"
        )
    return _SCALES[signals.unit]


def _rates(t_ns: IntArray, values: FloatArray) -> FloatArray:
    steps = np.diff(t_ns) / NS
    return np.abs(np.diff(values))[steps > 0] / steps[steps > 0]
