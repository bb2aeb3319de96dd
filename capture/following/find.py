"""Find the joints that do not follow their command, and when.

Each joint's response is fitted in windows of one cycle and compared with the response that all
joints have in common; its residual against its own usual response is searched for times at which
it leaves that response. What many joints do at the same time (a collision, a stop) is no fault of
one of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ..arrays import BoolArray, FloatArray
from .excursions import Excursions, departures, find_excursions, find_holds
from .fault import Fault, Span
from .kinds import Symptom, UsualEffort, fault_of
from .motion import FEW_SAMPLES, JointMotion, Response, cycle_s, windowed_response
from .records import record_faults, wraps
from .swaps import swapped_pairs

DRIVEN_SHARE = 0.01
"""A joint whose command moves less than this share of the largest is held still."""

MIN_COMMAND_RAD = 1e-3
"""A command that moves less than this is held still, whatever the others do [rad]."""

SHORTEST_S = 2.0
"""A shorter record is not judged [s]."""

COHERENT = 0.5
"""Explained share above which a window follows its command, with whatever gain and lag."""

NO_RESPONSE = 0.2
"""Gain, as a share of the common one, below which a window shows no response."""

STILL = 0.3
"""Motion, as a share of the usual one, below which a joint stands still."""

OPPOSITE_RAD = np.radians(150.0)
"""Phase against the common response beyond which a joint moves the opposite way."""

DEGREE = float(np.degrees(1.0))
UNIT_SLACK = 1.6
"""Factor within which a gain of 180/pi is a matter of units: a weak servo's gain is in it."""

NEIGHBOURS = 4
"""Joints that one joint is compared with: the nearest ones."""

MIN_WINDOWS = 5
"""Windows (two whole cycles) that a joint's own usual response needs."""

LOADED = 0.7
"""Gain below which a joint's neighbours are held back by a load: then it may be, too."""

ORDERLY = 0.8
"""Explained share of its neighbours beside which a joint that follows nothing stands out."""

POWERLESS = 0.2
"""Effort, as a share of a neighbour's, below which a motor does not drive its joint: friction."""

ASTRAY = 2.5
"""Control error, in those of the neighbours, from which a motor with power would push."""

ENDS = 2
"""Joints at either end of a free chain, which little load may keep from any effort."""

RARELY = 0.1
"""A joint that follows in less than this share of its windows does not follow."""

MIN_SHARE = 0.5
"""A joint whose windows follow less than this share of the time has no usual response."""


_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Judged:
    """One joint's windows, judged.

    Attributes:
        motion: The joint's signals.
        response: Its response in each window.
        follows: Windows that follow the command, shape (w,).
        still: Windows in which the joint stands still, shape (w,).
        opposite: Windows in which it moves the opposite way, shape (w,).
        ratio: Its usual H; the common one where it has none of its own.
        offset: Its usual offset [rad].
        common: The response that its neighbours have in common.
    """

    motion: JointMotion
    response: Response
    follows: BoolArray
    still: BoolArray
    opposite: BoolArray
    ratio: complex
    offset: float
    common: complex

    @property
    def loaded(self) -> bool:
        """Whether its neighbours are held back by a load: then it may be, too."""
        return abs(self.common) < LOADED

    @property
    def has_usual(self) -> bool:
        """Whether the joint has a usual response of its own."""
        return int(np.count_nonzero(self.follows)) >= MIN_WINDOWS


