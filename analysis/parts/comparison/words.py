"""Clauses of the answer: one fault, one difference, one size, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from undulog.capture.common.console import plain
from undulog.capture.judgement.fault import RestsOff, clause_of
from undulog.capture.judgement.levels import HALF, LARGEST_REST_RAD
from undulog.capture.judgement.naming import NAMED

from ...common import formats
from ...common.answer import NotFollowing, StandOut
from ...common.estimate import Estimate, Interval
from ..tracking.result import JointTracking

LOW_GAIN = 0.85
"""Gain below which a joint is named though there is nothing to compare it with: hobby servos that
hold a load against gravity give 0.8 to 0.9 of what they are commanded."""

_KIND_WORDS = {
    "at_limit": "at a limit",
    "swapped": "swapped with another joint",
    "frozen_sensor": "a frozen sensor",
    "inverted_sensor": "an inverted sensor",
    "stale_sensor": "a sensor with old values",
    "scaled_sensor": "a sensor of wrong scale or unit",
    "slipped_sensor": "a sensor whose zero moved",
    "noisy_sensor": "a noisy sensor",
    "wrapped_sensor": "a sensor that wrapped around",
    "drifting_sensor": "a drifting sensor",
    "clipped_sensor": "a clipped sensor",
}
"""Kinds of fault that their own name does not describe."""


def kinds_in_words(kinds: Sequence[str]) -> str:
    """Kinds of fault that fit, as a reader takes them.

    Args:
        kinds: Keys of :data:`.capture.judgement.fault.KINDS`.

    Returns:
        For example ``jammed, dead or a frozen sensor``.
    """
    words = [_KIND_WORDS.get(kind, kind.replace("_", " ")) for kind in kinds]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def fault_in_words(fault: NotFollowing) -> str:
    """One joint that does not follow, as a clause.

    Returns:
        For example ``joint04 does not follow its command from 7.4 s on: jammed or dead``.
    """
    if fault.kinds == ("lost_samples",):
        return f"{plain(fault.joint)} {fault.evidence}"
    match fault.since_s, fault.until_s:
        case None, None:
            when = ""
        case since, None:
            when = f" from {since:.1f} s on"
        case None, until:
            when = f" until {until:.1f} s"
        case since, until:
            share = max(1.0, 100 * fault.share)
            when = f" for {share:.0f} % of the time from {since:.1f} to {until:.1f} s"
    return f"{plain(fault.joint)} does not follow its command{when}: {kinds_in_words(fault.kinds)}"


def rests_in_words(rests: Sequence[RestsOff]) -> str:
    """Joints that rest off their commands, as one clause.

    Returns:
        For example ``Pitch, Elbow rest 4.3 and 4.6 degrees off their commands``.
    """
    if len(rests) == 1:
        return clause_of(rests[0], plain(rests[0].joint))
    sizes = [f"{abs(math.degrees(rest.offset_rad)):.2g}" for rest in rests]
    if len(rests) > NAMED:
        most = max(sizes, key=float)
        return f"{len(rests)} joints rest off their commands, up to {most} degrees"
    names = ", ".join(plain(rest.joint) for rest in rests)
    verb = "rest" if any(rest.rests for rest in rests) else "are"
    return f"{names} {verb} {', '.join(sizes[:-1])} and {sizes[-1]} degrees off their commands"


def deviation_in_words(out: StandOut) -> str:
    """One deviation with its interval; the word carries the sign.

    Returns:
        For example ``gain 20.1 % [18.9, 21.2] less``.
    """
    negative, text = out.deviation < 0, size_in_words(out.quantity, out.deviation, out.ci95)
    if out.quantity == "offset":
        return f"its mean {text} {'below' if negative else 'above'} its command's"
    word = "lag" if out.quantity == "delay" else out.quantity
    return f"{word} {text} {'less' if negative else 'more'}"


def size_in_words(quantity: str, value: float, ci95: Interval) -> str:
    """Return the magnitude of a difference with its interval, in percent, degrees or ms."""
    sign = -1.0 if value < 0 else 1.0
    low, high = sorted(sign * end for end in ci95)
    size = Estimate(sign * value, (low, high))
    if quantity == "gain":
        return formats.estimate(formats.scaled(size, 100.0), " %", most=2)
    if quantity == "delay":
        return formats.estimate(formats.scaled(size, 1e3), " ms", most=2)
    return formats.estimate(formats.degrees(size), "°", most=2)


def low_gains(joints: Sequence[JointTracking]) -> tuple[JointTracking, ...]:
    """Return joints whose gain is low, without anything to compare it with.

    Of a motion within twice what healthy joints rest off, play and stick leave any gain.
    """
    return tuple(
        joint
        for joint in joints
        if joint.explained >= HALF
        and joint.commanded_rad > 2 * LARGEST_REST_RAD
        and joint.gain.ci95 is not None
        and joint.gain.ci95[1] < 1
        and (joint.gain.value or 0.0) < LOW_GAIN
    )


def low_gains_in_words(joints: Sequence[JointTracking]) -> str:
    """Return them as a clause, e.g. ``Pitch, Elbow follow with gains of 0.82 and 0.8``."""
    gains = [f"{joint.gain.value or 0.0:.2g}" for joint in joints]
    if len(joints) == 1:
        return f"{plain(joints[0].joint)} follows with a gain of {gains[0]}"
    if len(joints) > NAMED:
        return f"{len(joints)} joints follow with gains of {min(gains)} to {max(gains)}"
    names = ", ".join(plain(joint.joint) for joint in joints)
    return f"{names} follow with gains of {', '.join(gains[:-1])} and {gains[-1]}"
