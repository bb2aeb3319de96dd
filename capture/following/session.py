"""The joints of a session that do not follow their command, read from its columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ..errors import DataError, LogError, MissingChannelError
from ..log.session import Session
from ..log.signals import Signal
from .fault import Fault
from .find import joints_not_following
from .motion import JointMotion, Samples

COMMANDS = "/joint_commands"
STATES = "/joint_states"


def samples_of(signal: Signal | None, origin_ns: int) -> Samples | None:
    """Take a recorded signal as finite samples at increasing times.

    Args:
        signal: The signal, or None.
        origin_ns: Unix time that becomes 0 s.

    Returns:
        The samples; None for no signal or one without finite values.
    """
    if signal is None or not signal.values.size:
        return None
    t_ns, values = signal.t_ns, signal.values
    finite = np.isfinite(values)
    if not finite.all():
        t_ns, values = t_ns[finite], values[finite]
    if t_ns.size > 1 and (np.diff(t_ns) <= 0).any():
        order = np.argsort(t_ns, kind="stable")
        t_ns, values = t_ns[order], values[order]
        first = np.concatenate(([True], np.diff(t_ns) > 0))
        t_ns, values = t_ns[first], values[first]
    if not t_ns.size:
        return None
    return Samples((t_ns - np.int64(origin_ns)).astype(np.float64) * 1e-9, values)


def faults_in_session(session: Session) -> tuple[Fault, ...]:
    """Find the joints of a session that do not follow their command.

    Args:
        session: An open session.

    Returns:
        The faults, in chain order, times from the session's start; none where the session lacks
        commands or states.
    """
    quantities = {
        "command": (COMMANDS, "position"),
        "position": (STATES, "position"),
        "velocity": (STATES, "velocity"),
        "effort": (STATES, "effort"),
        "current": ("/joint_current", "position"),
    }
    columns: dict[str, dict[str, Signal]] = {}
    for quantity, (topic, field) in quantities.items():
        if topic not in session.channels:
            continue
        try:
            signals = session.joints(topic, field)
        except (MissingChannelError, DataError, LogError):
            continue  # the health check itself reports a channel that can't be read
        columns[quantity] = {name: signals.signal(name) for name in signals.names}
    if "command" not in columns or "position" not in columns:
        return ()
    return joints_not_following(motions_of(session, columns, columns["command"]))


def motions_of(
    session: Session,
    columns: Mapping[str, Mapping[str, Signal]],
    names: Iterable[str],
    window_ns: tuple[int, int] | None = None,
) -> list[JointMotion]:
    """Take the recorded signals of joints, times from the session's start.

    Args:
        session: The session.
        columns: ``command``, ``position`` and whichever of ``velocity``, ``effort``, ``current``
            and ``reference`` there are, to signals by joint name.
        names: Joints, in chain order.
        window_ns: Half-open window [Unix ns]; None for all.

    Returns:
        The joints that have a command; a joint without positions has an empty record.
    """
    robot = session.robot
    limits = {} if robot is None else {j.name: (j.lower, j.upper) for j in robot.joints}
    empty = Samples(np.zeros(0), np.zeros(0))
    motions: list[JointMotion] = []

    def samples(quantity: str, name: str) -> Samples | None:
        signal = columns.get(quantity, {}).get(name)
        if signal is not None and window_ns is not None:
            i, j = np.searchsorted(signal.t_ns, window_ns).tolist()
            signal = Signal(signal.name, signal.unit, signal.t_ns[i:j], signal.values[i:j])
        return samples_of(signal, session.start_ns)

    for name in names:
        command = samples("command", name)
        if command is None:
            continue
        effort = samples("effort", name)
        motions.append(
            JointMotion(
                name=name,
                command=command,
                position=samples("position", name) or empty,
                velocity=samples("velocity", name),
                effort=effort if effort is not None else samples("current", name),
                reference=samples("reference", name),
                limits=limits.get(name),
            )
        )
    return motions
