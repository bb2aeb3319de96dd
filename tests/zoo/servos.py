"""Healthy position servos in closed form: gain, delay, a pole, rest error, play and stick."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter


@dataclass(frozen=True)
class Servos:
    """Servos of m joints; all arrays have shape (m,).

    Attributes:
        gain: Of the motion about the command's middle.
        delay_s: Dead time [s].
        pole_s: Time constant of a first-order lag [s]; 0: none.
        offset: Rest off the command, as of a soft servo under a load [rad].
        play: Half of the backlash [rad]: within it the joint doesn't move.
        stick: Control error that a joint at rest needs to move [rad].
    """

    gain: np.ndarray
    delay_s: np.ndarray
    pole_s: np.ndarray
    offset: np.ndarray
    play: np.ndarray
    stick: np.ndarray

    def of(self, joint):
        """Return the servo of one joint, arrays of shape (1,)."""
        return Servos(*(values[joint : joint + 1] for values in vars(self).values()))


def alike(m, *, gain=1.0, delay_s=0.0, pole_s=0.0):
    """Return m equal servos without offset, play and stick."""
    values = (gain, delay_s, pole_s, 0.0, 0.0, 0.0)
    return Servos(*(np.full(m, value) for value in values))


def respond(servos, motion, t_s, joints=slice(None), more_delay_s=0.0):
    """Return where the joints are [rad], shape (n, m), without noise.

    Args:
        servos: Of the joints chosen, m of them.
        motion: Commands of all joints.
        t_s: Times [s], evenly spaced, shape (n,).
        joints: Which joints of the motion these servos have.
        more_delay_s: More dead time of all of them [s].
    """
    late = motion.at(t_s[:, None] - _of_all(servos.delay_s, motion, joints) - more_delay_s)
    middle = motion.middle[joints]
    asked = late[:, joints] - middle
    lagged = np.stack(
        [
            first_order(column, pole_s, t_s[1] - t_s[0])
            for column, pole_s in zip(asked.T, servos.pole_s, strict=True)
        ],
        axis=1,
    )
    way = servos.gain * lagged
    if servos.play.any():
        way = played(way, servos.play)
    if servos.stick.any():
        way = stuck(way, servos.stick)
    return middle + servos.offset + way


def _of_all(values, motion, joints):
    """Return values of the chosen joints in an array of all of them, shape (m,)."""
    full = np.zeros(motion.middle.size)
    full[joints] = values
    return full


def first_order(values, pole_s, step_s):
    """Return the output of T y' + y = u, which rests at first, for an input of straight pieces.

    Exact for these (first-order hold; Franklin, Powell and Workman, Digital Control of Dynamic
    Systems, 1998, section 6.3): with a = exp(-h/T) and k = T (1 - a) / h,

        y_i = a y_(i-1) + (1 - k) u_i + (k - a) u_(i-1).
    """
    if pole_s <= 0:
        return values
    a = np.exp(-step_s / pole_s)
    k = pole_s * (1 - a) / step_s
    start = [(1 - (1 - k)) * values[0]]
    return lfilter([1 - k, k - a], [1.0, -a], values, zi=start)[0]


def played(way, half):
    """Return the output of backlash: it moves only where it is pushed; shapes (n, m) and (m,)."""
    out = np.empty_like(way)
    last = way[0]
    for k, pushed in enumerate(way):
        last = np.clip(last, pushed - half, pushed + half)
        out[k] = last
    return out


def stuck(way, band):
    """Return the output of stick: at rest until the error exceeds the band, then right behind.

    A joint comes to rest where its input reverses or stops.
    """
    out = np.empty_like(way)
    moves = np.zeros(way.shape[1], dtype=bool)
    last, before = way[0], np.zeros(way.shape[1])
    out[0] = last
    for k in range(1, len(way)):
        step = way[k] - way[k - 1]
        moves &= step * before > 0
        moves |= np.abs(way[k] - last) > band
        last = np.where(moves, way[k], last)
        before = step
        out[k] = last
    return out
