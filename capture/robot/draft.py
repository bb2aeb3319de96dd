"""A robot description to start from: TOML with a comment on all that is to be filled in."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

from ..common.console import plain
from .description import numbered, parse_robot
from .model import Robot

_MARGIN = 0.05
"""Part of a seen range that the limits lie beyond it, at each end."""


@dataclass(frozen=True)
class SeenJoint:
    """What a log shows of a joint.

    Attributes:
        lower: Least angle [rad].
        upper: Greatest angle [rad].
        rate: Greatest rate [rad/s].
    """

    name: str
    lower: float
    upper: float
    rate: float


_TEMPLATE = """\
# The description of a robot, to start from. All values in SI: m, kg, s, rad, N m, A, V.
# `undulog robot check` holds it to the rules, the page "Robot descriptions" of the manual has them.

name = {name}
description = ""            # one sentence
clock = "host"              # whose clock stamps the samples: host, device or simulated
assumed = ["links", "joints", "servo"]   # take out of this list what you have filled in

{origin}
# plane: horizontal (turns about z, yaw) or vertical (about y, pitch).
joints = [
{joints}
]

[defaults.link]             # of every link, one more than joints; an entry of `links` may differ
length = 0.06               # assumed: joint to joint
radius = 0.025              # assumed
mass = 0.1                  # assumed
inertia = [4e-5, 5e-5, 5e-5]  # assumed: about the centre, along x (forward), y, z
# mesh = "shell.stl"        # for the picture, a file beside this one
# mesh_scale = 0.001        # metres in one unit of it

[defaults.servo]            # of every joint, for the twin; assumed
supply_v = 6.0
stall_torque = 1.5          # at full voltage and standstill
torque_constant = 1.0       # N m/A, at the joint
proportional_gain = 8.0     # duty per rad of error
viscous_friction = 0.005    # N m s/rad
coulomb_friction = 0.03

# [safety]                  # limits of driving it over a bus; without them it is never driven
# max_rate = 4.0            # rad/s, of commands
# ramp_rate = 0.5           # rad/s, to the first pose and down again
# max_tracking_error = 0.35 # between command and measured angle
# max_current = 1.4
# max_temperature = 70.0    # degC
# reply_timeout_s = 0.25    # a joint that reports nothing for so long is lost
# max_late_s = 0.2          # a control tick that is later stops the drive

# [bus]                     # where each quantity is found on its CAN bus
# databases = ["robot.dbc"] # beside this file
# bitrate = 1_000_000
# signals = [
#   {{ message = "Command", signal = "Angle", direction = "tx",
#      target = "{first}", quantity = "command", unit = "deg" }},
#   {{ message = "State", signal = "Angle", direction = "rx",
#      target = "{first}", quantity = "position", unit = "deg" }},
# ]
"""

_NEW = "# From the head to the tail; these two are examples."
_SEEN = """\
# From {log}, in its order: put them in that of the chain, the head first. The limits are what the
# log shows with a margin of 5 %, not those of the robot."""


def draft(name: str, joints: Sequence[SeenJoint] | None = None, log: str = "") -> Robot:
    """Return a description to start from, with its text.

    Args:
        joints: Those of a log; two examples if None.
        log: Name of that log.

    Raises:
        RobotFileError: If a name can't be one in a description; lists all of them.
    """
    if joints is None:
        names = numbered("joint", 2)
        lines = [_line(one, -0.52, 0.52, 10.0, "assumed") for one in names]
    else:
        names = [joint.name for joint in joints]
        lines = [_seen(joint) for joint in joints]
    text = _TEMPLATE.format(
        name=json.dumps(name),
        origin=_NEW if joints is None else _SEEN.format(log=plain(log)),
        joints="\n".join(lines),
        first=plain(names[0]),
    )
    return parse_robot(text, name, {})


def _seen(joint: SeenJoint) -> str:
    beyond = max(_MARGIN * (joint.upper - joint.lower), 0.01)
    lower = math.floor((joint.lower - beyond) * 1000) / 1000
    upper = math.ceil((joint.upper + beyond) * 1000) / 1000
    rate = max(math.ceil(joint.rate * (1 + _MARGIN) * 1000) / 1000, 0.001)
    mark = f"seen: {joint.lower:.4g} to {joint.upper:.4g} rad, at most {joint.rate:.4g} rad/s"
    return _line(joint.name, lower, upper, rate, mark)


def _line(name: str, lower: float, upper: float, rate: float, mark: str) -> str:
    return (
        f'  {{ name = {json.dumps(name)}, plane = "horizontal", lower = {lower}, upper = {upper}, '
        f"max_velocity = {rate} }},  # {mark}"
    )
