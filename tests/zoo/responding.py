"""Joints that follow, but respond differently from the others."""

import numpy as np

from .planting import GAIN, LAG, OFFSET, RESPONSE, fault, offset, onset, relative, single
from .robot import MARGIN_GAIN, MARGIN_RAD, Change
from .truth import LOADED, PAUSED, STOPPED


def _responds(j, position, quantities):
    return single(Change(j, position=position), stands_out=quantities, checked=False)


def weak(robot, rng, j):
    """The position is smaller."""
    return _responds(j, robot.moved(j, gain=1 - min(relative(robot, j, rng, 0.5), 0.6)), GAIN)


for _place in ("head", "middle", "tail", None):
    fault(f"gain less{f', {_place}' if _place else ''}", place=_place)(weak)
fault("gain less, of six", joints=(6, 6))(weak)
fault("gain less, of forty", joints=(40, 40))(weak)


@fault("gain more")
def _(robot, rng, j):
    """The position is larger."""
    return _responds(j, robot.moved(j, gain=1 + relative(robot, j, rng, 0.4)), GAIN)


@fault("lag more")
def _(robot, rng, j):
    """The position is later."""
    return _responds(j, robot.moved(j, more_lag=relative(robot, j, rng, 0.5)), LAG)


@fault("offset only")
def _(robot, rng, j):
    """The position is off by a constant."""
    size = offset(robot, j, rng, 0.3)
    return _responds(j, robot.moved(j) + size, OFFSET)


@fault("gain fades")
def _(robot, rng, j):
    """The position becomes smaller from cycle to cycle."""
    gain = 1 - min(2 * relative(robot, j, rng, 0.25), 0.9) * robot.t_s[:, j] / robot.duration_s
    return _responds(j, robot.moved(j, gain=gain), GAIN)


@fault("gain less from half-way on")
def _(robot, rng, j):
    """The position becomes smaller at once."""
    _, acts = onset(robot, j, rng, 0.4, 0.6)
    size = min(2.5 * relative(robot, j, rng, 0.2), 0.5)
    return _responds(j, robot.moved(j, gain=np.where(acts, 1 - size, 1.0)), GAIN)


def clipped(robot):
    """Return the sensor's kinds of a flat top; none if another sensor shows it, too."""
    return robot.channels.unless_second("clipped_sensor", "frozen_sensor")


def _at_limit(robot, j, position, more, quantities):
    change, kinds = Change(j, position=position), LOADED | clipped(robot) | more
    return single(change, {"at_limit"}, kinds, stands_out=quantities, checked=False)


@fault("saturates at both ends")
def _(robot, rng, j):
    """Flat tops at both ends of the motion."""
    level = rng.uniform(0.5, 0.75) * robot.swing(j)
    about = robot.bias[j]
    position = about + np.clip(robot.moved(j) - about, -level, level)
    return _at_limit(robot, j, position, STOPPED, GAIN)


@fault("at its limit on one side")
def _(robot, rng, j):
    """Flat tops at one end of the motion."""
    level = rng.uniform(-0.2, 0.4) * robot.swing(j)
    side, about = rng.choice([-1, 1]), robot.bias[j]
    position = about + side * np.minimum(side * (robot.moved(j) - about), level)
    return _at_limit(robot, j, position, STOPPED | PAUSED, GAIN | OFFSET)


@fault("speed limited")
def _(robot, rng, j):
    """A triangle instead of a sine."""
    moved, t = robot.moved(j), robot.t_s[:, j]
    most = rng.uniform(0.3, 0.55) * robot.swing(j) * robot.omega
    position = moved.copy()
    for k in range(1, len(t)):
        step = most * (t[k] - t[k - 1])
        position[k] = position[k - 1] + np.clip(moved[k] - position[k - 1], -step, step)
    return _responds(j, position, RESPONSE)


def _grown(robot, j, rng, make):
    """Return the position of an operator, its size increased until the response shows it.

    Flat tops at the reversals change the fundamental by little: a size that is large as a share
    of the motion may leave gain and lag within the margins.
    """
    half = robot.half(j)[0]
    size = rng.uniform(0.08, 0.3)
    while size < 1.0:
        position = make(size * robot.swing(j))
        ratio = _fundamental(robot, j, position) / _fundamental(robot, j, robot.moved(j))
        gain_off, lag_off = abs(abs(ratio) - 1) - 2 * half, abs(np.angle(ratio)) - 2 * half
        if gain_off > max(half, MARGIN_GAIN) or lag_off > max(half, MARGIN_RAD):
            break
        size *= 1.2
    return position


def _fundamental(robot, j, values):
    """Complex amplitude at the gait frequency, by least squares."""
    angle = robot.omega * robot.t_s[:, j]
    model = np.stack([np.cos(angle), np.sin(angle), np.ones(angle.size)], axis=1)
    (cosine, sine, _), *_ = np.linalg.lstsq(model, values)
    return complex(cosine, -sine)


@fault("backlash")
def _(robot, rng, j):
    """Flat for a moment at both reversals, then in step again."""
    moved = robot.moved(j)

    def play(half):
        position = moved.copy()
        for k in range(1, len(moved)):
            position[k] = np.clip(position[k - 1], moved[k] - half, moved[k] + half)
        return position

    return _responds(j, _grown(robot, j, rng, play), RESPONSE)


@fault("sticks at both reversals")
def _(robot, rng, j):
    """Flat for a moment at both reversals, then a jump."""
    moved = robot.moved(j)

    def stuck(band):
        position, moves = moved.copy(), True
        for k in range(2, len(moved)):
            if moves and (moved[k] - moved[k - 1]) * (moved[k - 1] - moved[k - 2]) < 0:
                moves = False
            moves = moves or abs(moved[k] - position[k - 1]) > band
            position[k] = moved[k] if moves else position[k - 1]
        return position

    return _responds(j, _grown(robot, j, rng, stuck), RESPONSE)


@fault("lag grows")
def _(robot, rng, j):
    """The position becomes later from cycle to cycle."""
    size = 2 * relative(robot, j, rng, 0.3)
    return _responds(j, robot.moved(j, more_lag=size * robot.t_s[:, j] / robot.duration_s), LAG)


@fault("weak to one side")
def _(robot, rng, j):
    """The position is smaller on one side of its middle."""
    size = min(2 * relative(robot, j, rng, 0.25), 0.7)
    moved, about = robot.moved(j), robot.bias[j] + robot.zero[j]
    side = rng.choice([-1, 1]) * (moved - about) > 0
    return _responds(j, np.where(side, about + (1 - size) * (moved - about), moved), GAIN | OFFSET)
