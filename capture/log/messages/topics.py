"""Topics that are latched, the powers of joints, diagnostics.

Topics of the joints' powers, accumulated by whoever works the joints.

A mean torque times a mean velocity is not the mean of their product: what the two do within a
sampling interval is lost, and so is a change of sign there. A robot, or the twin, that multiplies
at the rate of its own control loop and logs the means loses neither.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

from mcap.records import Channel

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""

LEVEL_NAMES = ("ok", "warn", "error", "stale")

NO_VALUES: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class DiagnosticStatus:
    """One component's state, as ``diagnostic_msgs/DiagnosticStatus`` has it.

    Attributes:
        level: :data:`OK`, :data:`WARN`, :data:`ERROR` or :data:`STALE`.
        name: The component, e.g. ``source can0``.
        message: One sentence.
        hardware_id: The device, e.g. ``can:socketcan:can0``; empty where there is none.
        values: Further facts; numbers as text.
    """

    level: int
    name: str
    message: str
    hardware_id: str = ""
    values: Mapping[str, str] = field(default_factory=lambda: NO_VALUES)


class PowerTopic(StrEnum):
    """A JointState whose ``position`` is a mean power [W] over the interval about its stamp.

    The interval is as long as the topic's sampling interval; one that is lost is a gap.
    """

    MECHANICAL = "/joint_power/mechanical"
    """Torque times velocity, signed."""
    MECHANICAL_PLUS = "/joint_power/mechanical_plus"
    """Its positive part."""
    ELECTRICAL = "/joint_power/electrical"
    """Motor voltage times motor current, signed."""
    ELECTRICAL_PLUS = "/joint_power/electrical_plus"
    """Its positive part."""


_LATCHED = re.compile(r"durability:\s*(1\b|transient_local)")


def is_latched(type_name: str, channel: Channel) -> bool:
    """Whether a topic's last message stays in force until the next.

    A String, static transforms, or what a ROS 2 recorder noted as durability transient local
    (``offered_qos_profiles``, https://github.com/ros2/rosbag2).

    Args:
        type_name: The messages' type.
        channel: The channel.

    Returns:
        True for those.
    """
    if type_name == "std_msgs/msg/String":
        return True
    offered = channel.metadata.get("offered_qos_profiles", "")
    return adds_up(channel) or bool(_LATCHED.search(offered))


def adds_up(channel: Channel) -> bool:
    """Whether every different message stays in force, not only the last.

    Args:
        channel: The channel.

    Returns:
        True for static transforms: each message holds some of them.
    """
    return channel.topic.endswith("/tf_static")