def joints_not_following(motions: Sequence[JointMotion]) -> tuple[Fault, ...]:
    """Find the joints that do not follow their command.

    Args:
        motions: The joints with commands and positions, in chain order.

    Returns:
        At most one fault a joint, in chain order. Joints whose command does not move are not
        judged.
    """
    largest = max((each.command.range for each in motions), default=0.0)
    least = max(DRIVEN_SHARE * largest, MIN_COMMAND_RAD)
    driven = [each for each in motions if each.command.range > least and _lasts(each)]
    responses = [
        windowed_response(each.command, each.position, cycle_s(each.command)) for each in driven
    ]
    own = [own_response(each) for each in responses]
    common = common_response(own)
    # What noise makes of a joint that stands still is no response for its neighbours.
    own = [
        each if each is not None and abs(each) > NO_RESPONSE * abs(common) else None for each in own
    ]
    judged = [
        judge(each, r, common_response(neighbours(own, k)))
        for k, (each, r) in enumerate(zip(driven, responses, strict=True))
    ]
    symptoms: dict[str, list[Symptom]] = {each.name: [] for each in motions}
    for each in driven:
        if (wrapped := wraps(each)) is not None:
            symptoms[each.name].append(wrapped)
    explained = [_explained(each) for each in responses]
    for k, each in enumerate(judged):
        found = symptoms[each.motion.name]
        if not found:
            found += _powerless(judged, k)
        near = [share for share in neighbours(explained, k) if share is not None]
        if not found:
            found += _from_windows(each, float(np.median(near)) if near else 1.0)
        if not found:
            held = find_holds(each.motion, each.response, each.still, loaded=each.loaded)
            found += [] if held is None else [held]
    for name, partner in swapped_pairs(judged, common).items():
        symptoms[name] = [Symptom("swapped", (), f"carries out the command of {partner}")]
    for name, departed in _from_residuals(judged, symptoms).items():
        symptoms[name] += departed
    for name, lacking in record_faults(motions).items():
        known = {each.name for each in symptoms[name]}
        if not known & {"still", "held", "wrapped"}:
            symptoms[name] += [each for each in lacking if each.name not in known]
    by_name: Mapping[str, Judged] = {each.motion.name: each for each in judged}
    stands = any(each.name in ("still", "held") for own in symptoms.values() for each in own)
    usual = _usual_effort(judged if stands else ())
    return tuple(
        fault_of(each, by_name.get(each.name), symptoms[each.name], usual)
        for each in motions
        if symptoms[each.name]
    )


def _lasts(motion: JointMotion) -> bool:
    """Whether command and position overlap for long enough to judge the one by the other."""
    command, position = motion.command.t_s, motion.position.t_s
    if min(command.size, position.size) < FEW_SAMPLES:
        return False
    return min(command[-1], position[-1]) - max(command[0], position[0]) >= SHORTEST_S


def own_response(response: Response) -> complex | None:
    """The usual response of one joint.

    Args:
        response: Its windows.

    Returns:
        Median of H over the windows that it explains; None where it explains too few, which is
        no response.
    """
    coherent = response.valid & (response.explained > COHERENT) & (np.abs(response.ratio) > 1e-3)
    if np.count_nonzero(coherent) < max(1, 0.2 * np.count_nonzero(response.valid)):
        return None
    return _median(response.ratio[coherent])


def neighbours(values: Sequence[_Value], k: int) -> list[_Value]:
    """The values of the joints nearest to one joint in the chain, without its own.

    Args:
        values: One of each driven joint, e.g. its response, in chain order.
        k: Index of the joint.

    Returns:
        Up to ``NEIGHBOURS`` values: the gain of a loaded chain changes along the body.
    """
    others = sorted((j for j in range(len(values)) if j != k), key=lambda j: (abs(j - k), j))
    return [values[j] for j in others[:NEIGHBOURS]]


def common_response(own: Sequence[complex | None]) -> complex:
    """The response that some joints have in common.

    Args:
        own: Response of each; None for none.

    Returns:
        Median gain at the circular median lag of the joints that respond, with one vote for an
        ideal response, so that two joints of opposite sign are told apart.
    """
    values = np.asarray([1.0 + 0.0j, *(each for each in own if each is not None)])
    unit = values / np.abs(values)
    # The circular median: the phase of the joint that is nearest to all others.
    distance = np.abs(np.angle(unit[:, None] * unit.conj()[None, :])).sum(axis=1)
    gain = float(np.median(np.abs(values[1:]))) if values.size > 1 else 1.0
    return complex(gain * unit[int(np.argmin(distance))])


