"""Times at which a joint leaves its own usual response, and what it does meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from .fault import Span, Symptom
from .motion import (
    BLOCKS,
    JointMotion,
    Response,
    median_of,
    predicted,
    robust_deviation,
    runs_of,
)

FAR = 6.0  # robust standard deviations of the residual that make an excursion
FAR_SHARE = 0.2  # an excursion is also farther than this share of the usual amplitude
FEW = 4  # samples that an excursion has at least
SHORT = 0.04  # share of a cycle that an excursion lasts at least
JOIN = 0.3  # excursions closer than this share of a cycle are one: a residual passes through zero
HELD_WINDOWS = 2  # windows in turn in which a joint that is held stands still
# Cycles in which a joint may stand at the beginning of a record: it is being started.
STARTING = 2.0
LOADED_WINDOWS = 2 * BLOCKS + 1  # the same where its neighbours are held back, too
HELD = 0.25  # a joint that moves less than this share of what it should stands still
NOISY = 0.6
"""Von Neumann ratio above which a residual is noise, not motion: 1 for white noise
(von Neumann, Ann. Math. Stat. 12, 1941; halved, so that it is 1 minus the autocorrelation)."""

# A residual whose standard deviation is below this share of its mean is a shifted zero.
STEPPED = 0.35
SETTLING = 1.5  # cycles from the start in which a departure is a transient
MIN_DEPARTURES = 3  # short departures that make a fault
GROWN = 0.8  # share of the command's later size below which it still grows
AT_TIMES = 0.03  # share of the record that they last together: less is what collisions do
DRIFT_SHARE = 0.15  # drift of the offset, as a share of the amplitude, that is no fault
DRIFT_RAD = float(np.radians(1.0))
DRIFT_EXPLAINED = 0.6
FEWEST = 12  # windows that a drift needs
AS_USUAL = 0.97  # share of the usual explained share above which a window follows as usual
MANY = 4 * BLOCKS  # windows of a departure that is a state of its own, with a beginning and an end
TRANSITION = 0.3  # share of its windows in which it begins or ends


@dataclass(frozen=True)
class Excursions:
    """Departures of one joint from its usual response.

    Attributes:
        t_s: Sampling times [s], shape (n,).
        residual: Position less what the usual response gives [rad], shape (n,).
        expected: What the usual response gives [rad], shape (n,).
        amplitude: Usual amplitude of the response [rad].
        record_s: Start and end of what was searched [s].
    """

    t_s: FloatArray
    residual: FloatArray
    expected: FloatArray
    amplitude: float
    spans_s: tuple[Span, ...]
    record_s: Span


def find_holds(
    motion: JointMotion, response: Response, still: BoolArray, *, loaded: bool
) -> list[Symptom]:
    """Find the times at which a joint stands still for a cycle or more.

    Args:
        still: Windows in which it stands still, shape (w,).
        loaded: Whether its neighbours are held back by a load: then it may be, for a while.

    Returns:
        The symptom with its spans, from the first to the last sample at the level of each hold;
        none if it never stands still in two windows in turn.
    """
    position = motion.position
    spans: list[Span] = []
    levels: list[float] = []
    for first, stop in runs_of(still):
        if stop - first < (LOADED_WINDOWS if loaded else HELD_WINDOWS):
            continue
        i, j = np.searchsorted(
            position.t_s, (response.start_s[first], response.stop_s[stop - 1])
        ).tolist()
        # The windows at the ends of a run may hold a part of the motion.
        quarter = (j - i) // 4
        core = position.values[i + quarter : j - quarter]
        level = float(np.median(core))
        moved = response.asked[first:stop].max() * 2**0.5
        slack = max(4 * robust_deviation(core, level), 0.1 * float(moved))
        away = np.abs(position.values - level) > slack
        before, after = np.flatnonzero(away[: i + quarter]), np.flatnonzero(away[j - quarter :])
        start = int(before[-1]) + 1 if before.size else 0
        end = j - quarter + int(after[0]) - 1 if after.size else position.t_s.size - 1
        since, until, origin = position.t_s[[start, end, 0]].tolist()
        begun = since - origin < response.period_s / 4
        if begun and until - origin < STARTING * response.period_s:
            continue
        spans.append((since, until))
        levels.append(level)
    if not spans:
        return []
    text = f"position constant at {np.degrees(levels[0]):.1f} degrees"
    return [Symptom("held", tuple(dict.fromkeys(spans)), text)]


def find_excursions(
    motion: JointMotion, response: Response, follows: BoolArray, ratio: complex, offset: float
) -> Excursions:
    """Find the times at which a joint leaves its usual response.

    Args:
        follows: Windows that follow the command, shape (w,).
        ratio: Its usual H.
        offset: Its usual offset [rad].

    Returns:
        The departures: longer than ``SHORT`` of a cycle, beyond ``FAR`` robust standard
        deviations of the residual and beyond ``FAR_SHARE`` of the amplitude.
    """
    period_s = response.period_s
    begin = max(motion.command.t_s[0] + period_s / 4, motion.position.t_s[0])
    end = min(motion.command.t_s[-1], motion.position.t_s[-1])
    i, j = np.searchsorted(motion.position.t_s, (begin, end), side="left")
    t_s, values = motion.position.t_s[i:j], motion.position.values[i:j]
    expected = predicted(motion, period_s, ratio, offset, t_s)
    residual = values - expected
    record = (float(t_s[0]), float(t_s[-1])) if t_s.size else (0.0, 0.0)
    if t_s.size < 2 * FEW:
        return Excursions(t_s, residual, expected, 0.0, (), record)
    centre = float(np.median(residual))
    amplitude = abs(ratio) * float(np.median(response.asked[follows])) * 2**0.5
    threshold = max(FAR * robust_deviation(residual, centre), FAR_SHARE * amplitude)
    far = np.abs(residual - centre) > threshold
    spans = _joined(t_s, far, JOIN * period_s)
    step = motion.position.period_s
    long = tuple(
        (a, b)
        for a, b in spans
        if b - a + step >= max(SHORT * period_s, (FEW - 1) * step)
        and np.count_nonzero(far[slice(*np.searchsorted(t_s, (a, b + step / 2)))]) >= FEW
    )
    return Excursions(t_s, residual - centre, expected + centre, amplitude, long, record)


def departures(
    response: Response, found: Excursions, alone: Sequence[bool], *, loaded: bool
) -> list[Symptom]:
    """Describe what a joint does in each of its departures.

    Args:
        response: The joint's windowed response.
        alone: Of each, whether no other joint departs at the same time.
        loaded: Whether its neighbours are held back by a load: then it may be, for a while.
    """
    begin, end = found.record_s
    settled = begin + SETTLING * response.period_s
    by_kind: dict[str, list[Span]] = {}
    texts: dict[str, str] = {}
    for span, own in zip(found.spans_s, alone, strict=True):
        kind, text = _described(found, span, end, response.period_s)
        start, stop = span
        excused = (
            # something that happened to the body
            (kind in ("astray", "opposite") and not own)
            # the start of the motion
            or (kind in ("astray", "opposite", "held") and stop < settled)
            # it follows there, with another gain or lag
            or (kind in ("astray", "noisy") and _coherent(response, span))
            or (kind == "held" and loaded)
            # the last part of a cycle: too little to know a zero by
            or (kind == "stepped" and stop - start < response.period_s / 2)
            or (kind == "stepped" and _grows(response, start))
        )
        if excused:
            continue
        if kind == "stepped" and start < settled < stop:
            # The usual zero is that of the longer part: the step is where this part ends.
            start, stop, text = stop, end, text.replace("off by", "was off by")
        by_kind.setdefault(kind, []).append((start, stop))
        texts.setdefault(kind, text)
    if "astray" in by_kind and not _lasting(by_kind["astray"], response.period_s, end - begin):
        del by_kind["astray"]
    symptoms = [Symptom(kind, tuple(own), texts[kind]) for kind, own in by_kind.items()]
    return symptoms if found.spans_s else symptoms + _drift(response, found)


def _coherent(response: Response, span: Span) -> bool:
    """Return whether the windows around a departure follow the command as closely as usual."""
    near = (response.start_s < span[1]) & (response.stop_s > span[0]) & response.valid
    if not near.any():
        return False
    usual = float(np.median(response.explained[response.valid]))
    # Where it changes from the one to the other, a cycle of either side is in the windows.
    passing = TRANSITION if np.count_nonzero(near) >= MANY else 0.0
    return float(np.quantile(response.explained[near], passing)) > AS_USUAL * usual


def _grows(response: Response, at_s: float) -> bool:
    """Return whether the command is larger after a time than before, as may be a limit's load."""
    before = response.asked[response.stop_s <= at_s + response.period_s / 2]
    after = response.asked[response.start_s >= at_s]
    return median_of(before) < GROWN * median_of(after)  # false where there is none


