"""A world whose parameters are hidden, a session of it, and the twin fitted to that."""

import json

import numpy as np
from scipy.signal import lfilter

import undulog as front
from undulog.capture import Session, SessionWriter

ROBOT = """name = "chain"
description = "Yaw joints."
clock = "simulated"
assumed = ["links", "servo"]
[chain]
joints = {joints}
planes = ["horizontal"]
[defaults.link]
length = 0.06
radius = 0.025
mass = 0.1
inertia = [4e-5, 5e-5, 5e-5]
[defaults.servo]  # of the data sheet
stall_torque = 0.3
gear_stiffness = 12.0
gear_damping = 0.008
"""
WORLD = """description = "A wave on the ground."
robot = "robot.toml"
duration_s = {duration}
settle_s = 1.5
[noise]
position = {noise}
[gait]
ramp_s = 0.5
[gait.horizontal]
amplitude = {amplitude}
frequency_hz = {frequency_hz}
lag = 1.0
"""


def room_for(folder, joints, duration, hidden, *, noise=0.005, gait=(0.4, 1.0), seed=2):
    """A nominal world, and a session of one whose parameters are others.

    The checks whether a twin fits have a level of 5 %: one noise in twenty is taken for a misfit.
    """
    (folder / "robot.toml").write_text(ROBOT.format(joints=joints))
    amplitude, frequency_hz = gait
    world = WORLD.format(
        duration=duration, noise=noise, amplitude=amplitude, frequency_hz=frequency_hz
    )
    (folder / "nominal.toml").write_text(world)
    (folder / "hidden.toml").write_text(world + hidden)
    words = ["sim", "run", str(folder / "hidden.toml"), "-o", str(folder / "run.mcap")]
    assert front.run([*words, "--seed", str(seed), "--kernels", "numba"]) == 0
    return folder


def fitted(room, capsys, *words, source="run.mcap"):
    command = ["sim", "fit", str(room / source), "--on", f"twin:{room / 'nominal.toml'}"]
    capsys.readouterr()
    assert front.run([*command, *words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    return report, {(one["name"], one["module"]): one for one in report["parameters"]}


def rewritten(source, target, change):
    """Commands and states of a session once more; of states ``change`` gives times and rows."""
    with Session.open(source) as session:
        commands, states = (session.joints(t) for t in ("/joint_commands", "/joint_states"))
        robot = session.robot
    epoch_ns = int(commands.t_ns[0][0])
    with SessionWriter(target, session_id=target.stem, epoch_ns=epoch_ns, robot=robot) as writer:
        for topic, signals in (("/joint_commands", commands), ("/joint_states", states)):
            channel = writer.joint_state(topic, signals.names, unit="rad")
            t_ns, rows = signals.t_ns[0], np.array(signals.values).T.copy()
            if signals is states:
                t_ns, rows = change(t_ns, rows)
            for one, row in zip(t_ns.tolist(), rows, strict=True):
                channel.write(one, row)


def colored(random, rho, *shape):
    """AR(1) noise of variance one, shape (..., n)."""
    white = random.standard_normal((*shape[:-1], shape[-1] + 500))
    return np.sqrt(1 - rho**2) * lfilter([1.0], [1.0, -rho], white)[..., 500:]
