"""Robots of one or two joints whose bus map a test gives."""

from undulog.capture.robot.description import parse_robot

LINK = """
[defaults.link]
length = 0.06
radius = 0.025
mass = 0.1
inertia = [4e-5, 5e-5, 5e-5]
"""
HEAD = """
name = "one"
clock = "host"
joints = [{ name = "joint01", plane = "horizontal" }]
"""
TWO_JOINTS = """name = "arm"
clock = "host"
assumed = ["links", "joints", "servo"]
joints = [{ name = "joint01", plane = "horizontal" }, { name = "joint02", plane = "vertical" }]
[defaults.link]
length = 0.1
radius = 0.05
mass = 1.0
inertia = [1.3e-3, 1.5e-3, 1.5e-3]
"""


def bus_robot(database, signals):
    """``signals``: message, signal, direction, quantity and unit, with further keys in TOML."""
    keys = ("message", "signal", "direction", "quantity", "unit")
    text = f'{HEAD}{LINK}\n[bus]\ndatabases = ["one.dbc"]\nbitrate = 500_000\n'
    for *values, more in signals:
        entry = "\n".join(f'{key} = "{value}"' for key, value in zip(keys, values, strict=True))
        text += f'[[bus.signals]]\n{entry}\ntarget = "joint01"\n{more}\n'
    return parse_robot(text, "one.toml", {"one.dbc": database})
