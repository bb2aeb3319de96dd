"""The part that judges whether joints follow their commands."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.answer import NotFollowing
from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..part import Part, Results
from .measure import Following, following, not_following


@dataclass(frozen=True)
class Judged:
    """How the joints follow their commands.

    Attributes:
        following: Of the joints that are commanded.
        faulty: Joints that don't follow.
    """

    following: Following
    faulty: tuple[NotFollowing, ...]


def _judgement(signals: Signals, done: Results, remarks: Remarks) -> Judged:
    follows = following(signals.session, signals.columns, signals.recorded)
    return Judged(follows, not_following(follows))


JUDGEMENT = Part("judgement", _judgement)

PARTS = (JUDGEMENT,)