def _lasting(spans: Sequence[Span], period_s: float, length_s: float) -> bool:
    """Return whether departures repeat, or one of them lasts a cycle."""
    together = sum(stop - start for start, stop in spans)
    often = len(spans) >= MIN_DEPARTURES and together > AT_TIMES * length_s
    return often or any(stop - start > period_s for start, stop in spans)


def _described(found: Excursions, span: Span, end: float, period_s: float) -> tuple[str, str]:
    """Return the kind of symptom of one departure, and its size in words."""
    i, j = np.searchsorted(found.t_s, span, side="left")
    j = min(j + 1, found.t_s.size)
    residual, expected = found.residual[i:j], found.expected[i:j]
    position = residual + expected
    swing = float(np.ptp(expected))
    moved = float(np.percentile(position, 95) - np.percentile(position, 5))
    steps = np.diff(residual)
    variance = float(np.var(residual))
    rough = float(np.mean(steps**2)) / (2 * variance) if variance > 0 else 0.0
    mean, spread = float(np.mean(residual)), variance**0.5
    long = span[1] - span[0] > period_s or end - span[1] < period_s / 4
    if long and spread < STEPPED * abs(mean):
        turns = mean / (2 * np.pi)
        if abs(turns) > 0.5 and abs(turns - round(turns)) < 0.05:
            return "wrapped", f"off by {round(turns)} turns"
        return "stepped", f"off by {np.degrees(mean):+.1f} degrees"
    if rough > NOISY and residual.size >= 2 * FEW and spread > abs(mean):
        return "noisy", f"residual of {np.degrees(spread):.2g} degrees"
    if swing > 0.5 * found.amplitude and moved < HELD * swing:
        return "held", f"position constant at {np.degrees(float(np.median(position))):.1f} degrees"
    against = float(residual @ expected) < 0 and moved > 0.5 * swing and position.size > 2
    if against and np.corrcoef(position, expected)[0, 1] < -0.7:
        return "opposite", "moves against its command"
    return "astray", f"off by up to {np.degrees(np.abs(residual).max()):.1f} degrees"


