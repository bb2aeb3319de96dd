"""From symptoms to the kinds of fault that fit: what effort, velocity and a second sensor decide.

A position alone can't separate a jammed joint from a frozen sensor. A kind is ruled out only by
another quantity that was recorded; otherwise all kinds that fit are named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..common.arrays import BoolArray, ComplexArray, FloatArray
from .fault import Fault, Span, Symptom
from .motion import (
    BLOCKS,
    FEW_SAMPLES,
    MIN_SHARE,
    MIN_WINDOWS,
    JointMotion,
    Judged,
    Response,
    Samples,
    complex_median,
    marked_spans,
    median_of,
    neighbours,
    record_span,
    robust_deviation,
    whole_or,
    windowed_response,
    within,
)

# Effort, as a share of a neighbour's, below which a motor does not drive its joint: friction.
POWERLESS = 0.2
# Control error, in those of the neighbours, from which a motor with power would push.
PUSHING_ERROR_RATIO = 2.5
ENDS = 2  # joints at either end of a free chain, which little load may keep from any effort
SAME = 0.35  # change of an effort, as a share of the usual one, up to which it is the usual one
PUSHING = 1.3  # share of the usual effort above which a motor pushes against something


@dataclass(frozen=True)
class UsualEffort:
    """Effort of the joints that follow.

    Attributes:
        size: Median absolute effort of each, shape (k,).
        ratio: Response of the effort to the command of each, shape (k,).
    """

    size: FloatArray
    ratio: ComplexArray

    def size_of(self, motion: JointMotion, main: Symptom) -> float:
        """Usual absolute effort of a joint: its own where it does not stand, else the others'."""
        if motion.effort is not None and main.spans_s:
            outside = motion.effort.values[~within(motion.effort.t_s, main.spans_s)]
            if outside.size >= FEW_SAMPLES:
                return float(np.median(np.abs(outside)))
        return median_of(self.size, 0.0)


def usual_effort(judged: Sequence[Judged]) -> UsualEffort:
    """Return effort of each joint that follows.

    Args:
        judged: The joints; those without a usual response are left out.
    """
    size: list[float] = []
    ratio: list[complex] = []
    for each in judged:
        effort = each.motion.effort
        if effort is None or not effort.values.size or not each.has_usual:
            continue
        r = windowed_response(each.motion.command, effort, each.response.period_s)
        size.append(float(np.median(np.abs(effort.values))))
        if r.valid.any():
            ratio.append(complex_median(r.ratio[r.valid]))
    return UsualEffort(np.array(size, dtype=np.float64), np.array(ratio, dtype=np.complex128))


def effort_there(
    motion: JointMotion, judged: Judged, main: Symptom, usual: UsualEffort
) -> tuple[float, float] | None:
    """Return size and change of the effort while a joint stands, relative to the usual effort.

    The effort's response to the command in windows of one cycle: a joint that is blocked pushes
    in step with its command, one that moves in step with its own lag behind it.

    Returns:
        Both; None without an effort to compare with.
    """
    if motion.effort is None:
        return None
    spans = main.spans_s or (record_span(motion),)
    r = windowed_response(motion.command, motion.effort, judged.response.period_s)
    during, outside = np.zeros_like(r.valid), np.ones_like(r.valid)
    for start, stop in spans:
        during |= (r.start_s >= start) & (r.stop_s <= stop)
        outside &= (r.start_s >= stop) | (r.stop_s <= start)
    ratio = r.ratio[during & r.valid]
    own = r.ratio[outside & r.valid]
    reference = own if main.spans_s and own.size >= BLOCKS else usual.ratio
    if ratio.size >= BLOCKS and reference.size:  # fewer windows hold parts of the usual motion
        here, there = complex_median(ratio), complex_median(reference)
        scattered = float(np.median(np.abs(reference - there))) > SAME * abs(there)
        if abs(there) > 0 and not scattered:
            return abs(here / there), abs(here / there - 1)
    # Too short for a window, or no usual response: by its size alone.
    inside = within(motion.effort.t_s, spans)
    values, level = motion.effort.values[inside], usual.size_of(motion, main)
    if values.size < FEW_SAMPLES or not level > 0:
        return None
    size = float(np.median(np.abs(values))) / level  # of a sine as large as its root mean square
    return size, size - 1 if size > PUSHING else 0.0


