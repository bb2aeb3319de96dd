"""A foreign robot without description: drawn by seed, its physics kept apart from its telemetry.

Nothing here imports undulog: the truth comes from closed forms. Three things that a log confuses
are kept apart: what reached the servo, where the joint is, and what each sensor reports of it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.stats import norm

STIFFNESS = 8.0
"""Effort per control error [N m/rad]."""

EFFORT_NOISE = 0.01
"""Of the healthy effort's amplitude."""

SECOND_TOPIC = "/joint_states_second"
MARGIN_GAIN = 0.02
MARGIN_RAD = np.radians(1.0)
"""Below these a deviation is nothing to name, however sure it is."""

NAMINGS = (
    lambda i, m: f"joint{i + 1}",
    lambda i, m: f"j_{i + 1:02d}",
    lambda i, m: f"{'yaw' if i % 2 == 0 else 'pitch'}_{i}",
    lambda i, m: f"snake/segment{i + 1}/servo",
    lambda i, m: f"servo{chr(ord('a') + i // 26)}{chr(ord('a') + i % 26)}",
)


@dataclass(frozen=True)
class Channels:
    """Channels that are logged besides the positions.

    Attributes:
        velocity: ``true`` (a sensor of its own), ``derived`` (differences of the reported
            position) or None.
        effort: Whether efforts are logged.
        second: Whether a second sensor of the same positions has a topic of its own.
    """

    velocity: str | None = None
    effort: bool = False
    second: bool = False

    def unless_second(self, *kinds):
        """Return kinds that a second sensor would exclude; none if there is one."""
        return frozenset() if self.second else frozenset(kinds)

    def __str__(self):
        """Return the names, joined."""
        names = [f"{self.velocity} velocity"] if self.velocity else []
        names += [name for name in ("effort", "second") if getattr(self, name)]
        return " + ".join(["position", *names])


CHANNELS = (
    *(Channels(), Channels(), Channels("true"), Channels("derived"), Channels(effort=True)),
    *(Channels("derived", effort=True), Channels("true", effort=True), Channels(second=True)),
)


