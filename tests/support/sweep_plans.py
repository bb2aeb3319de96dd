"""Small sweeps: a chain of yaw joints on the ground, runs of a second."""

import json

from support import twin_chains

STRENGTHS = """scenario = "wave.toml"
seeds = {seeds}
{top}
[parameters."servo.stall_torque"]
values = {values}
"""


def write_plan(folder, values=(0.2, 0.3), seeds=1, top="", name="plan.toml", *, joints=3):
    """Write a plan over the servos' strength, with its scenario and robot; return its path."""
    servo = {"stall_torque": 0.3, "gear_stiffness": 12.0, "gear_damping": 0.008}
    robot = twin_chains.chain(joints, planes=["horizontal"], **servo)
    scenario = twin_chains.wave(
        duration_s=2.0,
        settle_s=0.5,
        gait={"ramp_s": 0.25},
        horizontal={"amplitude": 0.3, "frequency_hz": 2.0, "lag": 1.0},
        noise={"position": 0.001},
    )
    (folder / "chain.toml").write_text(robot)
    (folder / "wave.toml").write_text(scenario)
    path = folder / name
    path.write_text(STRENGTHS.format(values=list(values), seeds=seeds, top=top))
    return path


def comparable(rows):
    """Return key to text of each row, without the columns that depend on the machine."""
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
