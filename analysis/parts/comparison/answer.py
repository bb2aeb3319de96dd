"""The answer in words: who does not follow, who stands out, and how the rest differs.

The order is that of what a reader must act on: joints that do not follow their command, joints
that respond differently from the others, then the shape of the rest. Each number is one whose
simultaneous interval excludes zero; only equivalence tests of every commanded joint say "alike".
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from undulog.capture.common.console import plain
from undulog.capture.common.errors import some_names
from undulog.capture.judgement.fault import NOTHING, Apart, Judgement, clause_of
from undulog.capture.judgement.levels import FOLLOWS, QUARTER
from undulog.capture.judgement.naming import NAMED

from ...common import formats
from ...common.answer import Answer, NotFollowing, Shape, StandOut, Verdict
from ...common.estimate import Estimate
from ..artefacts.result import Artefact
from ..free_motion.result import BodyWave, FreeMotion
from ..frequency_response.result import JointFrequencyResponse
from ..gait.result import GaitFacts
from ..gait.show import gait_frequency
from ..heterogeneity.result import Index
from ..joints.result import JointResult
from ..tracking.result import JointTracking
from .examine import Findings
from .words import (
    deviation_in_words,
    fault_in_words,
    low_gains,
    low_gains_in_words,
    rests_in_words,
    size_in_words,
)


@dataclass(frozen=True)
class Facts:
    """What an answer is composed of.

    Attributes:
        commanded: Names of the joints whose command moves.
        not_following: Joints that do not follow, in chain order.
        findings: Joints that stand out, and the shape of the rest.
        judgement: How the joints follow their commands.
        artefacts: Of the joints' signals.
        warnings: Of the analysis: they hold the reason where there is no answer.
        frequency_response: Frequency responses, where there is no gait.
        tracking: How the joints follow, where there is no gait.
        left_out: What of a session with a break is analysed; empty without a break.
        motion: Where no command is logged, else None.
    """

    gait: GaitFacts
    joints: tuple[JointResult, ...]
    commanded: tuple[str, ...]
    not_following: tuple[NotFollowing, ...]
    findings: Findings
    warnings: tuple[str, ...]
    frequency_response: tuple[JointFrequencyResponse, ...] = ()
    tracking: tuple[JointTracking, ...] = ()
    left_out: str = ""
    motion: FreeMotion | None = None
    judgement: Judgement = NOTHING
    artefacts: tuple[Artefact, ...] = ()


def compose(facts: Facts) -> Answer:
    """Compose the answer of one session."""
    with_gain = [joint for joint in facts.joints if joint.gain.value is not None]
    first = _named(facts)
    broken = f"{facts.left_out[:1].upper()}{facts.left_out[1:]}." if facts.left_out else ""
    verdict, rest, detail = _rest(facts, with_gain)
    if first:
        verdict = Verdict.UNLIKE
        detail = _responding(facts, with_gain) + _caveat(facts.joints)
    findings = facts.findings
    differs = first or findings.shape or findings.undecided
    alike = False if differs else None
    if verdict is Verdict.ALIKE and facts.commanded and _everyone(facts):
        alike = True
    return Answer(
        verdict=verdict,
        sentence=" ".join(
            part for part in (first, rest, _left_out(facts), _scales(facts), broken) if part
        ),
        detail=detail,
        not_following=facts.not_following,
        changes=facts.judgement.changes,
        extra=facts.judgement.extra,
        rests=facts.judgement.rests,
        apart=_apart(facts),
        stand_out=findings.stand_out,
        undecided=_undecided(facts) or _boundary(facts) or None,
        shape=findings.shape,
        alike=alike,
        compared=len(set(findings.compared)),
        commanded=len(facts.commanded),
    )


def find(indices: Mapping[str, Index], stem: str) -> dict[str, Index]:
    """Return the indices of one kind that have a value, by plane and group.

    Args:
        indices: Name to index; where both planes are driven, names end in the plane, where joints
            of one plane have several frequencies, in the group.
        stem: Name without the plane, e.g. ``gain_cv``.

    Returns:
        End of the name, e.g. ``horizontal``, ``vertical_group1`` or an empty string, to the index.
    """
    pattern = re.compile(rf"{re.escape(stem)}_?((?:horizontal|vertical)?(?:_?group\d+)?)")
    matches = {name: pattern.fullmatch(name) for name in indices}
    return {
        match[1]: indices[name]
        for name, match in matches.items()
        if match is not None and indices[name].value is not None
    }


def _named(facts: Facts) -> str:
    """Return the joints that do not follow, then those that stand out; empty for none."""
    clauses = [fault_in_words(fault) for fault in facts.not_following[:NAMED]]
    if len(facts.not_following) > NAMED:
        names = [plain(fault.joint) for fault in facts.not_following[NAMED:]]
        clauses.append(f"{', '.join(names)} do not follow either")
    if facts.judgement.naming:
        clauses.insert(0, plain(facts.judgement.naming))
    judged = facts.judgement
    differences = (*judged.changes, *judged.extra, *_apart(facts))
    clauses += [
        clause_of(difference, plain(difference.joint)) for difference in differences[:NAMED]
    ]
    if judged.rests:
        clauses.append(rests_in_words(judged.rests))
    if low := _low_gains(facts):
        clauses.append(low_gains_in_words(low))
    changed = {change.joint for change in judged.changes}
    off = {rest.joint for rest in judged.rests}
    by_joint: dict[str, list[StandOut]] = {}
    for deviation in facts.findings.stand_out:
        # What the mean of before and after shows, or a rest has shown.
        if deviation.joint in changed or (
            deviation.quantity == "offset" and deviation.joint in off
        ):
            continue
        by_joint.setdefault(deviation.joint, []).append(deviation)
    for joint, several in list(by_joint.items())[:NAMED]:
        sizes = " and ".join(deviation_in_words(deviation) for deviation in several)
        clause = f"{plain(joint)} responds differently from the others, {sizes}"
        end = joint in _ends(facts, several[0].plane, several[0].group)
        clauses.append(f"{clause}: the joint or the boundary" if end else clause)
    clauses += facts.findings.kinds
    if len(by_joint) > NAMED:
        names = [plain(joint) for joint in list(by_joint)[NAMED:]]
        clauses.append(f"{', '.join(names)} respond differently, too")
    if not clauses and (undecided := _undecided(facts)):
        clauses.append(undecided)
    # A joint's name keeps its letters at the beginning, too: a reader searches for it.
    return f"{'; '.join(clauses)}." if clauses else ""


def _apart(facts: Facts) -> tuple[Apart, ...]:
    """Return the joints whose response lies apart, where no closer comparison names them."""
    compared = {*facts.findings.compared}
    return tuple(
        deviation for deviation in facts.judgement.apart if deviation.joint not in compared
    )


def _low_gains(facts: Facts) -> tuple[JointTracking, ...]:
    """Return joints of low gain of which no closer statement is made."""
    judged, stand_out = facts.judgement, facts.findings.stand_out
    named = {fault.joint for fault in facts.not_following}
    for differences in (judged.changes, judged.extra, judged.apart, stand_out):
        named |= {difference.joint for difference in differences}
    return tuple(joint for joint in low_gains(facts.tracking) if joint.joint not in named)


def _left_out(facts: Facts) -> str:
    """Driven joints that are neither compared nor named, and why if they moved too little.

    Empty where nothing was compared, unless no joint could be judged.
    """
    covered = {*facts.findings.compared, *(fault.joint for fault in facts.not_following)}
    names = [name for name in facts.commanded if name not in covered]
    if not facts.findings.compared and facts.judgement.judged:
        return ""
    asked = {name: rad for name, rad in facts.judgement.unexposed if name in names}
    rest = [name for name in names if name not in asked] if facts.findings.compared else []
    most = math.degrees(max(asked.values(), default=0.0))
    little = f"not asked to move enough to judge (at most {most:.2g} degrees commanded)"
    sentences = [f"{some_names([*map(plain, asked)], NAMED)}: {little}."] if asked else []
    sentences += [f"Not compared: {some_names([*map(plain, rest)], NAMED)}."] if rest else []
    return " ".join(sentences)


def _scales(facts: Facts) -> str:
    """Say which joints' velocities have another scale than their positions; empty for none."""
    clauses = [
        f"{plain(artefact.joint)}'s velocity is {artefact.note}"
        for artefact in facts.artefacts
        if (artefact.quantity, artefact.flag) == ("velocity", "scale_mismatch") and artefact.note
    ]
    more = f" and {len(clauses) - NAMED} more" if len(clauses) > NAMED else ""
    return f"{'; '.join(clauses[:NAMED])}{more}." if clauses else ""


