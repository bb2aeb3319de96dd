"""The judgement of a session's joints: who doesn't follow, who changed, and what else differs.

A joint is accused where it stands although it had to move, moves against its command or not with
it, in another scale, or by another joint's command; or where its record is incomplete. What an
explanation of healthy joints covers, a gain, a delay, a rest off the command, a change, is a
difference and no fault.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

import numpy as np

from ..common.arrays import BoolArray, FloatArray, merged_ranges
from ..common.process import in_threads
from .apart import find_apart
from .blocks import SHORTEST_S, Jump
from .bursts import find_bursts
from .changes import find_jumps
from .exposure import Exposure, agrees, exposure_of, median_response, responds
from .fault import ExtraMotion, Fault, Judgement, ResponseChange, RestsOff, Span
from .levels import (
    FEWEST,
    FOLLOWS,
    HALF,
    LARGEST_REST_RAD,
    LEAST_RANGE_RAD,
    QUARTER,
    REST_ERRORS,
    TINY,
    WHOLE,
    WIDTH,
)
from .lines import find_lines, vibrates
from .motion import Course, RecordedJoint, course_of, cycle_s, rises_of, runs_of
from .naming import ExplanationKind, Naming, NamingVerdict, in_words, permutation_of
from .record import record_faults
from .response import BLOCKS, LATEST_S, JointResponse, fit_response
from .rests import find_rests
from .standing import opposite_kinds, standing_kinds
from .stillness import Stillness, stillness_of, usable_steps

UNIT_SLACK = 2.0
"""Factor within which a gain of 180/pi is a matter of units: a weak servo's gain is in it."""

MOVING = frozenset({"swapped", "inverted", "inverted_sensor", "noisy_sensor"})
"""Kinds of a joint that moves, though not as commanded."""


def judge(motions: Sequence[RecordedJoint]) -> Judgement:
    """Judge the joints of a session.

    Args:
        motions: All joints that have a command, in chain order.
    """
    record = record_faults(motions)
    driven = [m for m in motions if m.command.range > LEAST_RANGE_RAD and _lasts(m)]
    course = course_of(driven)
    if course is None or _too_seldom(course):
        faults = [record[m.name] for m in motions if m.name in record]
        return Judgement(tuple(faults))
    samples = course.position.size

    def response_of(k: int) -> JointResponse:
        return fit_response(course.command[k], course.position[k], course.present[k], course.step_s)

    responses = in_threads(response_of, range(len(driven)), samples)
    exposure = exposure_of(course, driven, responses)
    stillness = stillness_of(course, exposure)
    names_clause = _late_or_opposite(course, exposure)
    faults = _faults(course, driven, exposure, stillness, ordered=not names_clause)
    if not names_clause:
        names_clause, swapped = _naming(course, driven, exposure, faults)
        faults |= swapped
    for name, fault in record.items():
        # Missing samples are no reason for anything else; a counter's turns and old values are.
        if name not in faults or fault.kinds != ("lost_samples",):
            faults[name] = fault
    usable = usable_steps(course, exposure, stillness)
    names = [motion.name for motion in driven]
    exposed: BoolArray = np.any(stillness.exposed, axis=1)
    usable[[name in faults for name in names]] = False
    least = np.minimum(exposure.least_rad, LARGEST_REST_RAD)
    asked: BoolArray = np.ptp(course.command, axis=1) > least
    jumps = find_jumps(course, exposure, usable & asked[:, None])
    for jump in [jump for jump in jumps if _ends(course, exposure, jump)]:
        like = [driven[j] for j in exposure.group(jump.joint)]
        faults[names[jump.joint]] = _ended(driven[jump.joint], jump, like)
        jumps.remove(jump)
    healthy = [name not in faults for name in names]
    usable[np.logical_not(healthy)] = False
    changed = {jump.joint for jump in jumps}
    for k, share in find_bursts(course, exposure, usable).items():
        if k not in changed:
            text = f"{100 * share:.2g} % of its samples are far from where it can be"
            faults[names[k]] = _whole(driven[k], ("noisy_sensor",), text)
    lines = find_lines(course, exposure, usable)
    moved = changed | {line.joint for line in lines}
    left_out = [not sound or k in moved for k, sound in enumerate(healthy)]
    return Judgement(
        faults=tuple(faults[m.name] for m in motions if m.name in faults),
        changes=tuple(_change(names, jump) for jump in jumps),
        extra=tuple(
            ExtraMotion(names[line.joint], line.frequency_hz, line.amplitude_rad) for line in lines
        ),
        rests=tuple(
            RestsOff(names[rest.joint], rest.offset_rad, rest.range_rad, rest.rests)
            for rest in find_rests(course, exposure, stillness)
            if healthy[rest.joint]
        ),
        apart=tuple(find_apart(course, exposure, names, left_out)),
        unexposed=tuple(
            (name, float(np.ptp(course.command[k])))
            for k, name in enumerate(names)
            if not exposed[k]
        ),
        judged=tuple(name for k, name in enumerate(names) if exposed[k]),
        naming=names_clause,
    )