def judge(motion: JointMotion, response: Response, common: complex) -> Judged:
    """Judge each window of one joint.

    Args:
        motion: The joint.
        response: Its windows.
        common: The response that its neighbours have in common.

    Returns:
        The judged windows.
    """
    relative = response.ratio / common
    coherent = response.explained > COHERENT
    moves = response.spread > STILL * abs(common) * response.asked
    opposite = response.valid & coherent & moves & (np.abs(np.angle(relative)) > OPPOSITE_RAD)
    opposite &= np.abs(relative) < UNIT_SLACK**2
    responds = coherent & (np.abs(relative) > NO_RESPONSE)
    units = (response.explained > 0.9) & (
        np.abs(np.log(np.maximum(np.abs(relative), 1e-12) * DEGREE)) < np.log(UNIT_SLACK)
    )
    follows = response.valid & (responds | units) & ~opposite
    still = response.valid & ~follows & ~opposite & ~moves
    chosen = follows if follows.any() else opposite
    ratio = _median(response.ratio[chosen]) if chosen.any() else common
    use = chosen if chosen.any() else response.valid
    offset = float(np.median(response.offset[use])) if use.any() else 0.0
    return Judged(motion, response, follows, still, opposite, ratio, offset, common)


def _from_windows(each: Judged, coherence: float) -> list[Symptom]:
    """What the windows of one joint show as a whole, beside its neighbours' coherence."""
    r = each.response
    valid = int(np.count_nonzero(r.valid))
    if not valid:
        return []
    follows = np.count_nonzero(each.follows) / valid
    gain = abs(each.ratio) / abs(each.common)
    found: Symptom | None = None
    orderly = coherence > ORDERLY and not each.loaded
    if (unit := _unit_factor(each, gain)) is not None:
        # A joint that hardly moves may as well stand still, but for what its neighbours do to it.
        name = "scaled" if gain > 1 else "slight"
        found = Symptom(name, (), f"moves {unit} times as far as the other joints")
    elif np.count_nonzero(each.opposite) > 0.5 * valid:
        spans = _whole_or(_spans(r, each.opposite), r)
        found = Symptom("opposite", spans, f"gain {-abs(each.ratio):.2f}")
    elif follows >= MIN_SHARE and each.has_usual:
        found = None  # its departures are found sample by sample
    elif np.count_nonzero(each.still) > 0.5 * valid and follows < RARELY:
        found = Symptom("still", (), "")
    elif follows < RARELY and not each.opposite.any() and orderly:
        found = Symptom("incoherent", (), "moves, but not with its command")
    return [] if found is None else [found]


def _powerless(judged: Sequence[Judged], k: int) -> list[Symptom]:
    """A joint that its neighbours swing: far from its command, and no effort against it."""
    each, near = judged[k], neighbours(judged, k)
    r = each.response
    if each.motion.effort is None or min(k, len(judged) - 1 - k) < ENDS:
        return []
    usual = float(np.median([_usual(one, _control_error(one.response)) for one in near]))
    far = _control_error(r) > np.maximum(ASTRAY * usual, r.asked / 2)
    off = r.valid & ~each.still & far
    if not off.any():
        return []
    effort, pushes = _effort_spread(each), max(_usual(one, _effort_spread(one)) for one in near)
    light = off & (effort < POWERLESS * pushes)
    if np.count_nonzero(light) < max(MIN_WINDOWS, MIN_SHARE * np.count_nonzero(off)):
        return []
    share = 100 * float(np.median(effort[light])) / pushes
    text = f"moves with its neighbours, at {share:.0f} % of their largest effort"
    return [Symptom("powerless", _whole_or(_spans(r, light), r), text)]


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
    level = effort.values - (float(np.median(effort.values)) if effort.values.size else 0.0)
    first, second = (np.concatenate(([0.0], np.cumsum(level**power))) for power in (1, 2))
    count = np.where(j > i, j - i, np.nan)
    mean, square = (first[j] - first[i]) / count, (second[j] - second[i]) / count
    return np.sqrt(np.maximum(square - mean**2, 0.0))