def _undecided(facts: Facts) -> str:
    if not facts.findings.undecided:
        return ""
    word = _joints_word(facts, *facts.findings.undecided[0])
    return f"the {word} differ, but with fewer than 4 sound ones it can't be decided which one"


def _ends(facts: Facts, plane: str, group: int) -> tuple[str, ...]:
    """Return the first and the last of the compared joints of a plane and rhythm."""
    compared = set(facts.findings.compared)
    names = [
        joint.name
        for joint in facts.joints
        if joint.name in compared
        and plane in ("chain", joint.plane)
        and joint.group in (None, group)
    ]
    return (names[0], names[-1]) if len(names) > 1 else ()


def _boundary(facts: Facts) -> str:
    """Say which joints or boundaries make the ends differ, and what decides; empty for none."""
    pairs = [f"{plain(first)} and {plain(last)}" for first, last in facts.findings.boundary]
    if not pairs:
        return ""
    what_decides = "reverse, swap modules, or compare with an earlier session"
    return f"the boundary or {', '.join(pairs)}: {what_decides}"


def _rest(facts: Facts, results: Sequence[JointResult]) -> tuple[Verdict, str, str]:
    """Verdict, sentence and detail on the joints that are not named."""
    judged = facts.judgement
    named = bool(facts.not_following or judged.changes or judged.extra or judged.rests)
    named |= bool(_apart(facts))
    named |= bool(facts.findings.stand_out or facts.findings.undecided or facts.findings.kinds)
    if facts.motion is not None or facts.gait.frequency_hz.value is None:
        about = "no command" if facts.motion is not None else "no gait"
        return Verdict.NOTHING, _without_gait(facts), _why_not(facts, about)
    if not results:
        lead = "No joint could be compared with its command."
        return Verdict.NOTHING, lead, _why_not(facts, "gain and lag are null")
    if len(results) == 1:
        return _single(facts, results[0], named=named)
    return *_compared(facts, named=named), _responding(facts, results) + _caveat(facts.joints)