def _too_seldom(course: Course) -> bool:
    """Return whether most commands are rhythms of too few samples to compare what lies between.

    A rhythm of N samples a cycle satisfies (c[i - 1] + c[i + 1]) / 2 = cos(2 pi / N) c[i].
    """
    command = course.command - np.median(course.command, axis=1, keepdims=True)
    now, middle = command[:, 1:-1], (command[:, 2:] + command[:, :-2]) / 2
    power = np.maximum(np.sum(now**2, axis=1), np.finfo(np.float64).tiny)
    cosine = np.sum(now * middle, axis=1) / power
    left, size = np.median(np.abs([middle - cosine[:, None] * now, now]), axis=2)
    seldom = (left < HALF * size) & (cosine < np.cos(2 * np.pi / FEWEST))
    return bool(2 * np.count_nonzero(seldom) > seldom.size)


def _lasts(motion: RecordedJoint) -> bool:
    """Return whether command and position overlap, with samples for the blocks of a fit."""
    command, position = motion.command.t_s, motion.position.t_s
    if min(command.size, position.size) < 2:
        return False
    start, stop = max(command[0], position[0]), min(command[-1], position[-1])
    if stop - start < SHORTEST_S:
        return False
    return bool(np.count_nonzero((position >= start) & (position <= stop)) >= BLOCKS)


def _late_or_opposite(course: Course, exposure: Exposure) -> str:
    """Say what can't be told of a rhythm that all joints answer late by half a cycle.

    A delay of up to twice :data:`.response.LATEST_S` that all joints have is one of the bus or its
    driver; empty where that explains less.
    """
    lags: list[float] = []
    for command, response in zip(course.command, exposure.responses, strict=True):
        half = cycle_s(command, course.step_s) / 2
        if response.gain < 0 and response.explained >= FOLLOWS:
            lags.append(half + response.lag_s)
    if len(lags) <= WHOLE * len(exposure.responses) or np.median(lags) > 2 * LATEST_S:
        return ""
    return f"all joints move against their commands, or lag by {np.median(lags):.2g} s"


