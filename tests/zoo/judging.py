"""Right or wrong: statements of outputs against the truth."""

import re
from dataclasses import dataclass

import numpy as np

MOST_NAMED = 4
"""So many joints a sentence must name; with more it may count the rest."""


DETECTION = "detection"

SHOWN = {
    "offset": frozenset({"slipped", "slipped_sensor", "drifting_sensor"}),
    "noise": frozenset({"noisy_sensor"}),
}
"""Quantities whose change shows kinds of fault."""

LOOP = frozenset({"jammed", "dead", "stalled", "frozen_sensor"})
"""Kinds that effort and velocity of a servo's own loop can't separate."""


@dataclass(frozen=True)
class Judgement:
    """One output of one session.

    Attributes:
        missing: Why it is wrong, a phrase each; right if empty.
        sound: Sound joints that it names.
        narrow: Whether it states fewer kinds than the data can't separate, the true one among
            them: right here, but a matter of luck.
    """

    missing: tuple[str, ...] = ()
    sound: tuple[str, ...] = ()
    narrow: bool = False

    @property
    def right(self):
        """Whether nothing is wrong; sound joints are counted apart."""
        return not self.missing


def named_in(text, names):
    """Return the joints whose names a text contains as whole words, in order."""
    starts = {}
    for name in names:
        if match := re.search(rf"(?<![\w/]){re.escape(name)}(?![\w/])", text):
            starts[name] = match.start()
    return sorted(starts, key=starts.__getitem__)


def judge(output, statement, truth, robot):
    """Judge the statement of an output against the planted truth."""
    if statement.error:
        return Judgement((f"error: {statement.error}",))
    planted = {robot.names[joint.joint]: joint for joint in truth.joints}
    expected = [name for name, joint_truth in planted.items() if _must_name(output, joint_truth)]
    first = named_in(statement.text, robot.names)
    listed = [*(statement.not_following or ()), *(statement.stands_out or ())]
    listed += list(statement.changes)
    sound = tuple(dict.fromkeys(n for n in [*listed, *first] if n not in planted))
    if truth.undecided and output != "compare":
        return _undecided(statement, [*listed, *first])
    missing = [f"{name} not in its sentence" for name in expected[:MOST_NAMED] if name not in first]
    if len(expected) > MOST_NAMED:  # any of them will do: the worst come first
        short = len([name for name in expected if name in first]) < MOST_NAMED
        missing = [f"names fewer than {MOST_NAMED} of {len(expected)} joints"] if short else []
    if output == "compare" and expected and first and first[0] not in planted:
        missing.append(f"names {first[0]} first")
    if expected and output != "log check" and statement.alike:
        missing.append("claims alike")
    if not planted and output == "log check" and not statement.alike:
        missing.append("calls a healthy bag less than good")
    narrow = False
    for name, planted_fault in planted.items() if statement.not_following is not None else ():
        wrong, few = _of_joint(name, planted_fault, statement, robot, outside=output == DETECTION)
        missing += wrong
        narrow |= few
    return Judgement(tuple(missing), sound, narrow)


def _must_name(output, truth):
    """Whether an output has to name a joint; what a joint stands out by is not for all."""
    if output == "log check":
        return truth.checked
    if output == "compare":
        return truth.compared
    return output != "detection" or not truth.stands_out


def _undecided(statement, named):
    """Of too few joints none may be named; any that is may as well be sound."""
    missing = ["does not say that no joint can be named"] if statement.undecided is False else []
    if named:
        missing.append(f"names {named[0]} although none can be named")
    return Judgement(tuple(missing))


def _of_joint(name, truth, statement, robot, *, outside):
    """What is wrong in the lists about one planted joint; whether its kinds are too few."""
    stated = (statement.not_following or {}).get(name)
    changed = statement.changes.get(name, frozenset())
    shown = (statement.stands_out or {}).get(name, frozenset()) | changed
    shown_kinds = frozenset().union(*(SHOWN.get(quantity, frozenset()) for quantity in changed))
    elsewhere = statement.stands_out is None and (truth.stands_out or not truth.names)
    if shown_kinds & truth.names or changed & truth.stands_out or (stated is None and elsewhere):
        return [], False  # by what changed, or left to another output
    if stated is None:
        if shown & truth.stands_out:
            return [], False
        if shown:
            return [f"{name} stands out by {_listed(shown)} only"], False
        return [f"{name} not listed"], False
    if not truth.names:
        return [f"{name} listed as {_listed(stated.kinds)}, but follows"], False
    wrong = []
    if not stated.kinds & truth.names:
        wrong.append(f"{name}: {_listed(stated.kinds)} lacks {_listed(truth.names, ' or ')}")
    allowed = truth.allowed
    if not outside and allowed & LOOP:  # a bag doesn't say where effort and velocity are measured
        allowed |= LOOP
    if excess := stated.kinds - allowed:
        wrong.append(f"{name}: {_listed(excess)} excluded by the data")
    wrong += _onset(name, truth, stated.since_s, robot)
    return wrong, stated.kinds < allowed


def _onset(name, truth, since_s, robot):
    """An onset that is off by more than a cycle and a half, and half a second."""
    if truth.since_s is None:
        return []
    slack = 1.5 * 2 * np.pi / robot.omega + 0.5
    if abs((since_s or 0.0) - truth.since_s) <= slack:
        return []
    return [f"{name} since {since_s} s, not {truth.since_s:.1f} s"]


def _listed(words, by=", "):
    return by.join(sorted(words))