def _without_gait(facts: Facts) -> str:
    """Return the sentence on a session without commands or without a gait."""
    if facts.motion is not None:
        return _motion(facts, facts.motion)
    if made := [warning for warning in facts.warnings if warning.startswith("times made from fps")]:
        why = f"Not periodic, {made[0].split(':')[0]}"
        return _tracked(why, facts.tracking) or f"{why}: no gain and no lag to compare."
    if facts.frequency_response:
        return _swept(facts.frequency_response, facts.tracking)
    no_gait = "No gait was found in this session, so there is no gain and no lag to compare."
    return _tracked("No gait", facts.tracking) or no_gait


def _tracked(why: str, tracking: Sequence[JointTracking]) -> str:
    """Return the sentence on joints whose gain is known to a quarter; empty for none."""
    follow = [
        joint
        for joint in tracking
        if joint.explained >= FOLLOWS
        and joint.gain.ci95 is not None
        and joint.gain.ci95[1] - joint.gain.ci95[0] < 2 * QUARTER * (joint.gain.value or 0.0)
    ]
    if not follow:
        return ""
    gains = _range([joint.gain.value or 0.0 for joint in follow])
    lags = _range([round(1e3 * (joint.lag_s.value or 0.0)) for joint in follow], "d")
    joints = f"{len(follow)} joint{'s follow' if len(follow) > 1 else ' follows'}"
    return f"{why}: {joints} with a gain of {gains} and a lag of {lags} ms."


def _motion(facts: Facts, motion: FreeMotion) -> str:
    """Return the sentence on a motion without commands."""
    if not motion.joints:
        return "No command logged, and no single frequency in the motion."
    gait = gait_frequency(facts.gait)
    lead = f"No command logged; the motion has {gait} and an amplitude"
    whole = [wave for wave in motion.waves if wave.standing or wave.direction != "undecided"]
    if not whole or len(motion.joints) <= NAMED:
        sizes = [
            f"{plain(joint.name)} {formats.estimate(formats.degrees(joint.amplitude_rad), '°')}"
            for joint in motion.joints[:NAMED]
        ]
        more = f" and {len(motion.joints) - NAMED} more" if len(motion.joints) > NAMED else ""
        lead = f"{lead} of {', '.join(sizes)}{more}"
    else:
        sizes = [math.degrees(joint.amplitude_rad.value or 0.0) for joint in motion.joints]
        lead = f"{lead} of {min(sizes):.3g}° to {max(sizes):.3g}°"
    return "; ".join((lead, *(_wave(joint) for joint in whole))) + "."