def _faults(
    course: Course,
    driven: Sequence[RecordedJoint],
    exposure: Exposure,
    stillness: Stillness,
    *,
    ordered: bool,
) -> dict[str, Fault]:
    """Return the faults of joints that had to move, by name.

    Args:
        ordered: Whether it can be told if a joint moves against its command, or by another one.
    """
    faults: dict[str, Fault] = {}
    explained = np.array([response.explained for response in exposure.responses])
    common = _common_stands(stillness)
    for k, motion in enumerate(driven):
        response = exposure.responses[k]
        if not stillness.exposed[k].any():
            continue
        like = [driven[j] for j in exposure.group(k)]
        others = np.append(np.delete(explained, k), 0.0 if explained.size < 2 else explained.max())
        stands = _alone(stillness.stands[k], common)
        share = float(stands.sum()) / max(int(stillness.exposed[k].sum()), 1)
        if ordered and (leader := _leader(course, exposure, k)) is not None:
            text = f"carries out the command of {driven[leader].name}"
            faults[motion.name] = _whole(motion, ("swapped",), text)
        elif ordered and _is_opposite(course, exposure, k):
            kinds, why = opposite_kinds(motion)
            text = f"moves against its command, gain {response.gain:.2f}"
            faults[motion.name] = _whole(motion, kinds, f"{text}; {why}" if why else text)
        elif _gain_is(exposure, k, np.degrees(1.0)):
            text = "moves 180/pi times as far as commanded"
            faults[motion.name] = _whole(motion, ("scaled_sensor",), text)
        elif stands.any():
            spans = tuple(_trimmed(span, course, k, exposure) for span in _spans(stands, course))
            kinds, why = standing_kinds(motion, spans, like)
            if _gain_is(exposure, k, np.radians(1.0)):
                kinds = (*kinds, "scaled_sensor")
            again = len(spans) > 1 and share < WHOLE
            if again and not {"at_limit"} & {*kinds} and kinds != ("frozen_sensor",):
                kinds = ("intermittent", *kinds)
            text = _stood(spans, course, k, exposure)
            text = f"{text}; {why}" if why else text
            faults[motion.name] = _fault(motion, kinds, spans, share, text)
        elif _is_incoherent(course, exposure, k) and np.median(others) > FOLLOWS:
            text = f"its command explains {100 * response.explained:.0f} % of its motion"
            low, high = np.quantile(course.position[k], (1 - FOLLOWS, FOLLOWS))
            kinds, why = ("noisy_sensor", "dead"), ""
            if high - low < QUARTER * float(np.ptp(exposure.healthy[k])):
                whole = (float(course.t_s[0]), float(course.t_s[-1]))
                kinds, why = standing_kinds(motion, [whole], like)
            faults[motion.name] = _whole(motion, kinds, f"{text}; {why}" if why else text)
    return faults


def _naming(
    course: Course,
    driven: Sequence[RecordedJoint],
    exposure: Exposure,
    faults: Mapping[str, Fault],
) -> tuple[str, dict[str, Fault]]:
    """Ask whether a permutation of the names explains more, where a joint is unlike the others.

    A joint that stands is unlike them by itself.
    """
    moving = [
        response
        for motion, response in zip(driven, exposure.responses, strict=True)
        if motion.name not in faults or MOVING & {*faults[motion.name].kinds}
    ]
    sound = [response for response in moving if responds(response)]
    odd = len(sound) < len(moving) or not all(agrees(r, median_response(sound)) for r in sound)
    if len(driven) < 2 or not odd:
        return "", {}
    naming = permutation_of(course.command.T, course.position.T, course.step_s)
    names = [motion.name for motion in driven]
    if naming.verdict is NamingVerdict.EITHER:
        named = [
            alternative.delay_s
            for alternative in naming.alternatives
            if alternative.kind is ExplanationKind.AS_NAMED
        ]
        # Lags that servos have are no reason to doubt the names.
        usual = named and min(named) <= LATEST_S
        return "" if usual or _explain_more(exposure, naming) else in_words(naming, names), {}
    if naming.verdict is not NamingVerdict.PERMUTED or naming.permutation is None:
        return "", {}
    swapped = {
        names[k]: _whole(driven[k], ("swapped",), f"carries out the command of {names[j]}")
        for k, j in enumerate(naming.permutation)
        if k != j
    }
    return in_words(naming, names), swapped


def _explain_more(exposure: Exposure, naming: Naming) -> bool:
    """Return whether the joints' own responses explain all of what a permutation of most would.

    As with two kinds of servos, whose gains and lags differ; a few joints' own lags and other names
    for them can't be told apart.
    """
    for alternative in naming.alternatives:
        if alternative.kind is ExplanationKind.PERMUTED:
            moved = [k for k, j in enumerate(alternative.permutation) if k != j]
            responses = [exposure.responses[k] for k in moved]
            if len(moved) < WHOLE * len(alternative.permutation) or not all(
                map(responds, responses)
            ):
                return False
            if any(
                r.explained < alternative.explained[k]
                for k, r in zip(moved, responses, strict=True)
            ):
                return False
    return True


