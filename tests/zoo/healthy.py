"""A healthy robot of the bench: commands, servos, noise and encoders; what is recorded of it."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .adapter import Signals, described
from .disturbances import Noise, quantised, repeated
from .motions import Motion
from .robot import MARGIN_GAIN, MARGIN_RAD
from .servos import Servos, respond

DEGREE = np.radians(1.0)
STIFFNESS = 8.0
"""Effort per control error [N m/rad]; any will do, as efforts are compared between joints."""


@dataclass(frozen=True)
class Healthy:
    """A healthy robot and its session, without noise.

    Attributes:
        kind: Name of its kind.
        names: Of the joints, m of them.
        t_s: Sampling times [s], shape (n,).
        motion: The commands.
        servos: What answers them.
        way: Positions [rad], shape (n, m).
        noise: Of the positions.
        step: Of the encoders [rad]; 0: none.
        pauses: First sample and number of samples in which the bus repeats, shape (p, 2).
        efforts: Whether the servos' efforts are logged.
        differs: Whether its joints were made unlike, so that it is right to state differences.
        scatter: Standard deviations of gain, lag [rad] and zero [rad] from joint to joint.
        planes: Plane of each joint by the robot's description; empty without a description.
        smooth: Whether gain and lag have a profile along the chain.
    """

    kind: str
    names: tuple[str, ...]
    t_s: np.ndarray
    motion: Motion
    servos: Servos
    way: np.ndarray
    noise: Noise
    step: float = 0.0
    pauses: tuple[tuple[int, int], ...] = ()
    efforts: bool = False
    differs: bool = False
    scatter: tuple[float, float, float] = (0.0, 0.0, 0.0)
    planes: tuple[str, ...] = ()
    smooth: bool = False

    @property
    def m(self):
        """Number of joints."""
        return len(self.names)

    @property
    def step_s(self):
        """Sampling interval [s]."""
        return float(self.t_s[1] - self.t_s[0])

    @property
    def middle(self):
        """Where the joints rest when their commands are in the middle [rad], shape (m,)."""
        return self.motion.middle + self.servos.offset

    @property
    def moved(self):
        """Joints whose commands move, indices."""
        return np.flatnonzero(self.motion.amplitude > 0)

    @property
    def unlike(self):
        """Whether it is wrong to call its joints alike.

        Gain or lag of a moved joint, at the period of the motion, is beyond the margins about the
        mean of all.
        """
        if not self.differs or self.moved.size < 2:
            return False
        response = self.response()
        gain, lag = np.abs(response), np.angle(response / response.mean())
        beyond = np.abs(gain / gain.mean() - 1) > MARGIN_GAIN
        return bool(beyond.any() or (np.abs(lag) > MARGIN_RAD).any())

    def response(self):
        """Return response over command at the period of the motion, complex, one a moved joint.

        By projection of both on a sine of that period, less their means.
        """
        carrier = np.exp(-2j * np.pi * self.t_s / self.motion.period_s)
        asked, moved = self.commands()[:, self.moved], self.way[:, self.moved]
        return ((moved - moved.mean(axis=0)).T @ carrier) / (
            (asked - asked.mean(axis=0)).T @ carrier
        )

    def commands(self):
        """Return the commands [rad], shape (n, m)."""
        return self.motion.at(self.t_s[:, None]) + np.zeros((1, self.m))

    def later(self, joint, more_delay_s):
        """Return the position of one joint with more dead time [rad], shape (n,)."""
        if self.kind == "twin":  # no closed form
            from scipy.interpolate import CubicSpline

            late = np.maximum(self.t_s - more_delay_s, self.t_s[0])
            return CubicSpline(self.t_s, self.way[:, joint])(late)
        servo = self.servos.of(joint)
        return respond(servo, self.motion, self.t_s, [joint], more_delay_s)[:, 0]

    def rest_error(self, joint):
        """Return how far from its command a joint may rest [rad].

        Of the dead band of stick or play, the offset under a load, an encoder's step and three
        standard deviations of the noise.
        """
        servos = self.servos
        band = float(servos.play[joint] + servos.stick[joint] + abs(servos.offset[joint]))
        noise = np.hypot(self.noise.deviation, self.noise.relative * np.ptp(self.way[:, joint]) / 2)
        return band + self.step + 3 * float(noise)


@dataclass(frozen=True)
class Change:
    """What a fault changes of one joint.

    Attributes:
        joint: The joint.
        position: Where it really is [rad], shape (n,); None: as usual.
        reading: From what its encoder would read to what it does read.
        power: Share of the effort that its motor gives, shape (n,).
    """

    joint: int
    position: np.ndarray | None = None
    reading: Callable[[np.ndarray], np.ndarray] = np.asarray
    power: np.ndarray | float = 1.0


def record(healthy, changes=(), seed=0):
    """Return the signals of a robot with some changes; the seed is that of the noise."""
    rng = np.random.default_rng([seed, 2])
    noise = healthy.noise.draw(rng, healthy.way - healthy.middle)
    rounding = rng.normal(size=healthy.way.shape)
    positions = healthy.way.copy()
    for change in changes:
        if change.position is not None:
            positions[:, change.joint] = change.position
    positions = quantised(positions + noise, healthy.step)
    for change in changes:
        positions[:, change.joint] = change.reading(positions[:, change.joint])
    commands, efforts = healthy.commands(), None
    if healthy.efforts:  # a servo computes them from its own encoder
        efforts = STIFFNESS * (commands - positions)
        for change in changes:
            efforts[:, change.joint] *= change.power
        efforts += 0.01 * STIFFNESS * np.max(healthy.motion.amplitude) * rounding
        efforts = repeated(efforts, healthy.pauses)
    positions = repeated(positions, healthy.pauses)
    robot = described(healthy.names, healthy.planes) if healthy.planes else None
    return Signals(healthy.names, healthy.t_s, commands, positions, efforts, robot)


KINDS: dict[str, Callable[[np.random.Generator], Healthy]] = {}
"""Kinds by name: functions that draw a healthy robot. Each module of kinds adds its own."""


def kind(make):
    """Register a kind under its function's name."""
    KINDS[make.__name__] = make
    return make


def draw(name, seed):
    """Draw a healthy robot of a kind; the seed determines it."""
    return KINDS[name](np.random.default_rng([seed, zlib.crc32(name.encode()), 1]))
