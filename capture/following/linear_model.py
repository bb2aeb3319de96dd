"""A joint's own linear response to a command that is no rhythm, taken off before it is judged.

At one frequency a sound joint has one gain and one lag, and what departs from them is a fault. A
chirp, a multisine or noise has no such frequency: gain and lag of a sound joint change all the
time. There a finite impulse response is fitted,

    y(t) = sum_i h_i c(t - i D) + offset,

and its output stands in for the command: a sound joint follows that with gain 1 and without lag. A
joint that it doesn't explain is judged by its command as it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.arrays import FloatArray
from .motion import JointMotion, Samples, cycle_s

SWEPT = 2.0
"""Ratio of long to short cycles, as 90 % and 10 % quantiles, of a command that is no rhythm."""

CYCLES = 8  # of the command, that show it
TAPS = 40
MEMORY_S = 0.8  # that the taps span at least, and two thirds of a cycle
EXPLAINED = 0.8  # share of the position's variance that makes it the joint's response
_SLOWEST = 0.005  # share of the command's power that is slower
_OPPOSITE = 0.5  # cosine: within 60 degrees of half a turn
_ROWS = 20_000  # that the fit takes


def linearised(motion: JointMotion) -> JointMotion:
    """Return a joint whose command, if it is no rhythm, is replaced by its linear response.

    A response opposite to slow commands is turned round, so that the joint moves against it.
    """
    command, position = motion.command, motion.position
    if position.t_s.size < 4 * TAPS or _is_rhythm(command):
        return motion
    step = max(max(MEMORY_S, cycle_s(command) * 2 / 3) / TAPS, position.period_s)
    rows = slice(None, None, -(-position.t_s.size // _ROWS))
    late = [_late(command, position.t_s[rows], k, step) for k in range(TAPS)]
    design = np.stack([*late, np.ones(late[0].size)], axis=1)
    found = np.linalg.lstsq(design, position.values[rows], rcond=1e-9)[0]
    taps = np.asarray(found, dtype=np.float64)
    response = np.full(position.t_s.size, taps[-1])
    for k, tap in enumerate(taps[:-1].tolist()):  # one at a time: a long record fills the memory
        response += tap * _late(command, position.t_s, k, step)
    left = float(np.var(position.values - response))
    if left > (1 - EXPLAINED) * float(np.var(position.values)):
        return motion
    if _turned_round(command, taps[:-1], step):
        response = 2 * response.mean() - response
    return replace(motion, command=Samples(position.t_s, response))


def _turned_round(command: Samples, taps: FloatArray, step_s: float) -> bool:
    """Return whether the response is opposite where the command is slowest.

    At rest a sound joint has a positive gain, but a command without a mean doesn't show it.
    """
    values = command.values - command.values.mean()
    power: FloatArray = np.abs(np.fft.rfft(values * np.hanning(values.size))) ** 2
    slow = int(np.count_nonzero(np.cumsum(power) < _SLOWEST * float(power.sum())))
    turn = 2 * np.pi * slow / (command.t_s[-1] - command.t_s[0]) * step_s
    phase = turn * np.arange(taps.size)
    real, imaginary = float(taps @ np.cos(phase)), float(taps @ np.sin(phase))
    return real < -_OPPOSITE * float(np.hypot(real, imaginary))


def _late(command: Samples, t_s: FloatArray, k: int, step_s: float) -> FloatArray:
    """Return c(t - k D), shape (n,)."""
    return command.at(t_s - k * step_s)


def _is_rhythm(command: Samples) -> bool:
    """Return whether cycles, from one rise through the middle to the next, are alike or too few."""
    above = command.values > np.median(command.values)
    rises = command.t_s[1:][above[1:] & ~above[:-1]]
    if rises.size <= CYCLES:
        return True
    short, long = np.percentile(np.diff(rises), (10, 90))
    return bool(long <= SWEPT * short)
