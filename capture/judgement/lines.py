"""What a joint moves besides its response: lines of the residual's spectrum.

Thomson's harmonic F test (Proc. IEEE 70, 1982, doi 10.1109/PROC.1982.12433, eq. 13.10) over sine
tapers (Riedel & Sidorenko, IEEE Trans. Signal Process. 43, 1995, doi 10.1109/78.365298): with the
transforms y_k(f) of the tapered residual and the tapers' sums h_k, the line's complex amplitude is

    a(f) = sum_k h_k y_k(f) / sum_k h_k^2,
    F(f) = (K - 1) |a|^2 sum_k h_k^2 / sum_k |y_k - a h_k|^2,

which without a line has Fisher's F distribution with 2 and 2K - 2 degrees of freedom; its tail is
(1 + F / (K - 1))^-(K - 1) in closed form. Bonferroni over the frequencies and joints. A line that
comes or goes, or is near another, is beside other noise; like joints tell what noise there is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, ComplexArray, FloatArray
from .exposure import Exposure
from .levels import (
    ANGLE_MARGIN_RAD,
    COVERAGE,
    FEWEST,
    FOLLOWS,
    HALF,
    LEVEL,
    NEGLIGIBLE,
    QUARTER,
    REST_ERRORS,
    TINY,
    WIDTH,
)
from .motion import Course, cycle_s

TAPERS = FEWEST
"""Sine tapers at most: 14 degrees of freedom of the noise, lines resolved to 8 cycles a record."""

FEWEST_TAPERS = 3
"""Sine tapers at least: two of them have a sum, and one is left for the noise."""

NEIGHBOURS = 2
"""How many times the line of like joints a line is, at least, to be a joint's own."""

HARMONICS = 10
"""Multiples of a gait's frequency at which friction moves a joint: as 1/n^2, to 1 % of the gait."""


@dataclass(frozen=True)
class SpectralLine:
    """A motion at one frequency that is no response to the command.

    Attributes:
        joint: Its index.
        frequency_hz: [Hz].
        amplitude_rad: [rad].
    """

    joint: int
    frequency_hz: float
    amplitude_rad: float


def find_lines(course: Course, exposure: Exposure, usable: BoolArray) -> list[SpectralLine]:
    """Find the largest line of each joint that like joints don't have.

    In the whole record, and else in either half: what comes or goes is no line of the whole.

    Args:
        usable: Steps that are looked at, shape (k, n); elsewhere the residual counts as zero.
    """
    begun = int(np.median(np.argmax(usable, axis=1)))
    end = usable.shape[1]
    middle = (begun + end) // 2
    lines: dict[int, SpectralLine] = {}
    for first, last in ((begun, end), (begun, middle), (middle, end)):
        if last - first >= FEWEST:
            for line in _lines(course, exposure, usable, slice(first, last)):
                lines.setdefault(line.joint, line)
    return [lines[k] for k in sorted(lines)]


def _lines(
    course: Course, exposure: Exposure, usable: BoolArray, part: slice
) -> list[SpectralLine]:
    """Return the largest line of each joint in a part of the record."""
    usable = usable[:, part]
    count, size = usable.shape
    # Between the frequencies of the record a line would lose up to a third of its amplitude.
    padded = 2 << size.bit_length()
    frequency = np.asarray(np.fft.rfftfreq(padded, course.step_s), dtype=np.float64)
    few = _tapers(course, size)
    slow = frequency <= (TAPERS + 1) / (size * course.step_s)
    tapers = np.where(slow, few, TAPERS)
    resolved = (tapers + 1) / (2 * size * course.step_s)
    residual = np.where(usable, (course.position - exposure.fitted)[:, part], 0.0)
    residual -= np.mean(residual, axis=1, keepdims=True)
    amplitude, error, tail = np.empty((1 + 2, count, frequency.size))
    for k in range(count):
        amplitude[k], error[k], tail[k] = _tested(residual[k], padded, TAPERS)
        if few < TAPERS:
            tested = _tested(residual[k], padded, few)
            for values, other in zip((amplitude, error, tail), tested, strict=True):
                values[k, slow] = other[slow]
    tests = 2 * count * course.t_s.size  # of the whole record and of its halves
    lines: list[SpectralLine] = []
    for k in range(count):
        others = [j for j in exposure.group(k) if j != k]
        common = np.zeros(frequency.size)
        if len(others) > 2:
            common = np.asarray(np.median(amplitude[others], axis=0), dtype=np.float64)
        least = _least_rad(frequency, course, exposure, k)
        # What no response fits is a share of what the joint moves at that frequency.
        moved = _moved(course, k, np.where(usable[k], exposure.fitted[k, part], 0.0), padded)
        sure = (tail[k] < LEVEL / tests) & (amplitude[k] > NEIGHBOURS * common)
        sure &= amplitude[k] > QUARTER * moved
        if len(others) > 2:  # they show how much noise there is at a frequency
            beside = _beside(amplitude[k], common, len(others)) < LEVEL / tests
            sure |= beside & (tail[k] < LEVEL) & (HALF * amplitude[k] > moved)
        sure &= _free(frequency, course, k, resolved, like=len(others) > 2)
        if not sure.any():
            continue
        best = int(np.argmax(np.where(sure, amplitude[k] / least, 0)))
        size_rad = float(amplitude[k, best])
        if size_rad < COVERAGE * least[best]:  # it may be there for a part of the record
            size_rad = _where_it_is(
                residual[k], float(frequency[best]) * course.step_s, tapers[best]
            )
        if size_rad + WIDTH * float(error[k, best]) > COVERAGE * least[best]:
            lines.append(SpectralLine(k, float(frequency[best]), size_rad))
    return lines