@dataclass(frozen=True)
class Robot:
    """A healthy robot and its commands.

    Attributes:
        names: Joint names, shape (m,).
        planes: 1 or 2; with 2, odd joints are in the other plane.
        amplitude: Of the commands [rad], shape (m,).
        phase: Of the commands [rad], shape (m,).
        bias: Constant part of the commands [rad], shape (m,).
        omega: Gait frequency [rad/s].
        gain: Of the joints, shape (m,).
        lag: Of the joints [rad], shape (m,).
        sigma: Standard deviation of the noise of the position sensors [rad].
        color: Coefficient of its autoregression; 0 is white.
        shared: Share of its variance that all joints have in common.
        scatter: Standard deviation from joint to joint of a sound robot's log gain, of its lag
            [rad] and of its zero [rad].
        zero: Of the joints against their commands [rad], shape (m,).
        second: Share of the second harmonic in the commands.
        start_s: The command's amplitude grows for so long [s].
        step: Step of the position sensors [rad]; 0: none.
        duration_s: Length of the session [s].
        sent_s: Times of the commands [s], shape (k,).
        t_s: Times at which each joint is sampled [s], shape (n, m).
        per_servo: Whether each servo has messages of its own.
        channels: What is logged.
    """

    names: tuple[str, ...]
    planes: int
    amplitude: np.ndarray
    phase: np.ndarray
    bias: np.ndarray
    omega: float
    gain: np.ndarray
    lag: np.ndarray
    sigma: float
    color: float
    shared: float
    scatter: tuple[float, float, float]
    zero: np.ndarray
    second: float
    start_s: float
    step: float
    duration_s: float
    sent_s: np.ndarray
    t_s: np.ndarray
    per_servo: bool
    channels: Channels

    @property
    def m(self):
        """Number of joints."""
        return len(self.names)

    def sent(self):
        """Return the commands as the controller sends them [rad], shape (k, m)."""
        t = self.sent_s[:, None]
        return self.bias + self.amplitude * self._wave(t, self.omega * t + self.phase)

    def asked(self, joint, at=None):
        """Command of a joint at the sampling times of ``at`` (itself if None) [rad], shape (n,)."""
        t = self.t_s[:, joint if at is None else at]
        wave = self._wave(t, self.omega * t + self.phase[joint])
        return self.bias[joint] + self.amplitude[joint] * wave

    def moved(self, joint, gain=1.0, more_lag=0.0, of=-1):
        """Return the true position of a joint [rad], shape (n,).

        Args:
            joint: The joint.
            gain: Times its own gain.
            more_lag: More than its own [rad].
            of: Joint whose command it follows; -1: its own.
        """
        k = joint if of < 0 else of
        t = self.t_s[:, joint]
        wave = self._wave(t, self.omega * t + self.phase[k] - self.lag[joint] - more_lag)
        size = gain * self.gain[joint] * self.amplitude[k]
        return self.bias[k] + self.zero[joint] + size * wave

    def _wave(self, t, angle):
        """A delay shifts the second harmonic by twice the angle."""
        grows = np.clip(t / self.start_s, 0.0, 1.0) if self.start_s > 0 else 1.0
        return grows * (np.sin(angle) + self.second * np.sin(2 * angle + 0.7))

    def swing(self, joint):
        """Return the amplitude of the motion of a joint [rad]."""
        return float(self.gain[joint] * self.amplitude[joint])

    def half(self, joint, count=None):
        """Return half widths of simultaneous 95 % intervals of a joint's deviation from the others.

        Bonferroni over 3 m deviations; each from what a common value, a trend and a parabola
        through the other joints predict (as many of them as m allows).

        Args:
            joint: The joint.
            count: Samples; None: all.

        Returns:
            Of gain (relative) and lag [rad], which are the same number, and of the offset [rad].
        """
        n = len(self.t_s) if count is None else count
        noise = float(np.hypot(self.sigma * self._near(self.omega), self.step / 12**0.5))
        slow = float(np.hypot(self.sigma * self._near(0.0), self.step / 12**0.5))
        factor = float(norm.ppf(1 - 0.025 / (3 * self.m))) * (1 + leverage(self.m, joint)) ** 0.5
        # A joint is also compared with how the sound ones scatter.
        response, zero = (3.5 * max(pair) for pair in (self.scatter[:2], self.scatter[2:]))
        return (
            float(np.hypot(factor * noise * (2 / n) ** 0.5 / self.swing(joint), response)),
            float(np.hypot(factor * slow / n**0.5, zero)),
        )

    def _near(self, omega):
        """Amplitude density of the noise at a frequency, that of white noise being 1."""
        step_s = self.duration_s / len(self.t_s)
        power = (1 - self.color**2) / abs(1 - self.color * np.exp(-1j * omega * step_s)) ** 2
        return float(power**0.5)


def leverage(m, joint):
    """Return the variance of the others' prediction for a joint, in variances of one joint.

    Args:
        m: Joints.
        joint: The one that is left out.
    """
    place = np.linspace(-1.0, 1.0, m)
    terms = 3 if m >= 7 else 2 if m >= 5 else 1
    basis = np.stack([place**k for k in range(terms)], axis=1)
    others = np.delete(basis, joint, axis=0)
    return float(basis[joint] @ np.linalg.solve(others.T @ others, basis[joint]))


