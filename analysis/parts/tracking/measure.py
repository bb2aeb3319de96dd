"""Measure how the joints of a session follow commands that are no gait."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from undulog.capture.common.process import in_threads

from ...common.answer import StandOut
from ...estimators.series import Series
from .compare import unlike
from .estimate import Tracking, track
from .gait import GaitOffset
from .result import JointTracking

MOST_JOINTS = 128
"""Joints that are measured at most: each takes some tens of milliseconds."""


@dataclass(frozen=True)
class Tracked:
    """What is measured.

    Attributes:
        joints: In the order of the commands; without those whose command doesn't move.
        stand_out: Joints that follow otherwise than those like them.
        offsets: Of the joints that a gait drives, by name.
    """

    joints: tuple[JointTracking, ...] = ()
    stand_out: tuple[StandOut, ...] = ()
    offsets: Mapping[str, GaitOffset] = field(default_factory=dict[str, GaitOffset])


def track_joints(
    commands: Mapping[str, Series],
    positions: Mapping[str, Series],
    groups: Iterable[Iterable[str]],
    left_out: Iterable[str] = (),
) -> Tracked:
    """Fit gain, lag and offset of each joint, and compare them.

    Args:
        commands: By joint [rad].
        positions: By joint [rad].
        groups: Names of joints that may be compared with each other.
        left_out: Joints of which something else is stated; they are measured and not compared.
    """
    names = [name for name in commands if name in positions][:MOST_JOINTS]
    samples = sum(commands[name].count + positions[name].count for name in names)
    fits = in_threads(lambda name: track(commands[name], positions[name]), names, samples)
    trackings = {name: fit for name, fit in zip(names, fits, strict=True) if fit is not None}
    without = {*left_out}
    compared = [[name for name in group if name not in without] for group in groups]
    return Tracked(
        tuple(
            _result(name, tracking, float(np.ptp(commands[name].values)))
            for name, tracking in trackings.items()
        ),
        unlike(trackings, compared),
    )


def _result(name: str, tracking: Tracking, commanded_rad: float) -> JointTracking:
    values = (tracking.gain, tracking.lag_s, tracking.offset_rad)
    return JointTracking(
        joint=name,
        gain=tracking.gain.estimate,
        lag_s=tracking.lag_s.estimate,
        offset_rad=tracking.offset_rad.estimate,
        poles=tracking.order,
        held=tracking.held,
        explained=tracking.explained,
        commanded_rad=commanded_rad,
        command_mean_rad=tracking.command_rad,
        speed_rad_s=tracking.speed_rad_s,
        freedom=min(value.freedom for value in values),
    )
