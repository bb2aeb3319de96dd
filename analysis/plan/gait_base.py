"""The gait that a plan is made around: the sines that a recorded session commanded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import UsageError

from ..results.deciding import percent
from ..session.analyse import examine_session
from ..signals.reading import COMMAND_TOPIC, RESPONSE_TOPIC, read_columns

PURE = 0.01
"""Harmonics of a command above this share of its fundamental are no sine any more."""


@dataclass(frozen=True)
class BaseGait:
    """Sines around offsets; a joint without amplitude is held.

    Attributes:
        names: All joints, head to tail, n.
        driven: Indices of those that the gait drives, m.
        amplitude: Complex amplitudes of the driven ones' commands [rad], shape (m,).
        offset: Of all joints [rad], shape (n,).
        omega: Angular frequency [rad/s].
    """

    names: tuple[str, ...]
    driven: tuple[int, ...]
    amplitude: ComplexArray
    offset: FloatArray
    omega: float


def base_gait(session: SessionView) -> BaseGait:
    """Fit the gait of a session's commands.

    Args:
        session: An open session with commands.

    Returns:
        The gait.

    Raises:
        UsageError: If it commands no steady gait of sines.
    """
    gait = examine_session(session, with_dead_bands=False).gait
    if gait is None or not gait.driven:
        raise UsageError(f"{session.path}: it commands no steady gait; name a session that does")
    if gait.others:
        frequencies = ", ".join(f"{one.fit.frequency_hz:.4g} Hz" for one in gait.groups)
        raise UsageError(
            f"{session.path}: its joints have several frequencies ({frequencies}); name a session "
            "of one"
        )
    m = len(gait.driven)
    harmonics = gait.fit.amplitudes[:m]
    overtones = np.abs(harmonics[:, 1:]).max(initial=0.0, axis=1) / np.abs(harmonics[:, 0])
    if overtones.max() > PURE:
        worst = gait.driven[int(np.argmax(overtones))]
        share = percent(float(overtones.max()), PURE)
        raise UsageError(
            f"{session.path}: the command of {worst} is no sine (a harmonic has {share} of its "
            f"amplitude, more than {100 * PURE:g} %); name a session of a steady sine gait"
        )

    def silent(_: str) -> None:
        """The first reading has told what is missing."""

    commands = read_columns(session, COMMAND_TOPIC, RESPONSE_TOPIC, silent).command
    names = tuple(commands)
    # Of a joint that is held, every sample is its place.
    offset = np.array([float(commands[name].values[-1]) for name in names])
    driven = tuple(names.index(name) for name in gait.driven)
    offset[list(driven)] = gait.fit.trend[:m, 0]
    return BaseGait(names, driven, gait.fit.fundamental[:m], offset, gait.fit.omega)