def powerless(judged: Sequence[Judged], k: int) -> list[Symptom]:
    """Find whether neighbours swing a joint: far from its command, without effort against it."""
    each, near = judged[k], neighbours(judged, k)
    r = each.response
    if each.motion.effort is None or min(k, len(judged) - 1 - k) < ENDS:
        return []
    errors = np.array([_usual(one, _control_error(one.response)) for one in near])
    usual = median_of(errors[np.isfinite(errors)])
    far = _control_error(r) > np.fmax(PUSHING_ERROR_RATIO * usual, r.asked / 2)
    off = r.valid & ~each.still & far
    if not off.any():
        return []
    known = [size for one in near if np.isfinite(size := _usual(one, _effort_spread(one)))]
    if not known:
        return []
    effort, pushes = _effort_spread(each), max(known)
    light = off & (effort < POWERLESS * pushes)
    if np.count_nonzero(light) < max(MIN_WINDOWS, MIN_SHARE * np.count_nonzero(off)):
        return []
    share = 100 * float(np.median(effort[light])) / pushes
    text = f"moves with its neighbours, at {share:.0f} % of their largest effort"
    return [Symptom("powerless", whole_or(marked_spans(r, light), r), text)]


def _control_error(response: Response) -> FloatArray:
    """Standard deviation of the position less the command in each window [rad], shape (w,)."""
    covariance = response.ratio.real * response.asked**2
    return np.sqrt(np.maximum(response.asked**2 + response.spread**2 - 2 * covariance, 0.0))


def _effort_spread(each: Judged) -> FloatArray:
    """Standard deviation of the effort in each window, shape (w,); NaN where it has no sample."""
    r, effort = each.response, each.motion.effort
    if effort is None:
        return np.full(r.start_s.size, np.nan)
    i, j = (np.searchsorted(effort.t_s, edges) for edges in (r.start_s, r.stop_s))
    level = effort.values - median_of(effort.values, 0.0)
    first, second = (np.concatenate(([0.0], np.cumsum(level**power))) for power in (1, 2))
    count = np.where(j > i, j - i, np.nan)
    mean, square = (first[j] - first[i]) / count, (second[j] - second[i]) / count
    return np.sqrt(np.maximum(square - mean**2, 0.0))


def _usual(each: Judged, values: FloatArray) -> float:
    """Return the median over the judged windows; NaN without any."""
    return median_of(values[each.response.valid & np.isfinite(values)])


MOVING = 0.5  # correlation of a velocity or second sensor with the command that shows motion
AT_REST = 0.3  # share of its usual motion below which a velocity or second sensor shows rest
NO_EFFORT = 0.15  # share of the usual effort below which a motor does not push
CONSTANT = 0.1  # standard deviation over mean below which an effort is constant
OF_SENSOR = 0.5  # share of a shift that a second sensor lacks, above which it is the first sensor's
MOSTLY = 0.5  # share of exact repeats above which a sensor may be frozen
MIN_RETURNS = 3  # times that a joint stands at one place, which is no chance
LIMIT_SHARE = 0.02  # nearer to a limit than this share of the range is at it

_SYMPTOMS: dict[str, tuple[str, tuple[str, ...]]] = {
    "still": ("does not move with its command", ("dead", "jammed", "stalled", "frozen_sensor")),
    "held": (
        "stands still while its command moves",
        ("jammed", "dead", "stalled", "frozen_sensor"),
    ),
    "opposite": ("moves against its command", ("inverted", "inverted_sensor")),
    "incoherent": ("does not follow its command", ("dead", "noisy_sensor")),
    "powerless": ("is not driven", ("dead",)),
    "astray": ("leaves its usual response", ("intermittent",)),
    "noisy": ("has bursts of noise", ("noisy_sensor",)),
    "stepped": ("has shifted", ("slipped", "slipped_sensor")),
    "wrapped": ("is off by whole turns", ("wrapped_sensor",)),
    "drifting": ("drifts", ("slipped", "drifting_sensor")),
    "scaled": ("differs in unit or scale", ("scaled_sensor",)),
    "slight": ("hardly moves", ("scaled_sensor", "dead", "jammed")),
    "swapped": ("is swapped", ("swapped",)),
    "lost": ("lacks samples", ("lost_samples",)),
    "stale": ("repeats old samples", ("stale_sensor", "lost_samples")),
}
"""Symptom to its phrase and the kinds that fit where nothing else was recorded, likeliest first."""


