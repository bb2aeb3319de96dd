"""Which joints have a dead band, how wide, and of which kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray

from ...estimators.series import Series, clean_together, shared_times
from ...response.fitting import GaitFit
from ...signals.columns import Columns
from ..artefacts.scales import resolution_of, runs
from .fit import FittedBand, fit_dead_bands
from .model import BOTTOM, DELAY, TOP, WIDTH, WholeCycles, whole_cycles
from .result import EITHER, PLAY, STICK, DeadBand, DeadBandEnd

_RAMP = 0.5
"""Change of the effort over a plateau that is a ramp, as a share of the effort in motion."""

_NONE = 0.2
"""Effort in a plateau that is none, as a share of the effort in motion."""

_ALONG = 0.5
"""Share of the command's travel that a second sensor goes along with, before the play."""

_WITNESSES = ("current", "effort", "reference")

_INNER = 0.6
"""Part of a plateau away from arrest and onset."""

_SURE = 3.0
_FEW = 3

MOST_CYCLES = 12
"""Cycles that are fitted, evenly spread over the stretch: an hour costs no more than a minute."""

RESOLVED = 4.0
"""A dead band of fewer steps of the encoder isn't claimed."""

_FOLLOWS = 0.1
"""Least gain of a joint that follows its command."""

_HINT = 0.15
"""Least width that a loop must hint at, as a share of ``RESOLVED`` steps, for a closer look."""

_CLEAR = 20.0
"""Gain in log likelihood, times two, over a joint without a dead band."""

_ODD = (1, 3, 5, 7)
"""Harmonics that hold seven tenths of what a square wave adds to its fundamental."""

_CREEP = 0.1
"""A joint at rest moves by less than this share of what its command would have it move by."""

_SETTLING = 0.25
"""Part of each plateau that is left out at its start: the joint may still arrive."""

_SHORTEST, _LONG = 3, 8
"""Samples that a plateau has at least, and so many that three parts of it are compared."""


@dataclass(frozen=True)
class Witness:
    """What else is recorded of a joint.

    Attributes:
        effort: Motor current, or else effort, or None.
        second: Positions by a second sensor, or None.
    """

    effort: Series | None
    quantity: str
    second: Series | None

    @classmethod
    def of(cls, columns: Columns, name: str, origin_ns: int) -> Witness:
        """Return a joint's motor current, or else its effort, which may be the gear's."""
        kinds = {key: columns.of(key) for key in _WITNESSES}
        joint_signals = {key: signals[name] for key, signals in kinds.items() if name in signals}
        series = clean_together(joint_signals, origin_ns)
        usable = (key for key in ("current", "effort") if key in series and series[key].count)
        quantity = next(usable, "")
        return cls(series.get(quantity), quantity, series.get("reference"))


def decide(cycles: WholeCycles, joint: int, band: FittedBand, witness: Witness) -> tuple[str, str]:
    """Tell stick from play, if the data do.

    A motor that dry friction holds pulls ever harder, from one direction to the other, while the
    command crosses the band; one that crosses a gear's play has nothing to pull.

    Returns:
        The kind, and what decides it.
    """
    fitted = slice(cycles.first, None)
    times, rests = cycles.t_s[:, fitted], band.rests[:, fitted]
    command = cycles.commanded(joint, float(band.parameters[DELAY]))[:, fitted]
    across = (command - band.follower[:, fitted]) / max(float(band.parameters[WIDTH]) / 2, 1e-12)
    if witness.second is not None:
        along = _slopes(command, witness.second.at(times.ravel()).reshape(times.shape), rests)
        if along.size >= _FEW and float(along.mean()) > _ALONG and _sure(along):
            return PLAY, "a second sensor goes along with the command meanwhile"
    if witness.effort is None:
        return EITHER, "no current and no effort is recorded"
    effort = witness.effort.at(times.ravel()).reshape(times.shape)
    moving = float(np.mean(np.abs(effort[~rests]))) if np.any(~rests) else 0.0
    if moving == 0:
        return EITHER, f"the {witness.quantity} is zero in motion"
    signed, unsigned = (_slopes(over, effort, rests) / moving for over in (across, np.abs(across)))
    ramps = _sure(signed) and 2 * abs(float(signed.mean())) > _RAMP
    rises = _sure(unsigned) and float(unsigned.mean()) > _RAMP and float(effort.min()) >= 0
    if ramps or rises:
        return STICK, f"the {witness.quantity} ramps while the joint rests"
    inner = rests & (np.abs(across) < _INNER)
    if np.count_nonzero(inner) >= _FEW and float(np.mean(np.abs(effort[inner]))) < _NONE * moving:
        return PLAY, f"the {witness.quantity} is near zero while the joint rests"
    return EITHER, f"the {witness.quantity} neither ramps clearly nor vanishes"


