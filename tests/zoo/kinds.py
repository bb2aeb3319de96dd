"""Kinds of healthy robots in closed form, drawn by a seed.

Each has what made somebody's judgement accuse a healthy joint, and nothing is wrong with it.
"""

from dataclasses import replace

import numpy as np

from . import motions
from .disturbances import Noise
from .healthy import DEGREE, Healthy, kind
from .motions import Drawn
from .servos import alike, respond

MOST_VALUES = 400_000
"""Samples of all joints of a session at most: longer sessions of long chains are cut short, so that
thousands of sessions fit into a night."""

SCATTER = (0.003, 0.2 * DEGREE, 0.3 * DEGREE)
"""Standard deviations from joint to joint of a sound robot's gain, of its lag at the period of the
motion and of its zero [rad]: those of the zoo (``robot.draw``), well within the margins of 2 % and
1 degree."""


def _log_uniform(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _drawn(rng, joints=(3, 60), least_s=10.0, amplitude=(1.0, 60.0)):
    """Draw joint count, rate, duration and amplitude."""
    m = round(_log_uniform(rng, *joints))
    rate = _log_uniform(rng, 20.0, 200.0)
    duration = _log_uniform(rng, least_s, 120.0)
    duration = min(duration, max(least_s, MOST_VALUES / (m * rate)))
    size = DEGREE * _log_uniform(rng, *amplitude)
    middle = rng.choice([0.0, 1.0]) * rng.uniform(-0.2, 0.2, m)
    return Drawn(m, rate, duration, np.full(m, size), middle)


def _white(rng, drawn):
    """Noise of 0.01 to 0.3 degrees, but at most a tenth of the motion."""
    most = float(np.max(drawn.amplitude)) / 10
    return Noise(min(DEGREE * _log_uniform(rng, 0.01, 0.3), most))


def _servos(rng, drawn, motion):
    """Draw servos that are alike but for a scatter within the margins."""
    m, pole_s = drawn.m, rng.uniform(0.0, 0.1)
    servos = alike(m, gain=rng.uniform(0.9, 1.02), delay_s=rng.uniform(0.0, 0.05), pole_s=pole_s)
    scatter = SCATTER if rng.random() < 0.4 else (0.0, 0.0, 0.0)
    late_s = scatter[1] * motion.period_s / (2 * np.pi)
    servos = replace(
        servos,
        gain=servos.gain * (1 + scatter[0] * _cut(rng, m)),
        delay_s=np.maximum(servos.delay_s + late_s * _cut(rng, m), 0.0),
        offset=scatter[2] * _cut(rng, m),
    )
    return servos, scatter


def _cut(rng, m):
    """Return standard normal numbers, cut at 2.5: no healthy joint is beyond the margins."""
    return np.clip(rng.normal(size=m), -2.5, 2.5)


def _robot(kind, drawn, motion, servos, noise, **more):
    """Put a healthy robot together."""
    t_s = np.arange(round(drawn.duration_s * drawn.rate_hz)) / drawn.rate_hz
    names = tuple(f"joint{j + 1:02d}" for j in range(drawn.m))
    way = respond(servos, motion, t_s)
    return Healthy(kind, names, t_s, motion, servos, way, noise, **more)


def _usual(kind, rng, *, noise=None, motion=motions.gait, change=None, drawn=None, **more):
    """Draw a robot that is usual but for what is given.

    Args:
        kind: Its name.
        rng: Generator.
        noise: From the generator and what is drawn to the noise.
        motion: Likewise to the motion.
        change: From servos, generator and what is drawn to other servos.
        drawn: Joint count, rate, duration and amplitude.
    """
    drawn = _drawn(rng) if drawn is None else drawn
    moved = motion(rng, drawn)
    servos, scatter = _servos(rng, drawn, moved)
    if change is not None:
        servos = change(servos, rng, drawn)
    noise = _white(rng, drawn) if noise is None else noise(rng, drawn)
    return _robot(kind, drawn, moved, servos, noise, scatter=scatter, **more)


@kind
def white(rng):
    """White noise."""
    return _usual("white", rng)


def _coloured(rho):
    def noise(rng, drawn):
        return Noise(0.0, _white(rng, drawn).white, rho)

    return noise


@kind
def ar90(rng):
    """Noise with a correlation of 0.9 from sample to sample."""
    return _usual("ar90", rng, noise=_coloured(0.9))


@kind
def ar98(rng):
    """Noise with a correlation of 0.98 from sample to sample."""
    return _usual("ar98", rng, noise=_coloured(0.98))


@kind
def student(rng):
    """Noise with heavy tails: Student's t of index 2.5."""
    return _usual("student", rng, noise=lambda *given: replace(_white(*given), tail=2.5))


@kind
def multiplicative(rng):
    """Noise in proportion to the way from the middle."""

    def noise(rng, drawn):
        return replace(_white(rng, drawn), relative=rng.uniform(0.005, 0.05))

    return _usual("multiplicative", rng, noise=noise)


@kind
def shared(rng):
    """Noise that the joints have in common, as of a base that shakes."""

    def noise(rng, drawn):
        return replace(_white(rng, drawn), shared=rng.uniform(0.5, 0.95))

    return _usual("shared", rng, noise=noise)


@kind
def quantised_encoder(rng):
    """Encoders of 8 to 12 bit and next to no noise."""
    step = 2 * np.pi / 2 ** int(rng.integers(8, 13))
    drawn = _drawn(rng, amplitude=(max(1.0, 3 * step / DEGREE), 60.0))
    return _usual(
        "quantised_encoder", rng, noise=lambda *_: Noise(step / 20), drawn=drawn, step=step
    )


@kind
def soft(rng):
    """Soft servos that rest 3 to 12 degrees off their command under their loads."""

    def sag(servos, rng, drawn):
        size = DEGREE * rng.uniform(3.0, 12.0, drawn.m) * rng.choice([-1, 1], drawn.m)
        return replace(servos, offset=size, gain=servos.gain * rng.uniform(0.85, 1.0))

    def motion(rng, drawn):
        if rng.random() < 0.5:
            return motions.gait(rng, drawn)
        return motions.ending(motions.gait(rng, drawn), rng.uniform(0.5, 0.8) * drawn.duration_s)

    drawn = _drawn(rng, amplitude=(10.0, 60.0))
    return _usual("soft", rng, motion=motion, change=sag, drawn=drawn, differs=True)


@kind
def stick(rng):
    """Stick: joints rest until the command is 0.3 to 3 degrees away."""

    def band(servos, rng, drawn):
        most = float(np.max(drawn.amplitude)) / 4
        return replace(servos, stick=np.full(drawn.m, min(DEGREE * rng.uniform(0.3, 3), most)))

    return _usual("stick", rng, change=band)


@kind
def backlash(rng):
    """Play of 0.2 to 2 degrees."""

    def play(servos, rng, drawn):
        most = float(np.max(drawn.amplitude)) / 4
        return replace(servos, play=np.full(drawn.m, min(DEGREE * rng.uniform(0.1, 1), most)))

    return _usual("backlash", rng, change=play)


@kind
def delayed(rng):
    """Delays of 3 to 12 samples, as of a slow bus, up to 0.3 s."""

    def late(servos, rng, drawn):
        more_s = min(rng.integers(3, 13) / drawn.rate_hz, 0.3)
        return replace(servos, delay_s=servos.delay_s + more_s)

    return _usual("delayed", rng, change=late)


@kind
def two_servos(rng):
    """Two kinds of servos in one chain: each second one, or the rear half."""

    def mixed(servos, rng, drawn):
        second = np.arange(drawn.m) % 2 == 1
        if rng.random() < 0.5:
            second = np.arange(drawn.m) >= drawn.m // 2
        weaker, later_s = rng.uniform(0.75, 0.95), rng.uniform(0.0, 0.06)
        return replace(
            servos,
            gain=np.where(second, weaker, 1.0) * servos.gain,
            delay_s=servos.delay_s + np.where(second, later_s, 0.0),
        )

    return _usual("two_servos", rng, change=mixed, drawn=_drawn(rng, (4, 60)), differs=True)


def _profiled(ends):
    """Return a change of gain and lag that decays from the first end, or from both."""

    def change(servos, rng, drawn):
        reach = rng.uniform(0.5, 0.3 * drawn.m)
        near = np.exp(-np.arange(drawn.m) / reach)
        if ends == 2:
            near = near + near[::-1]
        return replace(
            servos,
            gain=servos.gain * (1 + rng.uniform(-0.12, 0.12) * near),
            delay_s=servos.delay_s + rng.uniform(0.0, 0.05) * near,
        )

    return change


@kind
def one_free_end(rng):
    """Gain and lag that decay from one end of the chain."""
    drawn = _drawn(rng, (7, 60))
    more = {"differs": True, "smooth": True}
    return _usual("one_free_end", rng, change=_profiled(1), drawn=drawn, **more)


@kind
def two_free_ends(rng):
    """Gain and lag that decay from both ends of the chain."""
    drawn = _drawn(rng, (7, 60))
    more = {"differs": True, "smooth": True}
    return _usual("two_free_ends", rng, change=_profiled(2), drawn=drawn, **more)


@kind
def bus_pauses(rng):
    """A driver that repeats its values while the bus is silent, for 0.1 to 1 s, some times."""
    usual = _usual("bus_pauses", rng)
    n = usual.t_s.size
    lengths = np.maximum((rng.uniform(0.1, 1.0, rng.integers(1, 6)) / usual.step_s).astype(int), 3)
    starts = np.sort(rng.integers(1, n - lengths.max() - 1, lengths.size))
    return replace(usual, pauses=tuple(zip(starts.tolist(), lengths.tolist(), strict=True)))


@kind
def wander(rng):
    """Offsets that wander by 0.1 to 1 degree within 2 to 10 s."""

    def noise(rng, drawn):
        rho = float(np.exp(-1 / (drawn.rate_hz * rng.uniform(2.0, 10.0))))
        most = float(np.max(drawn.amplitude)) / 4
        wide = min(DEGREE * _log_uniform(rng, 0.1, 1.0), most)
        return replace(_white(rng, drawn), coloured=wide, rho=rho)

    return _usual("wander", rng, noise=noise)


@kind
def command_ends(rng):
    """A gait that ends within the record; the last command is held."""

    def motion(rng, drawn):
        return motions.ending(motions.gait(rng, drawn), rng.uniform(0.5, 0.9) * drawn.duration_s)

    return _usual("command_ends", rng, motion=motion)


@kind
def command_holds(rng):
    """A gait that is held for a while, some times."""

    def motion(rng, drawn):
        count = int(rng.integers(1, 4))
        length_s = rng.uniform(0.05, 0.3 / count) * drawn.duration_s
        slots = (np.arange(count) + rng.uniform(0.1, 0.6)) * drawn.duration_s / count
        holds = np.stack([slots, np.full(count, length_s)], axis=1)
        return motions.holding(motions.gait(rng, drawn), holds)

    return _usual("command_holds", rng, motion=motion)


@kind
def steps(rng):
    """Steps to random levels."""
    return _usual("steps", rng, motion=motions.steps)


@kind
def binary(rng):
    """Binary sequences."""
    return _usual("binary", rng, motion=motions.binary)


@kind
def some_move(rng):
    """Some joints move, the others hold their place."""

    def motion(rng, drawn):
        moves = rng.permutation(drawn.m) < max(1, round(rng.uniform(0.2, 0.8) * drawn.m))
        return motions.partly(motions.gait(rng, drawn), moves)

    return _usual("some_move", rng, motion=motion)


@kind
def one_command(rng):
    """All joints have the same command."""

    def motion(rng, drawn):
        return motions.gait(rng, drawn, shared=True)

    return _usual("one_command", rng, motion=motion)


@kind
def few_joints(rng):
    """3 joints."""
    return _usual("few_joints", rng, drawn=_drawn(rng, (3, 3)))


@kind
def many_joints(rng):
    """40 to 60 joints."""
    return _usual("many_joints", rng, drawn=_drawn(rng, (40, 60)))


@kind
def short_chain(rng):
    """4 to 6 joints."""
    return _usual("short_chain", rng, drawn=_drawn(rng, (4, 6)))


@kind
def chirp(rng):
    """A chirp."""
    return _usual("chirp", rng, motion=motions.chirp, drawn=_drawn(rng, least_s=20.0))


@kind
def multisine(rng):
    """A multisine."""
    return _usual("multisine", rng, motion=motions.multisine, drawn=_drawn(rng, least_s=20.0))


def _in_turn(rng, drawn):
    """Return a gait in two planes, joint by joint."""
    return motions.gait(rng, drawn, by_plane=np.arange(drawn.m) % 2)


@kind
def planes(rng):
    """Joints that bend the body in two planes in turn; nothing describes them."""
    return _usual("planes", rng, motion=_in_turn, drawn=_drawn(rng, (6, 60)))


@kind
def described_planes(rng):
    """The same with a description of the robot, which names each joint's plane."""
    drawn = _drawn(rng, (8, 60))
    by_joint = tuple(("horizontal", "vertical")[j % 2] for j in range(drawn.m))
    return _usual("described_planes", rng, motion=_in_turn, drawn=drawn, planes=by_joint)


@kind
def efforts(rng):
    """The servos' efforts are logged, computed from their own encoders."""
    return _usual("efforts", rng, efforts=True)


@kind
def arm(rng):
    """An arm whose joints have nothing in common, at ordinary work."""

    def unlike(servos, rng, drawn):
        m = drawn.m
        return replace(
            servos,
            gain=rng.uniform(0.92, 1.02, m),
            delay_s=rng.uniform(0.0, 0.12, m),
            pole_s=rng.uniform(0.0, 0.15, m),
            offset=DEGREE * rng.uniform(-2.0, 2.0, m),
            stick=DEGREE * rng.uniform(0.0, 1.0, m) * (rng.random(m) < 0.5),
        )

    drawn = _drawn(rng, (5, 7), least_s=20.0, amplitude=(10.0, 60.0))
    drawn = replace(drawn, amplitude=drawn.amplitude * rng.uniform(0.3, 1.0, drawn.m))
    return _usual("arm", rng, motion=motions.work, change=unlike, drawn=drawn, differs=True)