def fault_of(
    motion: JointMotion,
    judged: Judged | None,
    symptoms: list[Symptom],
    usual: UsualEffort,
) -> Fault:
    """Turn the symptoms of one joint into its fault.

    Args:
        judged: Its judged windows; None where it could not be judged.
        symptoms: What it shows, at least one.
        usual: Effort of the joints that follow.
    """
    main = symptoms[0]
    begin, end = record_span(motion)
    spans = tuple(sorted(span for each in symptoms for span in each.spans_s))
    whole = any(not each.spans_s for each in symptoms)
    phrase, fitting = _SYMPTOMS[main.name]
    kinds, decided = list(fitting), ""
    if main.name in ("still", "held") and judged is not None:
        kinds, decided = _standing(motion, judged, main, usual)
        if main.name == "held" and _resumes(main, end - begin, end, judged.response.period_s):
            first = ["intermittent"] if set(kinds) - {"frozen_sensor", "stale_sensor"} else []
            kinds = [*first, *kinds, *(["stale_sensor"] if "frozen_sensor" in kinds else [])]
    elif main.name == "opposite":
        kinds, decided = _opposite(motion)
    elif main.name in ("stepped", "drifting"):
        kinds, decided = _shifted(motion, main, kinds)
    for each in symptoms[1:]:
        kinds += [kind for kind in _SYMPTOMS[each.name][1] if kind not in kinds]
    cycle = judged.response.period_s if judged is not None else 0.0
    since = None if whole or not spans or spans[0][0] - begin < cycle / 2 else spans[0][0]
    until = None if whole or not spans or end - spans[-1][1] < cycle / 2 else spans[-1][1]
    length = sum(b - a for a, b in spans)
    share = 1.0 if whole or end <= begin else min(1.0, length / (end - begin))
    others = (each.text or _SYMPTOMS[each.name][0] for each in symptoms[1:])
    parts = dict.fromkeys([phrase, main.text, *others])
    evidence = ", ".join(filter(None, parts)) + (f"; {decided}" if decided else "")
    return Fault(motion.name, tuple(kinds), spans, since, until, share, evidence)


def _resumes(main: Symptom, length: float, end: float, cycle_s: float) -> bool:
    """Return whether a joint follows again, for a cycle or more, after it stood still."""
    spans = sorted(main.spans_s)
    if any(after[0] - before[1] > cycle_s for before, after in pairwise(spans)):
        return True
    return bool(spans) and end - spans[-1][1] > 0.1 * length


def _standing(
    motion: JointMotion,
    judged: Judged,
    main: Symptom,
    usual: UsualEffort,
) -> tuple[list[str], str]:
    """Return kinds of a joint that stands still, by what else was recorded."""
    spans = main.spans_s or (record_span(motion),)
    second = _shows_motion(motion, motion.reference, spans, judged, speed=False)
    if second:
        return ["frozen_sensor"], "the second sensor shows that it moves"
    if second is None and _shows_motion(motion, motion.velocity, spans, judged, speed=True):
        return ["frozen_sensor"], "the velocity shows that it moves"
    # A velocity at rest decides nothing: it may be the position's own derivative.
    kinds, why = _by_effort(motion, judged, main, usual)
    if second is None:
        return kinds, why
    kept = [kind for kind in kinds if kind != "frozen_sensor"]
    return kept, f"the second sensor stands still, too{'; ' + why if why else ''}"


def _by_effort(
    motion: JointMotion, judged: Judged, main: Symptom, usual: UsualEffort
) -> tuple[list[str], str]:
    """Return kinds of a joint that stands still, by its noise and its effort."""
    kinds = list(_SYMPTOMS[main.name][1])
    spans = main.spans_s or (record_span(motion),)
    repeats = _repeats(motion, spans)
    if not repeats:  # new noise in each sample: the sensor measures
        kinds.remove("frozen_sensor")
    limit = ["at_limit"] if _at_limit(motion, spans) or _at_one_end(motion, main.spans_s) else []
    known = effort_there(motion, judged, main, usual)
    if motion.effort is None or known is None:
        return [*limit, *kinds], ""
    here = motion.effort.values[within(motion.effort.t_s, spans)]
    size, change = known
    level = float(np.median(here))  # robust: a span may begin a moment early
    held = repeats and np.count_nonzero(np.diff(here) == 0) > MOSTLY * here.size
    pushes = abs(level) > 0.5 * usual.size_of(motion, main)
    constant = pushes and robust_deviation(here, level) < CONSTANT * abs(level)
    unusual, works = change > SAME, size > 0.5
    rules = (
        (held, [*kinds, "stale_sensor"], "its effort is constant to the bit, too"),
        (constant, ["stalled", "jammed"], "it pushes with constant effort"),
        (size < NO_EFFORT and not pushes, ["dead"], "its effort is near zero"),
        (
            size > PUSHING and unusual,
            ["jammed", "stalled"],
            f"its effort is {size:.1f} times the usual one",
        ),
        (works and unusual, ["jammed", "stalled"], "its effort is not the usual one"),
        (works and repeats, ["frozen_sensor"], "its effort goes on as usual"),
    )
    chosen, why = next(((fit, text) for holds, fit, text in rules if holds), (kinds, ""))
    return [*limit, *chosen], why