def _slopes(over: FloatArray, values: FloatArray, rests: BoolArray) -> FloatArray:
    """Slope of values over another quantity while the joint rests, a cycle each, shape (k,)."""
    slopes: list[float] = []
    for x, y, inside in zip(over, values, rests, strict=True):
        a, b = x[inside], y[inside]
        if a.size < _FEW or np.ptp(a) == 0:
            continue
        centred = a - a.mean()
        slopes.append(float(centred @ (b - b.mean()) / (centred @ centred)))
    return np.array(slopes or [0.0])


def _sure(values: FloatArray) -> bool:
    """Return whether a mean over cycles differs from zero."""
    if values.size < _FEW:
        return False
    error = float(values.std(ddof=1)) / values.size**0.5
    return abs(float(values.mean())) > _SURE * error


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
    follower = np.empty_like(command)
    if command.size == 0:
        return follower
    step = np.sign(np.diff(command))
    moving = np.flatnonzero(step)
    turn = moving[1:][step[moving[1:]] != step[moving[:-1]]]
    edges = np.concatenate(([0], turn, [command.size - 1]))  # first and last of each way
    state = float(command[0])
    follower[0] = state
    for i, j in pairwise(edges.tolist()):
        part = command[i + 1 : j + 1]
        if part.size == 0:
            continue
        if part[-1] >= command[i]:
            follower[i + 1 : j + 1] = np.where(part - state > half + bottom, part - half, state)
        else:
            follower[i + 1 : j + 1] = np.where(state - part > half + top, part + half, state)
        state = float(follower[j])
    return follower


def fundamental_change(
    t_s: FloatArray, command: FloatArray, followed: FloatArray, omega: float
) -> complex:
    """Return the ratio of two fundamentals, by least squares.

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


def dead_bands(
    columns: Columns,
    commands: Mapping[str, Series],
    responses: Mapping[str, Series],
    gait: GaitFit | None,
    origin_ns: int,
) -> dict[str, DeadBand]:
    """Measure the dead bands of a gait's joints.

    Args:
        columns: The session's columns, for efforts, currents and second sensors.
        commands: By joint name, on the analysed stretch.
        gait: The fitted gait, or None.
        origin_ns: Unix time of the series' origin [ns].

    Returns:
        By joint name; joints that rest at no reversal, or for less than can be resolved, have none.
    """
    if gait is None:
        return {}
    names = [name for name in gait.answered if name in commands and name in responses]
    measured = [responses[name] for name in names]
    bands: dict[str, DeadBand] = {}
    for group in shared_times(measured):
        members = [names[i] for i in group]
        both = [commands[name] for name in members], [responses[name] for name in members]
        cycles = whole_cycles(*both, gait.fit.omega, MOST_CYCLES)
        if cycles is not None:
            bands |= _of_group(members, cycles, gait.fit.omega, columns, origin_ns)
    return bands


def _of_group(
    names: Sequence[str], cycles: WholeCycles, omega: float, columns: Columns, origin_ns: int
) -> dict[str, DeadBand]:
    wave, ratio = _fundamentals(cycles, omega)
    amplitude, lag = np.abs(wave), -np.angle(ratio) % (2 * np.pi)
    resolution = np.array([resolution_of(angles) for angles in cycles.measured])
    linear = np.array([_without(cycles, j, float(lag[j]), omega) for j in range(len(names))])
    hinted = (
        (np.abs(ratio) > _FOLLOWS)
        & (amplitude * np.abs(ratio) > RESOLVED * resolution)
        & (linear[:, 1] > _HINT * RESOLVED * resolution)
        & (linear[:, 2] > 0.7 * _CLEAR)
    )
    chosen = np.flatnonzero(hinted)
    if chosen.size == 0:
        return {}
    some = tuple(cycles.commands[j] for j in chosen)
    part = WholeCycles(some, cycles.t_s, cycles.first, cycles.measured[chosen])
    fits = fit_dead_bands(part, omega, amplitude[chosen], lag[chosen], resolution[chosen])
    bands: dict[str, DeadBand] = {}
    for k, (j, fit) in enumerate(zip(chosen.tolist(), fits, strict=True)):
        least = RESOLVED * resolution[j] / abs(fit.gain) if fit.gain else np.inf
        clearer = fit.independent * np.log(linear[j, 0] / fit.cost)
        shown = fit.gain > 0 and clearer >= _CLEAR and not np.any(fit.travel[:, 0] < least)
        if not shown or np.any(fit.travel[:, 1] <= 0):
            continue
        rest_s = _rests(part, k, fit, float(resolution[j]))
        if rest_s is not None:
            kind = decide(part, k, fit, Witness.of(columns, names[j], origin_ns))
            bands[names[j]] = _result(
                fit, part.commands[k], rest_s, omega, kind=kind, count=len(part.t_s)
            )
    return bands


def _fundamentals(cycles: WholeCycles, omega: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the amplitudes of the commands, and of the positions over them."""
    back = np.exp(1j * omega * cycles.t_s[:, cycles.first :])
    waves: list[complex] = []
    ratios: list[complex] = []
    for j in range(len(cycles.measured)):
        measured: FloatArray = cycles.measured[j, :, cycles.first :]
        command = cycles.commanded(j)[:, cycles.first :]
        wave = complex(2 * np.vdot(back, command - np.mean(command)) / back.size)
        answer = complex(2 * np.vdot(back, measured - np.mean(measured)) / back.size)
        waves.append(wave)
        ratios.append(answer / wave if wave else 0j)
    return np.array(waves), np.array(ratios)


