"""Right or wrong: what a session states against what was planted in it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from .adapter import Said
from .judging import MOST_NAMED, named_in
from .planted import PlantedJoint

PERIODS, SHARE = 2.0, 0.1
"""An onset is right within so many periods of the motion, or so much of the record."""


@dataclass(frozen=True)
class Verdict:
    """A judged statement; of a healthy robot all but the first four are as good as unused.

    Attributes:
        accusations: Joints accused in which nothing was planted.
        differences: Joints stated to differ in which nothing was planted.
        shaped: Whether a shape along the joints is stated.
        alike: Whether all are stated to be alike.
        joint: Whether all planted joints are named.
        kind: Whether all their kinds or quantities are right.
        onset: Whether all onsets that were planted are right.
        silent: Whether nothing is stated of any joint, and that is left open.
    """

    accusations: tuple[str, ...]
    differences: tuple[str, ...]
    shaped: bool
    alike: bool
    joint: bool = True
    kind: bool = True
    onset: bool = True
    silent: bool = False

    @property
    def right(self) -> bool:
        """Whether what is said of a planted fault is right, and no sound joint is accused.

        Its onset has a count of its own.
        """
        return self.joint and self.kind and not (self.accusations or self.alike)


def judged(
    statement: Said,
    names: Sequence[str],
    joints: Sequence[PlantedJoint],
    *,
    period_s: float,
    length_s: float,
    undecidable: bool = False,
) -> Verdict:
    """Judge a statement.

    Args:
        statement: The statement.
        names: Of all joints.
        joints: Right statements about the joints in which something was planted.
        period_s: Of the motion [s].
        length_s: Of the record [s].
        undecidable: Whether it is as right to leave open which joints differ.
    """
    planted = {names[joint.joint]: joint for joint in joints}
    blamed = (*(a.joint for a in statement.accused), *statement.doubted)
    accused = tuple(dict.fromkeys(name for name in blamed if name not in planted))
    # Of a rest it is stated where the joint was; it is compared with no other.
    compared = [d for d in statement.different if d.quantity != "rest"]
    different = dict.fromkeys(d.joint for d in compared if d.joint not in planted)
    stated = {a.joint for a in statement.accused} | {d.joint for d in statement.different}
    slack_s = max(PERIODS * period_s, SHARE * length_s)
    verdict = Verdict(
        accused, tuple(different), statement.shaped, statement.alike, silent=not stated
    )
    if not planted:
        return verdict
    if undecidable and statement.not_decided and not stated:
        return replace(verdict, silent=False)
    in_sentence = named_in(statement.sentence, names)
    expected = min(len(planted), MOST_NAMED)
    is_named = planted.keys() <= stated
    is_named &= len([name for name in in_sentence if name in planted]) >= expected
    return replace(
        verdict,
        joint=is_named,
        kind=all(_kind_is_right(statement, name, joint) for name, joint in planted.items()),
        onset=all(
            _onset_is_right(statement, name, joint, slack_s) for name, joint in planted.items()
        ),
    )


def _kind_is_right(statement: Said, name: str, joint: PlantedJoint) -> bool:
    """Whether the kinds stated name the fault and no other, or the right quantity differs."""
    kinds = frozenset().union(*(a.kinds for a in statement.accused if a.joint == name))
    if kinds:
        return bool(kinds & joint.names) and kinds <= joint.allowed
    return any(
        d.quantity in joint.quantities and (joint.sign == 0 or d.value * joint.sign > 0)
        for d in statement.different
        if d.joint == name
    )


def _onset_is_right(statement: Said, name: str, joint: PlantedJoint, slack_s: float) -> bool:
    """Whether an onset stated is that of the fault; one from the beginning has none."""
    onsets = [a.since_s for a in statement.accused if a.joint == name]
    onsets += [d.onset_s for d in statement.different if d.joint == name]
    if not onsets:
        return joint.since_s is None
    return any(abs((onset or 0.0) - (joint.since_s or 0.0)) <= slack_s for onset in onsets)
