"""Values that seem to stand, where the joint follows its command all the same."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from ..judgement.measure import Following
from .result import Artefact, overlapping

_STANDING = frozenset({("position", "frozen"), ("position", "clipped"), ("effort", "stalled")})
"""Artefacts of a joint that stands; whether it had to move decides."""


_REPEATED = _STANDING | {("position", "stale")}
"""Artefacts that frames of made times show of what is sampled more slowly."""


def unrefuted(artefacts: Iterable[Artefact], follows: Following) -> tuple[Artefact, ...]:
    """Leave out values that seem to stand where the joint follows its command all the same.

    A joint that was not asked to move may stand, too; of one that doesn't follow for a while, what
    stands at other times is left out.

    Args:
        follows: How the joints follow.

    Returns:
        The others, in their order.
    """
    judgement = follows.judgement
    standing = _REPEATED if follows.in_frames else _STANDING
    decided = bool(judgement.judged or judgement.unexposed or follows.in_frames)
    faults = {fault.joint: fault.spans_s for fault in judgement.faults}
    left: list[Artefact] = []
    for artefact in artefacts:
        if (artefact.quantity, artefact.flag) not in standing:
            left.append(artefact)
        elif artefact.joint in faults:
            spans = [
                span for span in artefact.spans_s if overlapping(faults[artefact.joint], *span)
            ]
            left += [replace(artefact, spans_s=tuple(spans))] if spans else []
        elif not (decided and artefact.joint in follows.commanded):
            left.append(artefact)
    return tuple(left)
