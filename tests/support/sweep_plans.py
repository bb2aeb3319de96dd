"""Small sweeps: a chain of yaw joints on the ground, runs of a second."""

import json

ROBOT = """name = "chain"
description = "Yaw joints."
clock = "simulated"
assumed = ["links", "servo"]
[chain]
joints = 3
planes = ["horizontal"]
[defaults.link]
length = 0.06
radius = 0.025
mass = 0.1
inertia = [4e-5, 5e-5, 5e-5]
[defaults.servo]
stall_torque = 0.3
gear_stiffness = 12.0
gear_damping = 0.008
"""
SCENARIO = """description = "A wave on the ground."
robot = "chain.toml"
duration_s = 2.0
settle_s = 0.5
[noise]
position = 0.001
[gait]
ramp_s = 0.25
[gait.horizontal]
amplitude = 0.3
frequency_hz = 2.0
lag = 1.0
"""
STRENGTHS = """scenario = "wave.toml"
seeds = {seeds}
{top}
[parameters."servo.stall_torque"]
values = {values}
"""


def write_plan(folder, values=(0.2, 0.3), seeds=1, top="", name="plan.toml"):
    """A plan over the servos' strength, with its scenario and robot; returns its path."""
    (folder / "chain.toml").write_text(ROBOT)
    (folder / "wave.toml").write_text(SCENARIO)
    path = folder / name
    path.write_text(STRENGTHS.format(values=list(values), seeds=seeds, top=top))
    return path


def comparable(rows):
    """Key to text of each row, without what depends on the machine."""
    return {
        row["key"]: json.dumps(
            {
                name: value
                for name, value in sorted(row.items())
                if value is not None and name != "worker" and not name.endswith("_wall")
            }
        )
        for row in rows
    }
