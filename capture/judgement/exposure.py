"""Where a joint had to move: only there can it fail to follow.

A joint has to move in a time window if a healthy one like it would move there by more than three
times the rest error, after its delay and settling. Neither comes from the judged joint alone: the
healthy response is the median over the joints like it, or without such the command, by less where
most others give less, and the rest error (dead band, sag, encoder step, noise) is the median of
what the responses of the like joints leave, or without such of all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from .levels import (
    COVERAGE,
    ENOUGH_LIKE,
    HALF,
    LARGEST_REST_RAD,
    QUARTER,
    REST_ERRORS,
    WHOLE,
)
from .motion import Course, RecordedJoint, cycle_s
from .response import SETTLED, Filtered, JointResponse

LIKE_LAG_S = 0.05
"""Difference in lag up to which joints may be of one kind [s]: two control periods of a slow bus
(40 Hz)."""


@dataclass(frozen=True)
class Exposure:
    """What healthy joints like these k joints would do on n steps.

    Attributes:
        healthy: Position of a healthy joint [rad], shape (k, n).
        fitted: By its response of its own [rad], shape (k, n).
        responses: Of the joints, k.
        like: Group of joints like it, shape (k,); joints of no group have numbers of their own.
        rest_rad: Rest error [rad], shape (k,).
        least_rad: Motion that has to be asked for to judge a joint [rad], shape (k,): three rest
            errors, and what a healthy joint may lose besides what its own response leaves; where
            there are like joints, half of its command and six rest errors of two thirds of them.
        settling_s: Delay and settling of healthy joints [s], shape (k,).
    """

    healthy: FloatArray
    fitted: FloatArray
    responses: tuple[JointResponse, ...]
    like: tuple[int, ...]
    rest_rad: FloatArray
    least_rad: FloatArray
    settling_s: FloatArray

    def group(self, joint: int) -> list[int]:
        """Return the joints like one, itself included."""
        return [k for k, number in enumerate(self.like) if number == self.like[joint]]


def exposure_of(
    course: Course, motions: Sequence[RecordedJoint], responses: Sequence[JointResponse]
) -> Exposure:
    """Compute where joints had to move.

    Args:
        course: Of k joints.
        motions: The same joints.
        responses: The same joints' fitted responses.
    """
    filtered = [Filtered(command[None, :], course.step_s) for command in course.command]
    like = _like(motions, responses)
    residual = np.empty_like(course.position)
    fitted = np.empty_like(course.position)
    healthy = np.empty_like(course.position)
    lost = np.zeros(len(motions))
    settling = np.zeros(len(motions))
    for k, response in enumerate(responses):
        fitted[k] = response.offset_rad + response.gain * filtered[k].output(response)[0]
        residual[k] = course.position[k] - fitted[k]
        lost[k] = _lost_motion(residual[k][course.present[k]])
    rest = np.empty(len(motions))
    of_like = np.full(len(motions), np.inf)  # what like joints show to be enough
    for k, response in enumerate(responses):
        group = [j for j, number in enumerate(like) if number == like[k]]
        sound = [responses[j] for j in group if responds(responses[j])]
        others = [j for j in range(len(motions)) if j != k]
        if len(group) >= ENOUGH_LIKE and sound:
            common = median_response(sound)
        else:
            common = JointResponse(_usual_gain([responses[j] for j in others]))
        offset = response.offset_rad
        healthy[k] = offset + common.gain * filtered[k].output(common)[0]
        pool = group if len(group) >= ENOUGH_LIKE else others
        pooled = float(np.median(lost[pool])) if pool else LARGEST_REST_RAD
        rest[k] = min(pooled, LARGEST_REST_RAD)
        if len(group) >= ENOUGH_LIKE:
            usual = float(np.quantile(lost[group], WHOLE))
            of_like[k] = max(2 * REST_ERRORS * usual, HALF * float(np.ptp(course.command[k])))
        responding = sound or [r for r in responses if responds(r)]
        settling[k] = (
            np.median([r.delay_s + SETTLED * r.constant_s for r in responding])
            if responding
            else _half_cycle_s(course.command[k], course.step_s)  # all may be as late as that
        )
    limited = np.minimum(lost, LARGEST_REST_RAD)
    least = np.minimum(np.maximum(REST_ERRORS * rest, LARGEST_REST_RAD + limited), of_like)
    settling += course.step_s
    return Exposure(healthy, fitted, tuple(responses), like, rest, least, settling)


def _half_cycle_s(command: FloatArray, step_s: float) -> float:
    """Return half of the cycle of a command [s]; 0 where it is no rhythm."""
    cycle = cycle_s(command, step_s)
    return cycle / 2 if np.isfinite(cycle) else 0.0


def _usual_gain(others: Sequence[JointResponse]) -> float:
    """Return the gain to ask of a joint without like joints: 1, or less where most give less.

    The joints of a body too heavy for its motors follow by less, and none of them is at fault.
    """
    gains = [response.gain for response in others if response.explained >= HALF]
    if len(gains) < ENOUGH_LIKE - 1:
        return 1.0
    return min(1.0, max(float(np.median(gains)), QUARTER))


def responds(response: JointResponse) -> bool:
    """Return whether a joint responds to its command, the right way round."""
    return response.gain >= QUARTER and response.explained >= HALF


def _like(motions: Sequence[RecordedJoint], responses: Sequence[JointResponse]) -> tuple[int, ...]:
    """Number the groups of joints that are like by their description, or else by most of them."""
    kinds = [motion.kind for motion in motions]
    if all(kind is not None for kind in kinds):
        names = list(dict.fromkeys(kinds))
        return tuple(names.index(kind) for kind in kinds)
    sound = [response for response in responses if responds(response)]
    if len(sound) < ENOUGH_LIKE or len(sound) < WHOLE * len(responses):
        return tuple(range(len(motions)))
    common = median_response(sound)
    agree = [agrees(response, common) for response in responses]
    if sum(agree) < max(ENOUGH_LIKE, WHOLE * len(responses)):
        return tuple(range(len(motions)))
    return (0,) * len(motions)


def agrees(response: JointResponse, common: JointResponse) -> bool:
    """Return whether a response is a common one, up to a profile along the body."""
    return abs(response.gain / common.gain - 1) < QUARTER and (
        abs(response.lag_s - common.lag_s) < max(QUARTER * common.lag_s, LIKE_LAG_S)
    )


def median_response(responses: Sequence[JointResponse]) -> JointResponse:
    """Return the response of the joint of median lag, with the median gain."""
    lags = np.array([response.lag_s for response in responses])
    middle = responses[int(np.argsort(lags)[(lags.size - 1) // 2])]
    gain = float(np.median([response.gain for response in responses]))
    return JointResponse(gain, 0.0, middle.delay_s, middle.constant_s, middle.order, middle.damping)


def _lost_motion(residual: FloatArray) -> float:
    """Return half the width that holds 95 % of a residual: two standard deviations of noise."""
    if residual.size == 0:
        return 0.0
    low, high = np.quantile(residual, ((1 - COVERAGE) / 2, (1 + COVERAGE) / 2))
    return float(high - low) / 2


def window_ranges(values: FloatArray, lengths: Sequence[int]) -> list[FloatArray]:
    """Return the range of values in all windows of some lengths, each by doubling.

    Args:
        values: Shape (n,).
        lengths: Samples of a window, 1 to n each, increasing.

    Returns:
        For each length m: largest minus smallest value from each start, shape (n - m + 1,).
    """
    high, low, width = values, values, 1
    ranges: list[FloatArray] = []
    for length in lengths:
        while 2 * width <= length:
            high = np.maximum(high[:-width], high[width:])
            low = np.minimum(low[:-width], low[width:])
            width *= 2
        rest = length - width
        top = np.maximum(high[: high.size - rest], high[rest:]) if rest else high
        bottom = np.minimum(low[: low.size - rest], low[rest:]) if rest else low
        ranges.append(top - bottom)
    return ranges


def covered(starts: BoolArray, length: int, size: int) -> BoolArray:
    """Mark the samples of all windows that begin at marked starts, shape (size,)."""
    change = np.zeros(size + 1, dtype=np.int64)
    index = np.flatnonzero(starts)
    np.add.at(change, index, 1)
    np.add.at(change, np.minimum(index + length, size), -1)
    return np.asarray(np.cumsum(change)[:-1] > 0, dtype=np.bool_)