def _usual(each: Judged, values: FloatArray) -> float:
    """Median over the windows that are judged; NaN without any."""
    known = values[each.response.valid & np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _unit_factor(each: Judged, gain: float) -> str | None:
    """The factor between degrees and radians that a gain shows, in words."""
    if np.count_nonzero(each.follows) < MIN_SHARE * np.count_nonzero(each.response.valid):
        return None
    if gain <= 0:
        return None
    for factor, text in ((DEGREE, "180/pi"), (1 / DEGREE, "pi/180")):
        if abs(np.log(gain / factor)) < np.log(UNIT_SLACK):
            return text
    return None


def _explained(response: Response) -> float | None:
    """Median explained share of a joint's windows; None where none is judged."""
    if not response.valid.any():
        return None
    return float(np.median(response.explained[response.valid]))


def _from_residuals(
    judged: Sequence[Judged], symptoms: Mapping[str, Sequence[Symptom]]
) -> dict[str, list[Symptom]]:
    """Times at which a joint leaves its own usual response, and no other joint does."""
    kept: list[tuple[Judged, Excursions]] = [
        (each, find_excursions(each.motion, each.response, each.follows, each.ratio, each.offset))
        for each in judged
        if each.has_usual and not symptoms[each.motion.name]
    ]
    spans = [found.spans_s for _, found in kept]
    result: dict[str, list[Symptom]] = {}
    for k, (each, found) in enumerate(kept):
        alone = [not _shared(span, spans, k) for span in found.spans_s]
        result[each.motion.name] = departures(each.response, found, alone, loaded=each.loaded)
    return result


def _shared(span: Span, spans: Sequence[Sequence[Span]], own: int) -> bool:
    """Whether another joint departs at the same time: then something happened to the body."""
    return any(
        start < span[1] and stop > span[0]
        for k, other in enumerate(spans)
        if k != own
        for start, stop in other
    )


def _spans(response: Response, marked: BoolArray) -> tuple[Span, ...]:
    """Marked windows as time spans, neighbours joined."""
    spans: list[Span] = []
    for start, stop in zip(response.start_s[marked], response.stop_s[marked], strict=True):
        if spans and start <= spans[-1][1]:
            spans[-1] = (spans[-1][0], float(stop))
        else:
            spans.append((float(start), float(stop)))
    return tuple(spans)


def _whole_or(spans: tuple[Span, ...], response: Response) -> tuple[Span, ...]:
    """Nothing where the spans cover (nearly) the whole record, i.e. a permanent fault."""
    if len(spans) == 1 and response.start_s.size:
        cycle = response.period_s
        begin, end = response.start_s[0], response.stop_s[-1]
        if spans[0][0] - begin < cycle and end - spans[0][1] < cycle:
            return ()
    return spans


def _median(values: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> complex:
    return complex(np.median(values.real), np.median(values.imag))


def _usual_effort(judged: Sequence[Judged]) -> UsualEffort:
    """Effort of each joint that follows."""
    size: list[float] = []
    ratio: list[complex] = []
    for each in judged:
        effort = each.motion.effort
        if effort is None or not effort.values.size or not each.has_usual:
            continue
        r = windowed_response(each.motion.command, effort, each.response.period_s)
        size.append(float(np.median(np.abs(effort.values))))
        if r.valid.any():
            ratio.append(_median(r.ratio[r.valid]))
    return UsualEffort(np.array(size, dtype=np.float64), np.array(ratio, dtype=np.complex128))
