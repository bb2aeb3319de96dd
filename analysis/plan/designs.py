"""Which runs an experiment needs, as deviations of the commands from a gait."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from undulog.capture.common.arrays import ComplexArray

from ..session.posture import HEADING

KICK = 0.05
"""Of phase [rad] and of log amplitude."""

BASE_RUNS = 6
"""Of the gait as it is: how much they differ is how much runs scatter."""

HELD_OUT = (0.05, 0.1, 0.15)
"""Largest random phase of each held-out pattern [rad]."""


@dataclass(frozen=True)
class Tone:
    """A sine at a frequency of its own, in all driven joints.

    Attributes:
        omega: Angular frequency [rad/s].
        amplitude: Complex amplitudes of the driven joints' commands [rad], shape (m,).
    """

    omega: float
    amplitude: ComplexArray


@dataclass(frozen=True)
class PlannedRun:
    """One run's commands.

    Attributes:
        label: For its file name.
        amplitude: Complex amplitudes of the driven joints' commands at the gait's frequency [rad],
            shape (m,).
        facts: What it is, for its metadata record.
        more: Tones beside it.
    """

    label: str
    amplitude: ComplexArray
    facts: dict[str, str] = field(default_factory=dict[str, str])
    more: tuple[Tone, ...] = ()

    def tones(self, omega: float) -> tuple[Tone, ...]:
        """All that is commanded.

        Args:
            omega: The gait's angular frequency [rad/s].

        Returns:
            The tone at the gait's frequency, then the others.
        """
        return (Tone(omega, self.amplitude), *self.more)


def phase_kicks(
    names: tuple[str, ...],
    amplitude: ComplexArray,
    repeats: int = 1,
    seed: int = 1,
    *,
    kick: float = KICK,
    base_runs: int = BASE_RUNS,
) -> tuple[PlannedRun, ...]:
    """Runs of the gait as it is, each joint kicked four ways, and held-out patterns.

    Args:
        names: Of the m driven joints.
        amplitude: Of the gait, shape (m,).
        repeats: How often all of it is run.
        seed: Of the held-out patterns and of the order.
        kick: Of phase [rad] and of log amplitude.
        base_runs: Runs without a kick in all, at least one a repeat.

    Returns:
        4 m + 3 runs and those without a kick a repeat, in random order, so that warming up looks
        like no kick but like scatter.
    """
    random = np.random.default_rng(seed)
    runs: list[PlannedRun] = []
    for _ in range(repeats):
        once = [PlannedRun("base", amplitude, {"kind": "base"})] * math.ceil(base_runs / repeats)
        for joint, name in enumerate(names):
            for kind, step in (("phase", kick * 1j), ("amplitude", kick)):
                for sign, word in ((1, "up"), (-1, "down")):
                    off = np.zeros(len(names), dtype=np.complex128)
                    off[joint] = sign * step
                    facts = {"kind": kind, "joint": name, "sign": f"{sign:+d}"}
                    label = f"{name}-{kind}-{word}"
                    runs_amplitude = (amplitude * np.exp(off)).astype(np.complex128)
                    once.append(PlannedRun(label, runs_amplitude, facts))
        for size in HELD_OUT:
            turned = amplitude * np.exp(1j * random.uniform(-size, size, len(names)))
            once.append(PlannedRun("held-out", turned.astype(np.complex128), {"kind": "held-out"}))
        runs += [once[k] for k in random.permutation(len(once))]
    return tuple(runs)


def reversal(amplitude: ComplexArray, each: int = 6) -> tuple[PlannedRun, ...]:
    """Runs of a wave and of its reverse, the robot turned by half a turn in half of each.

    A tilted floor then cancels between runs that are each other's mirror image: the wave at one
    heading and its reverse at the other.

    Args:
        amplitude: Of the gait, head to tail, shape (m,).
        each: Runs each way.

    Returns:
        Twice as many runs, the heading among their facts. Four make a block, in which the two
        runs of a mirror image follow each other; the next block swaps the waves, so that warming
        up looks like neither direction nor heading, and the robot is turned every second run.
    """
    ways = (("as-recorded", amplitude), ("reversed", amplitude[::-1]))
    runs: list[PlannedRun] = []
    for k in range(2 * each):
        way, own = ways[(k + k // 4) % 2]
        turned = k % 4 in (1, 2)
        facts = {"kind": way, HEADING: f"{math.pi if turned else 0.0:.6f}"}
        runs.append(PlannedRun(f"{way}-{180 if turned else 0}", own, facts))
    return tuple(runs)
