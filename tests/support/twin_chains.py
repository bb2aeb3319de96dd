"""Short robots and their scenarios, as TOML text.

Joints and servos are as the robot description has them by default, which are those of snake25.
"""

import json
import math

LINK = {"length": 0.06, "radius": 0.025, "mass": 0.1, "inertia": [4e-5, 5e-5, 5e-5]}


def toml(table, path=()):
    """Return a table as TOML text; JSON writes plain values alike."""
    plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
    text = f"[{'.'.join(path)}]\n" if path and (plain or not table) else ""
    text += "".join(f"{key} = {json.dumps(value)}\n" for key, value in plain.items())
    for key, value in table.items():
        if key not in plain:
            text += toml(value, (*path, key))
    return text


def chain(joints, *, assumed=("links", "servo"), planes=("horizontal", "vertical"), **servo):
    """Return a robot with a yaw joint first and last, and a pitch joint between each two."""
    return toml(
        {
            "name": f"chain{joints}",
            "description": "Yaw joints with a pitch joint between each two.",
            "clock": "simulated",
            "assumed": list(assumed),
            "chain": {"joints": joints, "planes": list(planes)},
            "defaults": {"link": LINK, "servo": servo},
        }
    )


def wave(*, duration_s, settle_s, gait=None, horizontal=None, **tables):
    """Return a wave of the yaw joints of the robot in ``chain.toml``: 0.4 rad, 1 Hz, lag pi/3."""
    plane = {"amplitude": 0.4, "frequency_hz": 1.0, "lag": math.pi / 3, **(horizontal or {})}
    return toml(
        {
            "description": "A wave of the yaw joints.",
            "robot": "chain.toml",
            "duration_s": duration_s,
            "settle_s": settle_s,
            "gait": {**(gait or {}), "horizontal": plane},
            **tables,
        }
    )


def snake4(database, signals):
    """Return a robot of four joints; signals: (message, signal, direction, quantity, unit)."""
    return SNAKE4.format(database=database) + "".join(
        f'[[bus.signals]]\nmessage = "{{joint}}_{message}"\nsignal = "{name}"\n'
        f'direction = "{way}"\ntarget = "{{joint}}"\nquantity = "{quantity}"\nunit = "{unit}"\n'
        for message, name, way, quantity, unit in signals
    )


SNAKE4 = """
name = "snake4"
description = "Four joints."
clock = "device"
joints = [
  {{ name = "joint01", plane = "horizontal" }},
  {{ name = "joint02", plane = "vertical" }},
  {{ name = "joint03", plane = "horizontal" }},
  {{ name = "joint04", plane = "vertical" }},
]
[defaults.link]
length = 0.06
radius = 0.025
mass = 0.1
inertia = [4e-5, 5e-5, 5e-5]
[defaults.joint]
lower = -0.5235987755982988
upper = 0.5235987755982988
[bus]
databases = ["{database}"]
bitrate = 1000000
"""
