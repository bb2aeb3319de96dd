"""A gate with a robot of closed form: it is where it was commanded to be one tick before."""

import numpy as np

from undulog.capture import load_robot
from undulog.sim.drive.gate import Gate
from undulog.sim.drive.limits import gate_limits
from undulog.sim.drive.outcome import GateInput, GatePhase, JointStatus
from undulog.sim.gait.contract import GaitTick, Readings

ROBOT = load_robot("snake25")
LIMITS = gate_limits(ROBOT)
COUNT = 25
RATE_HZ = 100


def fastest(commands):
    """Return the largest change of a command from tick to tick [rad]."""
    return np.abs(np.diff(commands, axis=0)).max()


class Wave:
    """A gait: joint i follows amplitude sin(w t + i), from the first tick on."""

    names = ()

    def __init__(self, amplitude=0.3, frequency_hz=0.5):
        self.amplitude, self.w = amplitude, 2 * np.pi * frequency_hz
        self.asked = []

    def at(self, time_s):
        return self.amplitude * np.sin(self.w * time_s + np.arange(COUNT))

    def step(self, time_s, readings):
        del readings
        self.asked.append(time_s)
        return GaitTick(self.at(time_s), np.empty(0), "walk", ())


def reading(angle, *, current=0.0, temperature=30.0, voltage=np.nan, silence_s=0.0, **more):
    def all_of(value):
        return np.broadcast_to(np.asarray(value, dtype=float), COUNT).copy()

    status = JointStatus(
        all_of(angle), all_of(current), all_of(temperature), all_of(voltage), all_of(silence_s)
    )
    return GateInput(Readings(status.angle, all_of(0.0)), status, **more)


class Bench:
    """A gate with a robot that is where it was commanded to be one tick before.

    Attributes:
        sent: The commands, in order [rad].
        remarks: Everything that the gate had to say.
    """

    def __init__(self, gait=None, start=0.0, *, duration_s=1.0, limits=LIMITS, **options):
        self.gait = gait or Wave()
        options |= {"duration_s": duration_s, "place": "can:test"}
        self.gate = Gate(self.gait, limits, **options)
        self.angle = np.full(COUNT, start)
        self.tick = 0
        self.sent, self.remarks = [], []

    def step(self, change=None, stop="", *, at_once=False, skip=0, **more):
        angle = self.angle.copy()
        if change is not None:
            change(angle)
        self.tick += skip
        result = self.gate.step(self.tick, reading(angle, **more), stop, at_once=at_once)
        self.tick += 1
        self.remarks += result.remarks
        if result.command is not None:
            self.sent.append(result.command)
            self.angle = result.command
        return result

    def until(self, phase, **more):
        for _ in range(2000):
            result = self.step(**more)
            if self.gate.phase is phase:
                return result
        raise AssertionError(f"never came to {phase}")

    def running(self, ticks=0):
        """Run the gait, so many ticks of it."""
        self.until(GatePhase.RUN)
        for _ in range(ticks):
            self.step()
        return self