def draw(seed, *, small=False, channels=None, joints=None, least_s=15.0):
    """Draw a healthy robot.

    Args:
        seed: Of everything.
        small: Few joints and samples, for tests that must be fast.
        channels: What is logged; None: drawn.
        joints: Least and most joints.
        least_s: Least duration [s].
    """
    rng = np.random.default_rng([seed, 1])
    low, high = joints or ((5, 10) if small else (4, 40))
    m = round(float(np.exp(rng.uniform(np.log(low), np.log(high)))))
    planes = 2 if m >= 8 and rng.random() < 0.4 else 1
    frequency = rng.uniform(0.5, 1.5) if small else float(np.exp(rng.uniform(*np.log([0.3, 1.5]))))
    duration = rng.uniform(least_s, least_s + 2.0) if small else rng.uniform(least_s, 30.0)
    duration = max(duration, 6.0 / frequency)
    per_servo = bool(m <= 12 and rng.random() < 0.3)
    rate = rng.uniform(50.0, 70.0) if small or per_servo else rng.uniform(50.0, 200.0)
    amplitude = rng.uniform(0.1, 0.6)
    step = rng.choice([-1, 1]) * rng.uniform(np.radians(20), np.radians(100))
    place = np.arange(m) / max(m - 1, 1)
    by_plane = np.arange(m) % planes
    other = rng.uniform(0.6, 1.0), rng.uniform(-np.pi, np.pi)
    gain = np.full(m, rng.uniform(0.85, 1.0))
    lag = np.full(m, np.radians(rng.uniform(3.0, 20.0)))
    if m >= 9 and rng.random() < 0.4:  # a smooth profile: free ends, or a trend
        ends, trend = (2 * place - 1) ** 2 - 0.5, place - 0.5
        gain = gain * (1 + rng.uniform(-0.03, 0.03) * ends + rng.uniform(-0.03, 0.03) * trend)
        lag = lag + np.radians(rng.uniform(-3, 3) * ends + rng.uniform(-3, 3) * trend)
    n = round(duration * rate)
    jitter = rng.choice([0.0, 0.05, 0.1]) / rate  # no interval may look like a lost sample
    clock = np.arange(n) / rate + np.clip(rng.normal(0.0, 1.0, n), -2, 2) * jitter
    clock = clock - clock[0]
    skew = rng.uniform(0.0, 0.5 / rate, m) if per_servo else np.zeros(m)
    sent_rate = rate if rng.random() < 0.5 else rng.uniform(50.0, 100.0)
    scatter = (0.003, np.radians(0.2), np.radians(0.3)) if rng.random() < 0.4 else (0.0, 0.0, 0.0)
    gain = gain * np.exp(scatter[0] * rng.normal(size=m))
    lag = lag + scatter[1] * rng.normal(size=m)
    naming = NAMINGS[rng.integers(len(NAMINGS))]
    drawn = CHANNELS[rng.integers(len(CHANNELS))]
    return Robot(
        names=tuple(naming(i, m) for i in range(m)),
        planes=planes,
        amplitude=amplitude * np.where(by_plane == 0, 1.0, other[0]),
        phase=rng.uniform(-np.pi, np.pi) - np.arange(m) * step + by_plane * other[1],
        bias=rng.choice([0.0, 1.0]) * rng.uniform(-0.1, 0.1, m),
        omega=2 * np.pi * frequency,
        gain=gain,
        lag=lag,
        sigma=float(np.exp(rng.uniform(*np.log([1e-3, 5e-3])))),
        color=float(rng.choice([0.0, 0.0, 0.0, 0.9])),
        shared=float(rng.choice([0.0, 0.0, 0.0, 0.8])),
        scatter=scatter,
        zero=scatter[2] * rng.normal(size=m),
        second=float(rng.choice([0.0, 0.0, 0.0, 1.0]) * rng.uniform(0.0, 0.2)),
        start_s=float(rng.choice([0.0, 0.0, 0.0, 1.0]) * rng.uniform(0.5, 2.0)),
        step=float(rng.choice([0.0, 0.0, 0.0, 2 * np.pi / 4096])),
        duration_s=duration,
        sent_s=np.arange(round(duration * sent_rate)) / sent_rate,
        t_s=clock[:, None] + skew,
        per_servo=per_servo,
        channels=drawn if channels is None else channels,
    )


