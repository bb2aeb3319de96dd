"""What is compared of joints by their offsets, and of those whose commands are no gait.

Gain, delay and offset of such a joint are those of a model of any motion; of joints with play or
friction they belong to the motion all the same. Commands that differ are stated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.console import plain
from undulog.capture.judgement.levels import ANGLE_MARGIN_RAD

from ..common.estimate import Estimate
from ..estimators.intervals import t_factor
from ..parts.tracking.gait import GaitOffset
from ..parts.tracking.result import JointTracking
from .quantities import Key, Known

OTHER_COMMAND = 0.25
"""Relative difference of two commands' ranges or rates from which they are others: random phases
of six tones make 15 % of the range."""

MOST = 4
"""Joints that a sentence lists at most."""


@dataclass(frozen=True)
class MeanCommand:
    """The command around which a joint's offset was measured.

    Attributes:
        mean_rad: Its mean [rad].
        slope: Gain - 1 of slow motion: what the offset gains by rad of the command; None of a
            gait, whose gain is another.
        slope_variance: Of its estimate.
    """

    mean_rad: float
    slope: float | None = None
    slope_variance: float = 0.0


def mean_commands(
    offsets: Mapping[str, GaitOffset], joints: Iterable[JointTracking]
) -> dict[str, MeanCommand]:
    """Return the command around which each joint's offset was measured, by joint."""
    return {name: MeanCommand(offset.command_rad) for name, offset in offsets.items()} | {
        joint.joint: MeanCommand(
            joint.command_mean_rad,
            (joint.gain.value or 0.0) - 1,
            error_of(joint.gain, joint.freedom) ** 2,
        )
        for joint in joints
    }


def at_one_command(
    estimates: Sequence[Mapping[Key, Known]], commands: Sequence[Mapping[str, MeanCommand]]
) -> list[dict[Key, Known]]:
    """Return the estimates of sessions with each joint's offsets at one command.

    An offset belongs to the mean of its command: it is taken to the mean of all sessions. Those of
    a gait whose means differ by the margin or more are left out.

    Args:
        estimates: Of each session.
        commands: Of each session, by joint.
    """
    common: dict[str, float] = {}
    apart: set[str] = set()
    for name in dict.fromkeys(name for command in commands for name in command):
        joint_commands = [command[name] for command in commands if name in command]
        means = np.array([command.mean_rad for command in joint_commands])
        common[name] = float(means.mean())
        if np.ptp(means) >= ANGLE_MARGIN_RAD and any(
            command.slope is None for command in joint_commands
        ):
            apart.add(name)
    return [
        {
            key: _at(value, of_session.get(key[1]), common.get(key[1], 0.0))
            if key[0] == "offset"
            else value
            for key, value in estimate.items()
            if key[0] != "offset" or key[1] not in apart
        }
        for estimate, of_session in zip(estimates, commands, strict=True)
    ]


def _at(offset: Known, command: MeanCommand | None, mean_rad: float) -> Known:
    """Return an offset at another mean command; as it is where the slope isn't known."""
    if command is None or command.slope is None:
        return offset
    value, variance, dof = offset
    by = mean_rad - command.mean_rad
    return value + command.slope * by, variance + command.slope_variance * by**2, dof


def offset_estimates(offsets: Mapping[str, GaitOffset]) -> dict[Key, Known]:
    """Return the offsets of a gait's joints whose errors are known [rad]."""
    values = {name: offset.offset_rad for name, offset in offsets.items()}
    return {
        ("offset", name): (value.value, value.error**2, value.freedom)
        for name, value in values.items()
        if value.ci95 is not None
    }


def tracking_estimates(joints: Iterable[JointTracking]) -> dict[Key, Known]:
    """Return ln gain [1], delay [s] and offset [rad] of the joints that respond."""
    estimates: dict[Key, Known] = {}
    for joint in joints:
        gain = joint.gain.value or 0.0
        if gain <= 0 or joint.gain.ci95 is None:
            continue
        relative = error_of(joint.gain, joint.freedom) / gain
        estimates["gain", joint.joint] = float(np.log(gain)), relative**2, joint.freedom
        for quantity, estimate in (("delay", joint.lag_s), ("offset", joint.offset_rad)):
            error = error_of(estimate, joint.freedom)
            estimates[quantity, joint.joint] = estimate.value or 0.0, error**2, joint.freedom
    return estimates


def error_of(estimate: Estimate, freedom: float) -> float:
    """Return the standard error by the larger side of the interval; infinite without one.

    An interval of a delay ends at 0, and one that holds several models isn't symmetric.
    """
    if estimate.value is None or estimate.ci95 is None:
        return float("inf")
    low, high = estimate.ci95
    return max(high - estimate.value, estimate.value - low) / t_factor(freedom)


def fastest_rad_s(sides: Iterable[Sequence[JointTracking]]) -> float:
    """Return the largest rate of a command, root mean square over its session [rad/s]; or 0."""
    return max((joint.speed_rad_s for joints in sides for joint in joints), default=0.0)


def commands_differ(
    a: Sequence[Sequence[JointTracking]], b: Sequence[Sequence[JointTracking]], names: Sequence[str]
) -> str | None:
    """Return which joints' commands differ between the sides; None where none does.

    Args:
        a: The joints of each session of side A.
        b: Of each session of side B.
        names: Joints that are compared.
    """
    sides = [{name: _command(side, name) for name in names} for side in (a, b)]
    other = [
        name
        for name in names
        if np.any(np.abs(np.log(sides[0][name] / sides[1][name])) > np.log1p(OTHER_COMMAND))
    ]
    if not other:
        return None
    first, second = (np.degrees(side[other[0]]) for side in sides)
    listed = ", ".join(plain(name) for name in other[:MOST])
    listed += f" and {len(other) - MOST} more" if len(other) > MOST else ""
    return (
        f"the commands of {listed} differ: that of {plain(other[0])} ranges over {first[0]:.3g}° "
        f"at {first[1]:.3g} °/s in A, over {second[0]:.3g}° at {second[1]:.3g} °/s in B"
    )


def _command(side: Sequence[Sequence[JointTracking]], name: str) -> np.ndarray:
    """Return mean range [rad] and rate [rad/s] of a joint's command over a side's sessions."""
    tracked = [joint for joints in side for joint in joints if joint.joint == name]
    return np.mean([(joint.commanded_rad, joint.speed_rad_s) for joint in tracked], axis=0)
