"""Does a joint follow its command in the time in which it is accused? A check from outside.

The position is fitted by position = a command(t - d) + b in the accused time, widened by 1 s on
each side, for every delay d of a grid from 0 to 0.3 s and to less than a quarter of the command's
period; a and b are least squares. Nothing of undulog takes part.
"""

from dataclasses import dataclass

import numpy as np

WIDER_S = 1.0
"""Time on each side of the accused time that takes part, so that a short one has motion [s]."""

LONGEST_S = 0.3
"""Longest delay of a servo and its bus that is no fault [s]."""

PERIODS = 0.25
"""Periods that a delay stays below: a quarter of one is the lag of another kind of motion."""

EXPLAINED = 0.95
"""Explained share of the variance, r^2, from which a joint follows."""

GAINS = (0.6, 1.4)
"""Gains with which it follows; outside of them it is weak, whatever r^2 is."""

LEAST_RAD = np.radians(3.0)
"""Range of a command below which there is nothing to follow [rad]: the rest error that is taken
for a robot without a description."""

SHORT_S = 0.5
"""A shorter accused time is a small part of the widened one, and r^2 says little of it [s]."""

RESIDUAL = 3.0
"""Residual inside of a short time over that outside from which the accusation stands."""

DELAYS = 61
"""Delays of the grid, 5 ms apart at most: at 3 Hz and 60 degrees that is 5 degrees of phase, which
costs 0.8 % of r^2."""


@dataclass(frozen=True)
class Fit:
    """A joint's response in some time.

    Attributes:
        gain: a.
        delay_s: d [s].
        offset: b [rad].
        explained: r^2, at most 1; 0 where the position is constant.
        command_range: Largest less smallest command [rad].
        refutes: Whether it refutes an accusation in that time.
        residual: Position less fit [rad], shape (n,) of the widened time.
    """

    gain: float
    delay_s: float
    offset: float
    explained: float
    command_range: float
    refutes: bool
    residual: np.ndarray


def independent_fit(t_s, command, position, span_s):
    """Fit the response of one joint in an accused time.

    Args:
        t_s: Times [s], increasing, shape (n,).
        command: [rad], shape (n,).
        position: [rad], shape (n,).
        span_s: Start and end of the accused time [s]; None for the ends of the record.

    Returns:
        The fit of the best delay.
    """
    start, stop = (
        edge if bound is None else bound
        for bound, edge in zip(span_s, (t_s[0], t_s[-1]), strict=True)
    )
    wide = (t_s >= start - WIDER_S) & (t_s <= stop + WIDER_S)
    inside = (t_s[wide] >= start) & (t_s[wide] <= stop)
    longest = min(LONGEST_S, PERIODS * period_of(t_s[wide], command[wide]))
    delays = np.linspace(0.0, longest, DELAYS, endpoint=longest >= LONGEST_S)
    best = min((_fitted(t_s, command, position, wide, d) for d in delays), key=lambda fit: fit[0])
    _, gain, offset, delay_s, residual = best
    power = float(np.sum((position[wide] - position[wide].mean()) ** 2))
    explained = 1 - float(residual @ residual) / power if power > 0 else 0.0
    reach = float(np.ptp(command[wide]))
    refutes = reach < LEAST_RAD or (explained >= EXPLAINED and GAINS[0] <= gain <= GAINS[1])
    if stop - start < SHORT_S:
        refutes &= _quiet(residual, inside)
    return Fit(gain, delay_s, offset, explained, reach, bool(refutes), residual)


def _fitted(t_s, command, position, wide, delay_s):
    """Return squared error, gain, offset, delay and residual of the fit with one delay."""
    late = np.interp(t_s[wide] - delay_s, t_s, command)
    measured = position[wide]
    asked = late - late.mean()
    power = float(asked @ asked)
    gain = float(asked @ measured) / power if power > 0 else 0.0
    offset = float(measured.mean() - gain * late.mean())
    residual = measured - gain * late - offset
    return float(residual @ residual), gain, offset, float(delay_s), residual


def _quiet(residual, inside):
    """Whether the residual inside is below three times that outside."""
    if not inside.any() or inside.all():
        return True
    inner, outer = (float(np.mean(residual[part] ** 2)) for part in (inside, ~inside))
    return inner < RESIDUAL**2 * outer


def period_of(t_s, command):
    """Return the period of the strongest line of a command [s]; infinite if it is constant."""
    values = command - command.mean()
    if t_s.size < 4 or not values.any():
        return np.inf
    even_s = np.linspace(t_s[0], t_s[-1], t_s.size)
    power = np.abs(np.fft.rfft(np.interp(even_s, t_s, values) * np.hanning(t_s.size))) ** 2
    line = 1 + int(np.argmax(power[1:]))
    return float(t_s[-1] - t_s[0]) / line