@dataclass(frozen=True)
class Change:
    """Changes of one joint by a fault.

    Attributes:
        joint: The joint.
        position: Where it really is [rad], shape (n,); None: as usual.
        asked: Command that reached its servo [rad], shape (n,); None: as usual.
        power: Share of the effort that the motor gives, shape (n,).
        exact: Where its sensors add no noise, shape (n,).
        reading: From the position that its sensor would report to the one that it does.
        telemetry: Applied to each channel that its servo reports, position included.
        lost: Samples that don't arrive, shape (n,).
    """

    joint: int
    position: np.ndarray | None = None
    asked: np.ndarray | None = None
    power: np.ndarray | float = 1.0
    exact: np.ndarray | bool = False
    reading: Callable[[np.ndarray], np.ndarray] = np.asarray
    telemetry: Callable[[np.ndarray], np.ndarray] = np.asarray
    lost: np.ndarray | bool = False


@dataclass(frozen=True)
class Log:
    """Recorded signals of a robot; NaN where a sample was lost.

    Attributes:
        robot: The robot.
        position: [rad], shape (n, m).
        velocity: [rad/s], or None.
        effort: [N m], or None.
        second: Positions by the second sensor [rad], or None.
    """

    robot: Robot
    position: np.ndarray
    velocity: np.ndarray | None
    effort: np.ndarray | None
    second: np.ndarray | None


def record(robot, changes=(), seed=0):
    """Return the log of a robot with some faults; the seed is that of the sensor noise."""
    rng = np.random.default_rng([seed, 2])
    n, m = robot.t_s.shape
    noise, other_noise = (_noise(robot, rng) for _ in range(2))
    by_joint = {change.joint: change for change in changes}
    position, velocity, effort, second = (np.empty((n, m)) for _ in range(4))
    for j in range(m):
        change = by_joint.get(j, Change(j))
        t, swing = robot.t_s[:, j], robot.swing(j)
        where = robot.moved(j) if change.position is None else change.position
        asked = robot.asked(j) if change.asked is None else change.asked
        noisy = np.where(change.exact, 0.0, 1.0)
        read = where + noisy * noise[:, j]
        other = where + noisy * other_noise[:, j]
        if robot.step > 0:
            read, other = (np.round(reading / robot.step) * robot.step for reading in (read, other))
        rate = np.gradient(where, t) + 0.01 * robot.omega * swing * noisy * rng.normal(size=n)
        scale = STIFFNESS * robot.amplitude[j] * abs(1 - robot.gain[j] * np.exp(-1j * robot.lag[j]))
        pull = STIFFNESS * (asked - where) * change.power
        pull = pull + EFFORT_NOISE * scale * rng.normal(size=n)
        read = change.reading(read)
        if robot.channels.velocity == "derived":
            rate = np.diff(read, prepend=read[0]) / np.diff(t, prepend=2 * t[0] - t[1])
        channels = [np.where(change.lost, np.nan, change.telemetry(x)) for x in (read, rate, pull)]
        position[:, j], velocity[:, j], effort[:, j] = channels
        second[:, j] = other
    logged = robot.channels
    pairs = ((velocity, logged.velocity), (effort, logged.effort), (second, logged.second))
    return Log(robot, position, *(values if is_logged else None for values, is_logged in pairs))


def _noise(robot, rng):
    """Noise of the joints' sensors [rad], shape (n, m)."""
    n, m = robot.t_s.shape
    drawn = (1 - robot.shared) ** 0.5 * rng.normal(size=(n + 100, m))
    drawn += robot.shared**0.5 * rng.normal(size=(n + 100, 1))
    share = (1 - robot.color**2) ** 0.5
    return robot.sigma * lfilter([share], [1.0, -robot.color], drawn, axis=0)[100:]