def _is_incoherent(course: Course, exposure: Exposure, k: int) -> bool:
    """Return whether a joint's motion, over times in which it has to respond, isn't its command's.

    Over such times a zero that moved is a single step.
    """
    if exposure.responses[k].explained >= HALF or vibrates(course, exposure, k):
        return False
    steps = max(1, int(exposure.settling_s[k] / course.step_s))
    moved, asked = (
        values[k, steps:] - values[k, :-steps] for values in (course.position, exposure.healthy)
    )
    limit = np.quantile(np.abs(moved), FOLLOWS)
    inside = np.abs(moved) <= max(float(limit), float(np.ptp(exposure.healthy[k])))
    power = float(np.std(moved[inside]) * np.std(asked[inside]))
    covariance = float(np.cov(moved[inside], asked[inside])[0, 1])
    return power == 0 or abs(covariance) < HALF * power


def _is_opposite(course: Course, exposure: Exposure, k: int) -> bool:
    """Return whether a joint moves against its command, by its own response and by a healthy one.

    Of a cycle or two, a fit alone can't tell a sign from a delay.
    """
    response = exposure.responses[k]
    if response.gain > -QUARTER or response.explained < HALF:
        return False
    if rises_of(course.command[k]).size > 2:
        return True
    position: FloatArray = course.position[k] - course.position[k].mean()
    healthy: FloatArray = exposure.healthy[k] - exposure.healthy[k].mean()
    return float(position @ healthy) < 0


def _leader(course: Course, exposure: Exposure, k: int) -> int | None:
    """Return the joint whose command explains the motion of another, as its own does not."""
    position: FloatArray = course.position[k]
    position = position - position.mean()
    healthy = exposure.healthy - np.mean(exposure.healthy, axis=1, keepdims=True)
    left: FloatArray = np.mean((position[None, :] - healthy) ** 2, axis=1)
    best = int(np.argmin(left))
    opposite = float(np.var(position + healthy[k]))
    rival = min(float(left[k]), opposite)
    if best == k or left[best] > (1 - FOLLOWS) * float(np.var(position)):
        return None
    if responds(exposure.responses[k]):  # a lag or a gain of its own explains as much
        rival = min(rival, float(np.var(course.position[k] - exposure.fitted[k])))
    if rival < exposure.least_rad[k] ** 2:  # what a healthy joint may lose
        return None
    return best if left[best] < QUARTER * rival else None


def _common_stands(stillness: Stillness) -> BoolArray:
    """Mark the steps at which most joints that have to move stand: no fault of one of them."""
    exposed, stands = stillness.exposed.sum(axis=0), stillness.stands.sum(axis=0)
    common = (2 * stands > exposed) & (stands > 2)
    # Throughout it is none: no joint follows.
    return common if common.sum() < WHOLE * np.count_nonzero(exposed) else np.zeros_like(common)


def _alone(stands: BoolArray, common: BoolArray) -> BoolArray:
    """Leave out the times at which a joint stands for most of which most joints do."""
    result = stands.copy()
    for first, last in runs_of(stands):
        if 2 * int(common[first:last].sum()) > last - first:
            result[first:last] = False
    return result


def _gain_is(exposure: Exposure, k: int, factor: float) -> bool:
    """Return whether a joint's gain is a factor between units, up to what a servo's gain may be."""
    response = exposure.responses[k]
    if response.explained < HALF or response.gain <= 0:
        return False
    return abs(float(np.log(response.gain / factor))) < np.log(UNIT_SLACK)


def _spans(marked: BoolArray, course: Course) -> tuple[Span, ...]:
    """Return the marked steps as time spans [s]; gaps of a few steps are closed."""
    start, step = float(course.t_s[0]), course.step_s
    spans = [(start + step * first, start + step * last) for first, last in runs_of(marked)]
    return tuple(merged_ranges(spans, BLOCKS * step))