def _wave(wave: BodyWave) -> str:
    first, last = wave.joints[0], wave.joints[-1]
    if wave.direction == "last-to-first":
        first, last = last, first
    plane = "" if wave.plane is None else f"{wave.plane} "
    index = formats.estimate(wave.travelling_index)
    if wave.standing:
        return f"the {plane}wave stands, as far as noise shows (travelling index {index})"
    return (
        f"a {plane}wave runs from {plain(first)} to {plain(last)}, "
        f"{formats.estimate(wave.waves)} wavelengths between them{_uneven(wave)}, travelling "
        f"index {index}"
    )


def _uneven(wave: BodyWave) -> str:
    """Return between which wave numbers a wave changes along the body; empty for an even one."""
    numbers = [part.wave_number for part in wave.local if part.wave_number.value is not None]
    if not numbers:
        return ""
    ends = [min(numbers, key=_size_of), max(numbers, key=_size_of)]
    least, most = (formats.estimate(formats.degrees(number), "") for number in ends)
    return f" and no even one (from {least} to {most} °/joint)"


def _size_of(number: Estimate) -> float:
    return number.value or 0.0


def _swept(responses: Sequence[JointFrequencyResponse], tracking: Sequence[JointTracking]) -> str:
    """Return the sentence on frequency responses."""
    kinds = " and ".join(sorted({response.excitation for response in responses}))
    band = _range(
        [f for response in responses for f in (response.frequency_hz[0], response.frequency_hz[-1])]
    )
    text = f"No gait: the commands are of the kind {kinds}; frequency response of {len(responses)} "
    text += f"joint{'s' if len(responses) > 1 else ''} from {band} Hz"
    edges = [response.bandwidth_hz for response in responses if response.bandwidth_hz is not None]
    lags = [1e3 * (joint.lag_s.value or 0.0) for joint in tracking if joint.explained >= FOLLOWS]
    text += f", -3 dB at {_range(edges)} Hz" if edges else ""
    text += f", lag {_range(lags)} ms" if lags else ""
    shared = len(responses) > 1 and len(responses[0].shares_command) == len(responses) - 1
    return text + (". All joints share one command: it is the response to that." if shared else ".")


def _range(values: Sequence[float], digits: str = ".3g") -> str:
    low, high = f"{min(values):{digits}}", f"{max(values):{digits}}"
    return low if low == high else f"{low} to {high}"


def _single(facts: Facts, joint: JointResult, *, named: bool) -> tuple[Verdict, str, str]:
    lag = formats.estimate(formats.degrees(joint.lag_rad), "°", most=2)
    lead = f"{'One other' if named else 'One'} joint was driven: its gain is "
    lead += f"{formats.estimate(joint.gain)}, its lag {lag} behind the command."
    detail = "There is no second joint to compare it with." + _caveat(facts.joints)
    return Verdict.SINGLE, lead, detail


def _compared(facts: Facts, *, named: bool) -> tuple[Verdict, str]:
    """Verdict and sentence on the joints that were compared and are not named."""
    findings = facts.findings
    if findings.undecided:
        return Verdict.UNLIKE, ""
    shapes = _shapes(facts)
    if findings.alike and (named or _everyone(facts)):
        judged = facts.judgement
        differ = (*findings.stand_out, *judged.changes, *judged.extra, *judged.rests)
        left = len({*findings.compared} - {finding.joint for finding in differ})
        named = named and left > 0
        left = left or len(findings.compared)
        others = f"The other {left} joints" if named else f"The segments move alike: all {left}"
        rest = "move alike, within" if named else "joints are within"
        return Verdict.ALIKE, f"{others} {rest} 2 % of gain and 1 degree of lag."
    if shapes:
        lead = "The others differ" if named else "The segments do not move alike"
        return Verdict.UNLIKE, f"{lead}: {shapes}."
    subject = "the others" if named else "the segments"
    return Verdict.OPEN, f"No difference between {subject} could be shown."


def _everyone(facts: Facts) -> bool:
    return set(facts.commanded) <= set(facts.findings.compared)


