"""The dead band alone, without delay and lag, on a recorded command."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from undulog.capture.common.arrays import FloatArray


def rested(command: FloatArray, width: float, top: float, bottom: float) -> FloatArray:
    """What follows a command through a dead band, however slowly.

    Args:
        command: [rad], shape (n,).
        width: w, of the loop [rad].
        top: b_top, by which it catches up after the top [rad].
        bottom: b_bottom [rad].

    Returns:
        z [rad], shape (n,); with top = bottom = 0 the play operator of width w.
    """
    half = width / 2
    found = np.empty_like(command)
    if command.size == 0:
        return found
    step = np.sign(np.diff(command))
    moving = np.flatnonzero(step)
    turn = moving[1:][step[moving[1:]] != step[moving[:-1]]]
    edges = np.concatenate(([0], turn, [command.size - 1]))  # first and last of each way
    state = float(command[0])
    found[0] = state
    for i, j in pairwise(edges.tolist()):
        part = command[i + 1 : j + 1]
        if part.size == 0:
            continue
        if part[-1] >= command[i]:
            found[i + 1 : j + 1] = np.where(part - state > half + bottom, part - half, state)
        else:
            found[i + 1 : j + 1] = np.where(state - part > half + top, part + half, state)
        state = float(found[j])
    return found


def fundamental_change(
    t_s: FloatArray, command: FloatArray, followed: FloatArray, omega: float
) -> complex:
    """Ratio of two fundamentals, by least squares.

    Args:
        t_s: Times [s], shape (n,).
        command: [rad], shape (n,).
        followed: [rad], shape (n,).
        omega: [rad/s].

    Returns:
        followed over command: its size is a gain, its angle minus a lag.
    """
    turn = omega * t_s
    basis = np.column_stack((np.ones_like(turn), np.cos(turn), np.sin(turn)))
    both = np.linalg.lstsq(basis, np.column_stack((command, followed)), rcond=None)[0]
    waves = both[1] - 1j * both[2]
    return complex(waves[1] / waves[0]) if waves[0] != 0 else complex("nan")
