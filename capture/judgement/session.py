"""The joints of a session, as the judgement takes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ..common.arrays import NS, FloatArray, IntArray
from ..common.errors import DataError, LogError, MissingChannelError
from ..log.messages import COMMAND_TOPIC, RESPONSE_TOPIC
from ..log.read.facts import TIMES_FROM_FPS
from ..log.read.joint_messages import UNITS
from ..log.read.sample_times import LARGEST, MOST_JOINTS, Signal, longest_unbroken
from ..log.read.session_view import SessionView
from ..robot.model import Joint, Seat
from .fault import Judgement
from .judge import judge
from .motion import RecordedJoint, Samples
from .publishers import are_of_two_nodes

QUANTITIES = ("command", "position", "velocity", "effort", "current", "reference")

_EMPTY = Samples(np.zeros(0), np.zeros(0))


def judgement_of_session(session: SessionView) -> Judgement:
    """Judge the joints of a session.

    Returns:
        The judgement, times from the session's start; empty where the session lacks commands or
        states. Of a session with breaks the longest unbroken stretch is looked at.

    Raises:
        DataError: If a topic has more than :data:`MOST_JOINTS`.
    """
    session = session.with_joints()
    quantities = {
        "command": (COMMAND_TOPIC, "position"),
        **{field: (RESPONSE_TOPIC, field) for field in UNITS},
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
        if (count := len(signals.names)) > MOST_JOINTS:
            why = f"{topic} has {count} joints; at most {MOST_JOINTS} are judged"
            raise DataError(f"{session.path}: {why}")
        columns[quantity] = {name: signals.signal(name) for name in signals.names}
    if "command" not in columns or "position" not in columns or times_made(session):
        return Judgement()
    for quantity in ("command", "position"):
        if are_of_two_nodes(signal.values for signal in columns[quantity].values()):
            return Judgement(naming=in_turn(quantities[quantity][0]))
    both = (*columns["command"].values(), *columns["position"].values())
    whole = longest_unbroken(signal.t_ns for signal in both)
    if whole is None:
        return Judgement()
    window_ns = (whole.start_ns, whole.last_ns + 1) if whole.others else None
    return judge(motions_of(session, columns, columns["command"], window_ns))


def in_turn(topic: str) -> str:
    """Say that two nodes publish a topic."""
    return f"two nodes publish {topic} in turn: every other sample belongs to another series"


def times_made(session: SessionView) -> bool:
    """Whether times were made from a frame rate, so that no joint can be judged by its lag.

    A frame holds what was sampled at times of its own, commands and positions alike.
    """
    return TIMES_FROM_FPS in session.metadata.get("undulog", {})


def motions_of(
    session: SessionView,
    columns: Mapping[str, Mapping[str, Signal]],
    names: Iterable[str],
    window_ns: tuple[int, int] | None = None,
) -> list[RecordedJoint]:
    """Take the recorded signals of joints, times from the session's start.

    Args:
        columns: ``command``, ``position`` and whichever of ``velocity``, ``effort``, ``current``
            and ``reference`` there are, to signals by joint name.
        window_ns: Half-open window [Unix ns]; None for all.

    Returns:
        The joints that have a command; a joint without positions has an empty record.
    """
    robot = session.robot
    described = {} if robot is None else {joint.name: joint for joint in robot.joints}
    motions: list[RecordedJoint] = []
    for name in names:
        times = _Times(session.start_ns, window_ns)
        signals = {key: times.samples(columns.get(key, {}).get(name)) for key in QUANTITIES}
        if (command := signals["command"]) is None:
            continue
        joint = described.get(name)
        motions.append(
            RecordedJoint(
                name=name,
                command=command,
                position=signals["position"] or _EMPTY,
                velocity=signals["velocity"],
                effort=signals["effort"] or signals["current"],
                reference=signals["reference"],
                limits=None if joint is None else (joint.lower, joint.upper),
                kind=None if joint is None else _kind(joint),
                outside_loop=_outside(joint),
            )
        )
    return motions


def _kind(joint: Joint) -> str:
    """Name the joints of one servo and, by their plane, of one load."""
    return f"{joint.plane} {joint.servo}"


def _outside(joint: Joint | None) -> frozenset[str]:
    outside = joint is not None and joint.sits is Seat.JOINT
    return frozenset({"velocity", "effort"}) if outside else frozenset()


class _Times:
    """The sampling times of one joint; those that several quantities share are converted once."""

    def __init__(self, origin_ns: int, window_ns: tuple[int, int] | None) -> None:
        self._origin_ns = np.int64(origin_ns)
        self._window_ns = window_ns
        self._converted_times: dict[int, tuple[slice, IntArray, FloatArray]] = {}

    def samples(self, signal: Signal | None) -> Samples | None:
        """The samples that are no larger than LARGEST, at increasing times; None without any."""
        if signal is None:
            return None
        part, t_ns, t_s = self._converted(signal.t_ns)
        values = signal.values[part]
        possible = np.abs(values) <= LARGEST
        if not possible.all():
            t_ns, t_s, values = t_ns[possible], t_s[possible], values[possible]
        if t_ns.size > 1 and (np.diff(t_ns) <= 0).any():
            first = np.unique(t_ns, return_index=True)[1]
            t_s, values = t_s[first], values[first]
        return Samples(t_s, values) if t_s.size else None

    def _converted(self, t_ns: IntArray) -> tuple[slice, IntArray, FloatArray]:
        if id(t_ns) not in self._converted_times:
            part = slice(None)
            if self._window_ns is not None:
                part = slice(*np.searchsorted(t_ns, self._window_ns).tolist())
            inside = t_ns[part]
            t_s = (inside - self._origin_ns).astype(np.float64) / NS
            self._converted_times[id(t_ns)] = part, inside, t_s
        return self._converted_times[id(t_ns)]