def _without(
    cycles: WholeCycles, joint: int, lag: float, omega: float
) -> tuple[float, float, float]:
    """Misfit without a dead band [rad^2], the width that the loop hints at [rad], what to gain.

    Position = offset + gain c + damping c' is exact for a linear joint and a sine; a dead band adds
    a square wave that changes sign with the joint. The gain in log likelihood, times two, is that
    of free odd harmonics: no dead band has more but for what lies above them.
    """
    times = cycles.t_s[:, cycles.first :].ravel()
    command = cycles.commands[joint]
    span_s = float(cycles.t_s[0, -1] - cycles.t_s[0, cycles.first])
    near_s = max(cycles.period_s, span_s / 200)

    def rate(t_s: FloatArray) -> FloatArray:
        return (command.at(t_s + near_s) - command.at(t_s - near_s)) / (2 * near_s)

    late_s = lag / (2 * np.pi) * span_s
    plain = np.column_stack((np.ones_like(times), command.at(times), rate(times)))
    square = np.sign(rate(times - late_s))
    measured = cycles.measured[joint, :, cycles.first :].ravel()
    alone = np.linalg.lstsq(plain, measured, rcond=None)[0]
    both = np.linalg.lstsq(np.column_stack((plain, square)), measured, rcond=None)[0]
    left = measured - plain @ alone
    angle = omega * np.outer(times, _ODD)
    waves = np.hstack((np.ones((times.size, 1)), np.cos(angle), np.sin(angle)))
    free = left - waves @ np.linalg.lstsq(waves, left, rcond=None)[0]
    cost, least = float(left @ left), float(free @ free)
    gain = times.size * float(np.log(cost / least)) if least > 0 else np.inf
    return cost, 2 * abs(float(both[-1])), gain


def _rests(
    cycles: WholeCycles, joint: int, fitted: FittedBand, resolution: float
) -> tuple[float, float] | None:
    """For how long the joint rests after top and bottom [s]; None unless it does at both."""
    begin = cycles.first // 2  # by then the model has its state
    command = cycles.commanded(joint, float(fitted.parameters[DELAY]))[:, begin:]
    middle = float(fitted.follower.mean())
    durations: tuple[list[float], list[float]] = ([], [])
    crept: tuple[list[float], list[float]] = ([], [])
    led: tuple[list[float], list[float]] = ([], [])
    for rests, z, c, seen in zip(
        fitted.rests[:, begin:],
        fitted.follower[:, begin:],
        command,
        cycles.measured[joint, :, begin:],
        strict=True,
    ):
        for i, k in zip(*runs(rests), strict=True):
            if i == 0 or k == rests.size or k - i < _SHORTEST:
                continue  # begins before the stretch or ends after it
            side = int(z[i] < middle)
            durations[side].append(float(k - i) * cycles.period_s)
            settled = slice(i + round(_SETTLING * (k - i)), k)
            parts = np.array_split(seen[settled], 3 if k - i >= _LONG else 2)
            means = [float(part.mean()) for part in parts]
            crept[side].append(max(means) - min(means))
            led[side].append(abs(fitted.gain) * float(np.ptp(c[settled])))
    for side in (0, 1):
        if not durations[side]:
            return None
        allowed = max(resolution, _CREEP * float(np.median(led[side])))
        if float(np.median(crept[side])) > allowed:
            return None
    return float(np.median(durations[0])), float(np.median(durations[1]))


def _result(
    fitted: FittedBand,
    command: Series,
    rest_s: tuple[float, float],
    omega: float,
    *,
    kind: tuple[str, str],
    count: int,
) -> DeadBand:
    width, top, bottom = fitted.parameters[[WIDTH, TOP, BOTTOM]].tolist()
    followed = rested(command.values, width, top, bottom)
    change = fundamental_change(command.t_s, command.values, followed, omega)
    sides = [
        DeadBandEnd(
            travel_rad=float(travel[0]),
            travel_ci95=(float(travel[1]), float(travel[2])),
            step_rad=fitted.gain * float(step[0]),
            step_ci95=(fitted.gain * float(step[1]), fitted.gain * float(step[2])),
            rest_s=lasts,
        )
        for travel, step, lasts in zip(fitted.travel, fitted.step, rest_s, strict=True)
    ]
    return DeadBand(
        kind=kind[0],
        evidence=kind[1],
        top=sides[0],
        bottom=sides[1],
        gain_change=abs(change),
        lag_change_rad=-float(np.angle(change)),
        cycles=count,
    )