def _drift(response: Response, found: Excursions) -> list[Symptom]:
    """Find a zero that moves over the record: by a step, or steadily."""
    valid = response.valid & (response.explained > 0.5)
    if np.count_nonzero(valid) < FEWEST:
        return []
    t_s, offset = (response.start_s + response.stop_s)[valid] / 2, response.offset[valid]
    spread = offset - offset.mean()
    power = float(spread @ spread)
    least = max(DRIFT_SHARE * found.amplitude, DRIFT_RAD)
    count = np.arange(1, offset.size)
    before = np.cumsum(spread)[:-1] / count
    after = -np.cumsum(spread)[:-1] / (offset.size - count)
    by_step = count * before**2 + (offset.size - count) * after**2
    split = int(np.argmax(by_step))
    centred = t_s - t_s.mean()
    slope = float(centred @ spread / (centred @ centred))
    by_ramp = slope**2 * float(centred @ centred)
    inside = min(split + 1, offset.size - split - 1) >= BLOCKS
    if inside and by_step[split] > max(by_ramp, DRIFT_EXPLAINED * power):
        size = float(after[split] - before[split])
        # The windows around a step hold parts of both: it lies in their middle.
        at = float((t_s[split] + t_s[split + 1]) / 2)
        if abs(size) < least or _grows(response, at):
            return []
        text = f"off by {np.degrees(size):+.1f} degrees"
        return [Symptom("stepped", ((at, found.record_s[1]),), text)]
    total = slope * float(np.ptp(t_s))
    if abs(total) < least or by_ramp < DRIFT_EXPLAINED * power:
        return []
    return [Symptom("drifting", (), f"offset drifts by {np.degrees(total):+.1f} degrees")]


def _joined(t_s: FloatArray, marked: BoolArray, gap_s: float) -> tuple[Span, ...]:
    """Return marked samples as time spans; those closer than a gap are one."""
    at = np.flatnonzero(marked)
    if not at.size:
        return ()
    breaks = np.flatnonzero(np.diff(t_s[at]) > gap_s)
    first = np.concatenate(([0], breaks + 1))
    last = np.concatenate((breaks, [at.size - 1]))
    return tuple(zip(t_s[at[first]].tolist(), t_s[at[last]].tolist(), strict=True))
