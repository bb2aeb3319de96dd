"""A healthy robot of the dynamics twin: weak servos, rigid bodies, friction with the ground.

Its joints are identical and answer unlike: near the free ends of the body they move more mass with
less reaction. Nothing here is a closed form.
"""

import numpy as np

from undulog.sim import parse_scenario, run_batch
from undulog.sim.gait.contract import CONTROL_RATE_HZ

from .disturbances import Noise
from .healthy import DEGREE, Healthy, kind
from .motions import Motion
from .servos import alike

SCENARIO = """
description = "A healthy robot with 13 joints that bend it to the sides."
robot = "snake25"
duration_s = {duration}
[gait]
ramp_s = 1.0
[gait.horizontal]
amplitude = {amplitude}
frequency_hz = {frequency}
lag = {lag}
[servo]
stall_torque = {torque}
"""

SETTLES_S = 3.0
"""Start that is left out: the ramp of 1 s and two cycles of the slowest gait's transient."""


@kind
def twin(rng):
    """The dynamics twin: 13 of 25 joints move."""
    frequency = rng.uniform(0.3, 1.0)
    duration = SETTLES_S + max(12.0, 8 / frequency)
    amplitude, lag = rng.uniform(0.15, 0.45), np.radians(rng.uniform(30.0, 70.0))
    text = SCENARIO.format(
        duration=round(duration, 2),
        amplitude=amplitude,
        frequency=frequency,
        lag=lag,
        torque=rng.uniform(0.2, 1.5),
    )
    (run,) = run_batch([parse_scenario(text, "twin.toml")])
    first = round(SETTLES_S * CONTROL_RATE_HZ)
    way, commands = run.angle[first:], run.command[first:]
    names = run.scenario.robot.joint_names
    t_s = np.arange(len(way)) / CONTROL_RATE_HZ
    moves = np.ptp(commands, axis=0) > 0
    middle = np.where(moves, 0.0, commands[0])

    def at(t):
        tick = np.clip(np.rint(t * CONTROL_RATE_HZ).astype(int), 0, len(commands) - 1)
        return commands[tick, np.arange(len(names))]

    motion = Motion(at, middle, np.where(moves, amplitude, 0.0), 1 / frequency)
    noise = Noise(DEGREE * rng.uniform(0.01, 0.2))
    servos = alike(len(names))
    return Healthy("twin", names, t_s, motion, servos, way, noise, differs=True, smooth=True)