def _shapes(facts: Facts) -> str:
    """Return the largest shape of lag and of gain of each plane."""
    clauses: list[str] = []
    chains = dict.fromkeys((shape.plane, shape.group) for shape in facts.findings.shape)
    for plane, group in sorted(chains):
        word = _joints_word(facts, plane, group)
        for quantity in ("lag", "gain"):
            shapes = [
                shape
                for shape in facts.findings.shape
                if (shape.plane, shape.group, shape.quantity) == (plane, group, quantity)
            ]
            shaped = [shape for shape in shapes if shape.kind != "each"]
            ends = [shape for shape in shaped if shape.kind == "ends"]
            clauses += [_shape(end, word) for end in (ends or shaped or shapes)[:1]]
    boundary = _boundary(facts)
    return f"{'; '.join(clauses)} ({boundary})" if boundary else "; ".join(clauses)


def _shape(shape: Shape, joints: str) -> str:
    """Return a shape with its simultaneous interval as a clause."""
    negative, lag = shape.value < 0, shape.quantity == "lag"
    text = size_in_words(shape.quantity, shape.value, shape.ci95)
    more = "less" if negative else "more"
    if shape.kind == "ends":
        if lag and negative:
            return f"the middle {joints} lag {text} more than the ends"
        if lag:
            return f"the {joints} at the ends lag {text} more than the middle"
        at = f"the gain at the ends is {text} less than in the middle"
        return at if negative else f"the gain of the {joints} at the ends is {text} more"
    if shape.kind == "trend":
        grows = "falls" if negative else "grows"
        return f"the {shape.quantity} of the {joints} {grows} by {text} from head to tail"
    if shape.kind == "mirror":
        what = f"lag {text} {more}" if lag else f"have {text} {more} gain"
        return f"the outer {joints} {what} than the inner ones, alike on both sides"
    # The table names the joint with the largest: one of many sound joints always has it.
    individual = f"each of the {joints} has a {shape.quantity} of its own"
    return f"{individual}, up to {text} {more} than the others"


def _joints_word(facts: Facts, plane: str, group: int) -> str:
    """What to call the joints of a plane and rhythm group."""
    word = {"horizontal": "yaw joints", "vertical": "pitch joints"}.get(plane, "joints")
    if len(facts.gait.groups) < 2:
        return word
    frequency = facts.gait.groups[group].frequency_hz
    return f"{word} at {formats.number(frequency.value, 3)} Hz"


def _responding(facts: Facts, results: Sequence[JointResult]) -> str:
    """How many joints respond, to which gait, and the range of their lags."""
    if facts.gait.frequency_hz.value is None:
        return _why_not(facts, "no gait")
    frequency = gait_frequency(facts.gait)
    silent = {fault.joint for fault in facts.not_following}
    responding = [joint for joint in results if joint.name not in silent]
    text = f"{len(responding)} of {len(facts.joints)} joints respond to a gait of {frequency}"
    if lags := [(lag, j.name) for j in responding if (lag := j.lag_rad.value) is not None]:
        first, last = (of(lags, key=lambda pair: pair[0]) for of in (min, max))
        ends = [f"{formats.number(math.degrees(v), 1)}° ({plain(k)})" for v, k in (first, last)]
        text += f"; lag runs from {' to '.join(ends)}"
    evidence = [
        f" {plain(fault.joint)} {fault.evidence}."
        for fault in facts.not_following[:NAMED]
        if fault.kinds != ("lost_samples",)
    ]
    return text + "." + "".join(evidence)


def _caveat(joints: Sequence[JointResult]) -> str:
    named = [f"{plain(j.name)} ({', '.join(j.flags)})" for j in joints if j.flags]
    if not named:
        return ""
    more = f" and {len(named) - NAMED} more" if len(named) > NAMED else ""
    return f" Flagged, see the table of joints: {', '.join(named[:NAMED])}{more}."


def _why_not(facts: Facts, lacking: str) -> str:
    """Return the warning that says what is lacking, or else speaks of a gait, or the first."""
    if not facts.warnings:
        return "The result gives no reason."
    verdict = [
        warning for warning in facts.warnings if lacking in warning and "held still" not in warning
    ]
    about = [warning for warning in facts.warnings if "gait" in warning.lower()]
    return formats.sentence((verdict or about or facts.warnings)[0])