def _repeats(motion: JointMotion, spans: tuple[Span, ...]) -> bool:
    """Return whether most positions are, to the bit, the one before."""
    inside = motion.position.values[within(motion.position.t_s, spans)]
    repeated = int(np.count_nonzero(np.diff(inside) == 0))
    return inside.size < 2 or repeated > MOSTLY * (inside.size - 1)


def _opposite(motion: JointMotion) -> tuple[list[str], str]:
    """Return kinds of a joint that moves the opposite way."""
    if motion.reference is not None and motion.reference.values.size > 8:
        along = _correlation(motion.reference.at(motion.position.t_s), motion.position.values)
        if along < -MOVING:
            return ["inverted_sensor"], "the second sensor moves with the command"
        if along > MOVING:
            return ["inverted"], "the second sensor moves against the command, too"
    if motion.velocity is not None and motion.velocity.values.size > 8:
        rate = np.gradient(motion.position.values, motion.position.t_s)
        if _correlation(motion.velocity.at(motion.position.t_s), rate) < -MOVING:
            return ["inverted_sensor"], "its velocity has the opposite sign of its position"
    return list(_SYMPTOMS["opposite"][1]), ""


def _shifted(motion: JointMotion, main: Symptom, kinds: list[str]) -> tuple[list[str], str]:
    """Return kinds of a zero that moved: by a second sensor, or by the velocity at a step."""
    sensor = {"stepped": "slipped_sensor", "drifting": "drifting_sensor"}[main.name]
    if motion.reference is None or motion.reference.values.size <= 8:
        return kinds, ""
    t_s = motion.position.t_s
    gap = motion.position.values - motion.reference.at(t_s)
    whole = motion.position.values - motion.command.at(t_s)
    inside = within(t_s, main.spans_s or (record_span(motion),))
    shift = _trend if main.name == "drifting" else _step
    if abs(shift(gap, t_s, inside)) > OF_SENSOR * abs(shift(whole, t_s, inside)):
        return [sensor], "the second sensor does not show it"
    return ["slipped"], "the second sensor shows it, too"


def _trend(values: FloatArray, t_s: FloatArray, _: BoolArray) -> float:
    """Return change over the record, by the regression line."""
    centred = t_s - t_s.mean()
    return float(centred @ values / (centred @ centred)) * float(np.ptp(t_s))


def _step(values: FloatArray, _: FloatArray, inside: BoolArray) -> float:
    """Return mean inside a span less the mean outside it."""
    if not inside.any() or inside.all():
        return 0.0
    return float(values[inside].mean() - values[~inside].mean())


def _shows_motion(
    motion: JointMotion,
    samples: Samples | None,
    spans: tuple[Span, ...],
    judged: Judged,
    *,
    speed: bool,
) -> bool | None:
    """Return whether another quantity shows motion (True) or rest (False); None if unclear."""
    if samples is None:
        return None
    inside = within(samples.t_s, spans)
    t_s, values = samples.t_s[inside], samples.values[inside]
    if t_s.size < 8:
        return None
    command, delayed = (
        motion.command.at(t_s - back) for back in (0.0, judged.response.period_s / 4)
    )
    usual = abs(judged.ratio) * float(np.std(command))
    if speed:
        usual *= 2 * np.pi / judged.response.period_s
    if usual <= 0:
        return None
    size = float(np.std(values))
    design = np.stack([np.ones_like(t_s), command, delayed], axis=1)
    rest = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    explained = 1 - float(np.var(rest)) / size**2 if size > 0 else 0.0
    if size > AT_REST * usual and explained > MOVING:
        return True
    return False if size < AT_REST * usual else None


def _at_limit(motion: JointMotion, spans: tuple[Span, ...]) -> bool:
    """Return whether the joint stands at a limit of its description."""
    if motion.limits is None:
        return False
    level = median_of(motion.position.values[within(motion.position.t_s, spans)])
    lower, upper = motion.limits
    slack = LIMIT_SHARE * (upper - lower)
    return level <= lower + slack or level >= upper - slack


def _at_one_end(motion: JointMotion, spans: tuple[Span, ...]) -> bool:
    """Return whether the joint stands again and again at the same end of its motion."""
    if len(spans) < MIN_RETURNS:
        return False
    values = motion.position.values
    levels = [
        float(np.median(values[inside]))
        for span in spans
        if (inside := within(motion.position.t_s, (span,))).any()
    ]
    slack = 2 * LIMIT_SHARE * motion.position.range
    low, high = float(values.min()), float(values.max())
    return bool(levels) and (max(levels) <= low + slack or min(levels) >= high - slack)


def _correlation(first: FloatArray, second: FloatArray) -> float:
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])
