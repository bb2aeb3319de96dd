"""The session in words: the answer first, what it is next, how it was drawn last."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from undulog.analysis.results.analysis import Analysis, GaitFacts, GroupFacts
from undulog.analysis.results.formats import utc
from undulog.capture import SessionView
from undulog.capture.common.console import plain

from ..samples.content import Content, Named
from ..samples.timeline import ENSEMBLE_CYCLE

if TYPE_CHECKING:
    import rerun as rr

FACTS = "/session"

_MARKUP = re.compile(r"([\\`*_{}\[\]<>()#+!|~&$])")


def escaped(text: str) -> str:
    """Escape text with names from a log for Markdown.

    Returns:
        One line of Markdown that shows it and marks nothing up.
    """
    return _MARKUP.sub(r"\\\1", plain(text))


def code(text: str) -> str:
    """Return a name from a log as a code span of Markdown, valid in tables too.

    Returns:
        A code span of one line; the text itself where it has a backtick.
    """
    return escaped(text) if "`" in text else f"`{plain(text)}`".replace("|", r"\|")


def markdown(
    session: SessionView,
    analysis: Analysis | None,
    *,
    notes: Sequence[str],
    colors: str,
    content: Content,
    named: Sequence[Named] = (),
    has_cycles: bool,
    awaited: bool = False,
) -> str:
    """Return the text that is shown beside the picture, as Markdown.

    Args:
        analysis: Its analysis, or None where there is none.
        notes: What is missing or was assumed, a sentence each.
        colors: What the body's colours mean.
        has_cycles: Whether there is a timeline of gait cycles.
        awaited: Whether its analysis is still to come.
    """
    verdict = session.metadata.get("undulog.health", {}).get("verdict")
    recorded = session.metadata.get("undulog", {}).get("undulog")
    facts = (
        code(session.session_id),
        _robot(session),
        f"{session.duration_s:.1f} s",
        utc(session.start_ns),
        *_gait(analysis),
        *([f"verdict {escaped(verdict)}"] if verdict else []),
        *([f"recorded by undulog {escaped(recorded)}"] if recorded else []),
    )
    awaited_text = "Being analysed: the answer comes in a moment." if awaited else "Not analysed."
    joints = ", ".join(f"{escaped(one.joint)} ({escaped(one.why)})" for one in named)
    return document(
        [
            f"**{escaped(awaited_text if analysis is None else analysis.answer.sentence)}**",
            f"**Named, pink in the pictures:** {joints}" if named else "",
            " · ".join(facts),
            listed([*notes, *(() if analysis is None else analysis.warnings)]),
            _legend(colors, content, has_cycles=has_cycles),
        ]
    )


def document(paragraphs: Sequence[str]) -> str:
    """Markdown of those paragraphs that aren't empty."""
    return "\n\n".join(filter(None, paragraphs)) + "\n"


def listed(notes: Sequence[str]) -> str:
    """Notes as a list in Markdown, each once."""
    return "\n".join(f"- {escaped(note)}" for note in dict.fromkeys(notes))


def _legend(colors: str, content: Content, *, has_cycles: bool) -> str:
    """What lines, bars and timelines mean."""
    words = [f"{colors}."] if content.start is not None else []
    if content.commanded:
        words.append("Grey is commanded.")
    if content.charts:
        words.append(
            "Coloured bars: the analysed stretch, a whisker to the far end of the 95 % interval."
        )
    if content.charts and content.cycles:
        words.append("White bars: the cycle at the cursor; energies are of one cycle.")
    if has_cycles:
        words.append("On `gait_cycle` one second is one cycle of the gait.")
    if content.mean is not None:
        words.append(
            f"`{ENSEMBLE_CYCLE}` plays the mean cycle by degrees of phase (tab *Mean cycle*)."
        )
    return " ".join(words)


def log_facts(rec: rr.RecordingStream, text: str, entity: str = FACTS) -> None:
    """Write the session's facts as Markdown."""
    import rerun as rr

    rec.log(entity, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)


def _robot(session: SessionView) -> str:
    if session.robot is None:
        return "no robot description"
    count = len(session.robot.joints)
    return f"{session.robot.name}, {count} joint{'s' if count != 1 else ''}"


def _gait(analysis: Analysis | None) -> list[str]:
    if analysis is None or analysis.gait.frequency_hz.value is None:
        return []
    groups = analysis.gait.groups
    if len(groups) > 1:
        return [_wave(group, f" ({len(group.joints)} joints)") for group in groups]
    return [_wave(analysis.gait)]


def _wave(gait: GaitFacts | GroupFacts, joints: str = "") -> str:
    """Frequency, number of joints and wave of one group, or of all joints."""
    parts = [f"{gait.frequency_hz.value:.3f} Hz{joints}"]
    if gait.wave is not None:
        parts.append(f"wave {gait.wave}")
    lags = gait.lag_per_joint_rad.items()
    parts += [f"{math.degrees(lag):.1f}° a joint ({plane})" for plane, lag in lags]
    return ", ".join(parts)