def _trimmed(span: Span, course: Course, k: int, exposure: Exposure) -> Span:
    """Take off the ends of a span at which the joint is still on its way."""
    inside = np.flatnonzero((course.t_s >= span[0]) & (course.t_s < span[1]))
    position = course.position[k, inside]
    near = np.abs(position - np.median(position)) <= REST_ERRORS * exposure.rest_rad[k]
    if not near.any():
        return span
    there = course.t_s[inside[near]]
    return float(there[0]), float(there[-1]) + course.step_s


def _stood(spans: Sequence[Span], course: Course, k: int, exposure: Exposure) -> str:
    """Say how far a joint moved, and how far it had to, in the longest span."""
    start, stop = max(spans, key=lambda span: span[1] - span[0])
    inside = (course.t_s >= start) & (course.t_s < stop)
    moved = np.degrees(np.ptp(course.position[k, inside]))
    asked = np.degrees(np.ptp(exposure.healthy[k, inside]))
    size = f"{moved:.1f} of {asked:.1f} degrees in {stop - start:.1f} s"
    return f"stands still while its command moves, {size}"


def _whole(motion: RecordedJoint, kinds: tuple[str, ...], evidence: str) -> Fault:
    return Fault(motion.name, kinds, (), None, None, 1.0, evidence)


def _fault(
    motion: RecordedJoint, kinds: tuple[str, ...], spans: tuple[Span, ...], share: float, text: str
) -> Fault:
    """Build a fault; one that holds throughout has no times."""
    if share > WHOLE and len(spans) == 1:
        begin, end = float(motion.position.t_s[0]), float(motion.position.t_s[-1])
        near = (1 - WHOLE) * (end - begin) / BLOCKS
        since = spans[0][0] if spans[0][0] - begin > near else None
        until = spans[0][1] if end - spans[0][1] > near else None
        return Fault(motion.name, kinds, spans, since, until, min(share, 1.0), text)
    end = float(motion.position.t_s[-1])
    until = None if end - spans[-1][1] < motion.position.period_s * BLOCKS else spans[-1][1]
    return Fault(motion.name, kinds, spans, spans[0][0], until, min(share, 1.0), text)


def _ends(course: Course, exposure: Exposure, jump: Jump) -> bool:
    """Return whether a joint's motion nearly ends at a change, where a healthy one goes on.

    Its motion is what goes with the healthy one or with its rate; the rest is noise.
    """
    k, inside = jump.joint, (course.t_s > jump.first_s + jump.block_s) & (course.t_s < jump.last_s)
    if jump.quantity != "gain" or jump.change > QUARTER - 1 or not inside.any():
        return False
    healthy = exposure.healthy[k]
    asked = np.stack([healthy, np.gradient(healthy, course.step_s)])[:, inside]
    design: FloatArray = (asked - asked.mean(axis=1, keepdims=True)).T
    factors = np.asarray(np.linalg.lstsq(design, course.position[k, inside])[0], dtype=np.float64)
    return bool(np.std(design @ factors) < QUARTER * np.std(healthy[inside]))


def _ended(motion: RecordedJoint, jump: Jump, like: Sequence[RecordedJoint]) -> Fault:
    """Return the fault of a joint whose motion nearly ends at a time."""
    end = float(motion.position.t_s[-1])
    span = jump.first_s, min(jump.last_s, end)
    kinds, why = standing_kinds(motion, [span], like)
    text = f"moves {100 * -jump.change:.0f} % less than before"
    until = jump.last_s if isfinite(jump.last_s) else None
    share = (span[1] - span[0]) / max(end - float(motion.position.t_s[0]), TINY)
    evidence = f"{text}; {why}" if why else text
    return Fault(motion.name, kinds, (span,), span[0], until, min(share, 1.0), evidence)


def _change(names: Sequence[str], jump: Jump) -> ResponseChange:
    size = float(np.exp(jump.change)) if jump.quantity == "noise" else jump.change
    until = jump.last_s if isfinite(jump.last_s) else None
    onset = jump.first_s - jump.block_s, jump.first_s + jump.block_s
    half_width = WIDTH * jump.error
    return ResponseChange(
        names[jump.joint], jump.quantity, size, half_width, jump.first_s, until, onset
    )
