"""Topics of the joints' powers, accumulated by whoever works the joints.

A mean torque times a mean velocity is not the mean of their product: what the two do within a
sampling interval is lost, and so is a change of sign there. A robot, or the twin, that multiplies
at the rate of its own control loop and logs the means loses neither.
"""

from __future__ import annotations

from enum import StrEnum


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
