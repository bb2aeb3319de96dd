"""Joints with play or dry friction, sample by sample, and the detection of their dead bands."""

import dataclasses

import numpy as np

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.dead_band.measure import dead_bands
from undulog.analysis.response.fitting import fit_gait
from undulog.analysis.signals.columns import Columns
from undulog.capture.log.read.sample_times import Signal

STEP = 2 * np.pi / 4096
FINE = 20
"""Steps of the truth in a sample."""


def play(u, width):
    """Return the output of the play operator by its definition."""
    z, output = 0.0, np.empty_like(u)
    for k, value in enumerate(u):
        z = max(value - width / 2, min(value + width / 2, z))
        output[k] = z
    return output


def stick(u, static, kinetic, lag_s, dt):
    """Return a first-order follower under dry friction, static and kinetic [rad of command]."""
    z, moving, output = float(u[0]), 0, np.empty_like(u)
    for k, value in enumerate(u):
        error = value - z
        if moving == 0 and abs(error) > static:
            moving = 1 if error > 0 else -1
        if moving:
            drive = error - moving * kinetic
            if drive * moving <= 0:
                moving = 0
            else:
                z += dt / lag_s * drive
        output[k] = z
    return output


class Joint:
    """One joint with a dead band of a given width, its encoder and its command."""

    def __init__(self, rng, kind, width, **how):
        rate, frequency = how.get("rate", 50.0), how.get("frequency", 0.2531)
        amplitude, cycles = how.get("amplitude", 0.15), how.get("cycles", 14)
        step, lag_s, excess = how.get("step", STEP), how.get("lag_s", 0.06), how.get("excess", 0.0)
        count = int(cycles / frequency * rate)
        fine = np.arange(count * FINE) / (rate * FINE)
        omega, phase = 2 * np.pi * frequency, rng.uniform(0, 2 * np.pi)

        def command(t):
            return amplitude * np.sin(omega * t + phase)

        if kind == "play":  # behind a delay
            followed = play(command(fine - lag_s), width)
        elif kind == "play behind a lag":
            turn = np.arctan(omega * lag_s)
            followed = play(amplitude * np.cos(turn) * np.sin(omega * fine + phase - turn), width)
        elif kind == "stick":
            low = (width - excess) / 2
            followed = stick(command(fine), low + excess, low, lag_s, fine[1])
        else:  # linear
            followed = command(fine - lag_s)
        self.gain = rng.uniform(0.9, 1.05)
        seen = rng.uniform(-0.2, 0.2) + self.gain * followed[::FINE]
        seen += rng.normal(0, how.get("noise", 0.0), count)
        self.t_s = fine[::FINE]
        self.command = command(self.t_s)
        self.position = np.round(seen / step) * step if step else seen
        self.ideal = followed[::FINE]


def found_in(joints, *, effort=None, second=None):
    """Return the dead bands of joints that were sampled together, by index."""
    t_s = joints[0].t_s
    names = [f"joint{k}" for k in range(len(joints))]
    commands = {n: Series(n, t_s, j.command) for n, j in zip(names, joints, strict=True)}
    responses = {n: Series(n, t_s, j.position) for n, j in zip(names, joints, strict=True)}
    gait = fit_gait(commands, responses, float(t_s[-1]), lambda _: None)
    t_ns = np.rint(t_s * 1e9).astype(np.int64)

    def signals(values):
        pairs = zip(names, values or (), strict=False)
        return {name: Signal(name, "", t_ns, values) for name, values in pairs}

    empty = {field.name: {} for field in dataclasses.fields(Columns)}
    optional = {"names": tuple(names), "effort": signals(effort), "reference": signals(second)}
    bands = dead_bands(Columns(**empty | optional), commands, responses, gait, 0)
    return {int(name.removeprefix("joint")): band for name, band in bands.items()}, gait
