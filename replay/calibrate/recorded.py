"""A session that the twin is fitted to: its commands, its joint angles, and the world it was in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from undulog.analysis.session.analyse import measure_session
from undulog.analysis.session.parts import BEYOND_THE_GAIT
from undulog.capture import Session, SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError, UndulogError, UsageError
from undulog.capture.log.read.joint_topics import RESPONSE_TOPIC
from undulog.sim.drive.recorded_commands import COMMANDS, CommandReplay
from undulog.sim.gait.contract import CONTROL_RATE_HZ
from undulog.sim.scenario.scenario import Scenario

from ..reproduce import find_repetition

FEWEST = 20
"""Samples that a joint must have to be looked at."""


@dataclass(frozen=True)
class MeasuredAngles:
    """Joint angles of the settled part.

    Attributes:
        joints: r names.
        times_s: Each joint's sampling times since the first command [s], shapes (n_j,).
        angles: Less their mean: where a joint's zero is, is its own affair [rad], shapes (n_j,).
    """

    joints: tuple[str, ...]
    times_s: tuple[FloatArray, ...]
    angles: tuple[FloatArray, ...]


@dataclass(frozen=True, eq=False)
class Recorded:
    """One session.

    Attributes:
        scenario: The world to start from, with theta_0, for as long as there are commands.
        commands: At their own times.
        measured: What its joints did.
        omega: Angular frequency of the commands [rad/s]; None where they are no steady gait.
    """

    path: Path
    scenario: Scenario
    commands: CommandReplay
    measured: MeasuredAngles
    omega: float | None

    @property
    def steps_a_tick(self) -> int:
        """Physics steps of a control period."""
        return self.scenario.physics_rate_hz // CONTROL_RATE_HZ

    @cached_property
    def references(self) -> FloatArray:
        """Mean command during each physics step [rad], shape (ticks * steps, m).

        A servo's duty is linear in its command as long as it does not saturate, so that the mean
        acts as the command itself would that comes within the step; what is left is of second
        order in the step. The twin's answer is continuous in the times of the commands.
        """
        count = self.scenario.tick_count * self.steps_a_tick
        return self.commands.mean_commands(count, self.scenario.physics_rate_hz)


def read_recorded(
    path: Path, world: str | None, settle_s: float | None, topics: tuple[str, str]
) -> Recorded:
    """Read a session.

    Args:
        world: Scenario to start from, by name or file; the one it was recorded in if None.
        settle_s: The first part to leave out [s]; the session's own if None.
        topics: Of commands and responses.

    Raises:
        UsageError: If no world is known, or the file holds no commands.
        MissingChannelError: If it has no joint states.
        DataError: If it has too few samples, or joints that the world's robot lacks.
        LogError: If it can't be read.
    """
    repetition = find_repetition(path, world, topics=topics)
    scenario = repetition.scenario
    commands = repetition.driven.make(scenario.robot, scenario)
    if not isinstance(commands, CommandReplay):
        raise UsageError(f"{path}: a {repetition.driven.kind}; give a session, .mcap")
    settled_s = scenario.settle_s if settle_s is None else settle_s
    with Session.open(path) as opened:
        session = opened.with_joints(*topics)
        measured = read_measured(session, settled_s, scenario.duration_s)
        omega = _omega(session)
    if strange := [name for name in measured.joints if name not in scenario.robot.joint_names]:
        raise DataError(f"{path}: {scenario.robot.name} has no joint {', '.join(strange)}")
    return Recorded(path, scenario, commands, measured, omega)


def read_measured(session: SessionView, settle_s: float, end_s: float) -> MeasuredAngles:
    """Read what the joints did.

    Args:
        settle_s: The first part to leave out [s] since the first command.
        end_s: Where the commands end [s].

    Returns:
        Its joint angles; samples without a value are left out.

    Raises:
        MissingChannelError: If it has no joint states.
        DataError: If too few are left.
    """
    commands, states = session.joints(COMMANDS), session.joints(RESPONSE_TOPIC)
    start_ns = min(int(t[0]) for t in commands.t_ns if len(t))
    settled: dict[str, tuple[FloatArray, FloatArray]] = {}
    for name, t_ns, values in zip(states.names, states.t_ns, states.values, strict=True):
        times_s = np.asarray((t_ns - start_ns) * 1e-9, dtype=np.float64)
        kept = (times_s >= settle_s) & (times_s <= end_s) & np.isfinite(values)
        if kept.sum() >= FEWEST:
            angles: FloatArray = values[kept]
            angles -= angles.mean()
            settled[name] = times_s[kept], angles
    if not settled:
        raise DataError(
            f"{session.path}: no joint has {FEWEST} samples on {RESPONSE_TOPIC} between "
            f"{settle_s:g} s and {end_s:g} s; is --settle too long?"
        )
    times, values = zip(*settled.values(), strict=True)
    return MeasuredAngles(tuple(settled), times, values)


def check_alike(sessions: Sequence[Recorded]) -> None:
    """Check that sessions can share their parameters.

    Raises:
        UsageError: If one is given twice, or they start from robots or grounds that differ.
    """
    first = sessions[0]
    if len({session.path.resolve() for session in sessions}) < len(sessions):
        raise UsageError("a session is given twice: its noise would count as two")
    for session in sessions[1:]:
        for what, of_first, other in (
            ("joints", first.scenario.robot.joints, session.scenario.robot.joints),
            ("links", first.scenario.robot.links, session.scenario.robot.links),
            ("ground", first.scenario.world.ground, session.scenario.world.ground),
        ):
            if other != of_first:
                raise UsageError(
                    f"{session.path}: its {what} differ from those of {first.path}; one fit has "
                    "one robot and one ground: name the world of all sessions, --on twin:SCENARIO"
                )


def joined(sessions: Sequence[Recorded]) -> MeasuredAngles:
    """The joints of all sessions, one after the other; of several, named with their session."""
    if len(sessions) == 1:
        return sessions[0].measured
    names = [session.path.name for session in sessions]
    if len(set(names)) < len(names):
        names = [str(session.path) for session in sessions]
    parts = [session.measured for session in sessions]
    return MeasuredAngles(
        tuple(
            f"{j} of {name}" for part, name in zip(parts, names, strict=True) for j in part.joints
        ),
        tuple(times for part in parts for times in part.times_s),
        tuple(angles for part in parts for angles in part.angles),
    )


def _omega(session: SessionView) -> float | None:
    """Angular frequency of the commands [rad/s], or None where they are no steady gait."""
    try:
        gait = measure_session(session, without=BEYOND_THE_GAIT).gait
    except UndulogError:  # a session without a gait can be fitted, too
        return None
    return None if gait is None or not gait.driven else gait.fit.omega