def _moved(course: Course, k: int, fitted: FloatArray, padded: int) -> FloatArray:
    """Return the amplitude of a response at each frequency; 0 of a rhythm, which has harmonics."""
    if np.isfinite(cycle_s(course.command[k], course.step_s)):
        return np.zeros(padded // 2 + 1)
    return _tested(fitted - fitted.mean(), padded, TAPERS)[0]


def vibrates(course: Course, exposure: Exposure, k: int) -> bool:
    """Return whether most of what a joint does besides its response is one line.

    It is at a frequency at which the joint's command doesn't move, and no drift or step.
    """
    residual = _power(course.position[k] - exposure.fitted[k])
    asked = _power(course.command[k])
    peak = int(np.argmax(residual))  # in cycles a record
    near = slice(max(peak - 2, 0), peak + 2 + 1)  # a line between two frequencies is in four
    own_share, asked_share = (
        float(power[near].sum()) / max(float(power.sum()), TINY) for power in (residual, asked)
    )
    return peak > REST_ERRORS and own_share > HALF and asked_share < NEGLIGIBLE


def _power(values: FloatArray) -> FloatArray:
    """Return the power of values about their mean at each whole number of cycles a record."""
    taper = np.sin(np.pi * (np.arange(values.size) + HALF) / values.size)
    return np.asarray(np.abs(np.fft.rfft(taper * (values - values.mean()))) ** 2, dtype=np.float64)


def _beside(amplitude: FloatArray, common: FloatArray, others: int) -> FloatArray:
    """Return the chance of an amplitude in noise as of some others, whose median is common.

    The square of one amplitude over the mean square of m others has Fisher's F distribution with 2
    and 2m degrees of freedom; the mean is the median over the logarithm of 2.
    """
    ratio = np.log(2.0) * amplitude**2 / np.maximum(common**2, TINY)
    return np.asarray((1 + ratio / others) ** -float(others), dtype=np.float64)


def _tapers(course: Course, size: int) -> int:
    """Return the number of tapers that tell half the motion's own frequency from a drift."""
    cycles = [size * course.step_s / cycle_s(command, course.step_s) for command in course.command]
    rhythms = [count for count in cycles if count > 0]
    most = int(np.ceil(np.median(rhythms) / 2)) - 2 if rhythms else TAPERS
    return min(max(most, FEWEST_TAPERS), TAPERS)


def _where_it_is(residual: FloatArray, cycles: float, tapers: int) -> float:
    """Return the amplitude of a line in the part of the record that has most of it.

    Args:
        cycles: Of the line a sample.
        tapers: As of the test, which resolves so many cycles of the record.
    """
    steps = np.arange(residual.size)
    turned = residual * np.exp(-2j * np.pi * cycles * steps)
    blocks = min(max(int(cycles * residual.size / tapers), 2), FEWEST)
    means = [2 * abs(np.mean(part)) for part in np.array_split(turned, blocks)]
    return float(np.quantile(means, FOLLOWS))


def _least_rad(frequency: FloatArray, course: Course, exposure: Exposure, k: int) -> FloatArray:
    """Return the amplitude of a line that matters, at each frequency [rad].

    Unless like joints share it, three rest errors up to the last harmonic of the motion's own
    frequency: there play and stick move a joint.
    """
    motion: FloatArray = exposure.fitted[k]
    motion = motion - motion.mean()
    rate = np.gradient(motion, course.step_s)
    slow = float(np.linalg.norm(rate)) / max(2 * np.pi * float(np.linalg.norm(motion)), TINY)
    rest = REST_ERRORS * exposure.rest_rad[k] if len(exposure.group(k)) == 1 else 0.0
    least = np.where(frequency <= HARMONICS * slow, rest, 0.0)
    return np.maximum(least, ANGLE_MARGIN_RAD)


def _free(
    frequency: FloatArray, course: Course, k: int, resolved: FloatArray, *, like: bool
) -> BoolArray:
    """Mark the frequencies that are neither drift nor, without like joints, the gait's.

    Stick and friction make motion at multiples of the gait's frequency, which like joints share.
    """
    # Three cycles where like joints show how much drift there is, or else four.
    free = frequency > (REST_ERRORS / 2 if like else 2) * resolved
    cycle = cycle_s(course.command[k], course.step_s)
    if np.isfinite(cycle) and not like:
        harmonic = np.round(frequency * cycle)
        free &= (np.abs(frequency - harmonic / cycle) > resolved) | (harmonic > HARMONICS)
    return np.asarray(free, dtype=np.bool_)


def _tested(
    residual: FloatArray, padded: int, tapers: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return amplitude of a line, its standard error, and chance of it without one.

    Each at all frequencies; |a|^2 / F estimates the variance of a part of a.
    """
    size = residual.size
    steps = np.arange(1, size + 1)
    power = np.zeros(padded // 2 + 1)
    weighted = np.zeros(padded // 2 + 1, dtype=np.complex128)
    sums = 0.0
    for k in range(1, tapers + 1):
        taper = np.sqrt(2 / (size + 1)) * np.sin(np.pi * k * steps / (size + 1))
        transformed: ComplexArray = np.fft.rfft(taper * residual, padded)
        total = float(taper.sum())
        weighted += total * transformed
        power += np.abs(transformed) ** 2
        sums += total**2
    projected = np.abs(weighted) ** 2 / sums
    left = np.maximum(power - projected, TINY)
    statistic = (tapers - 1) * projected / left
    tail = (1 + statistic / (tapers - 1)) ** -(tapers - 1)
    amplitude = 2 * np.abs(weighted) / sums
    error = amplitude / np.sqrt(np.maximum(statistic, TINY))
    return amplitude, error, np.asarray(tail, dtype=np.float64)
