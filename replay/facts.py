"""The session in words: the answer first, what it is next, how it was drawn last."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import rerun as rr

from analysis.result import Analysis, Estimate, JointResult
from capture import Session

FACTS = "/session"


def markdown(
    session: Session,
    analysis: Analysis | None,
    *,
    notes: Sequence[str],
    colors: str,
    has_cycles: bool,
) -> str:
    """What a reader needs beside the picture.

    Args:
        session: The session.
        analysis: Its analysis, or None where there is none.
        notes: What is missing or was assumed, a sentence each.
        colors: What the body's colours mean.
        has_cycles: Whether there is a timeline of gait cycles.

    Returns:
        Markdown.
    """
    facts = (
        f"`{session.session_id}`",
        _robot(session),
        f"{session.duration_s:.1f} s",
        _utc(session.start_ns),
        *_gait(analysis),
        *_health(session.metadata),
        *_versions(session.metadata),
    )
    parts = [f"**{answer(analysis)}**", " · ".join(facts)]
    told = dict.fromkeys([*notes, *(() if analysis is None else analysis.warnings)])
    if told:
        parts.append("\n".join(f"- {note}" for note in told))
    legend = f"{colors}. Grey is commanded."
    if has_cycles:
        legend += " On `gait_cycle` one second is one cycle of the gait."
    parts.append(legend)
    return "\n\n".join(parts) + "\n"


def answer(analysis: Analysis | None) -> str:
    """The session's result in one line.

    Args:
        analysis: The session's analysis, or None.

    Returns:
        Lag and gain of the first, middle and last joint that respond to the gait.
    """
    if analysis is None:
        return "Not analysed"
    found = [j for j in analysis.joints if j.lag_rad.value is not None]
    if not found:
        return "No response to a gait could be measured"
    three = list(dict.fromkeys((0, len(found) // 2, len(found) - 1)))
    lags = ", ".join(_lag(found[i]) for i in three)
    return f"Lag behind the command: {lags}"


def log_facts(rec: rr.RecordingStream, text: str) -> None:
    """Write the session's facts.

    Args:
        rec: The recording.
        text: Markdown.
    """
    rec.log(FACTS, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)


def _lag(joint: JointResult) -> str:
    return f"{_degrees(joint.lag_rad)} at {joint.name}"


def _degrees(estimate: Estimate) -> str:
    """Value and half the interval, the latter rounded up."""
    value = math.degrees(estimate.value or 0.0)
    if estimate.ci95 is None:
        return f"{value:.1f}°"
    half = math.degrees(estimate.ci95[1] - estimate.ci95[0]) / 2.0
    digits = 2 if half < 0.1 else 1
    return f"{value:.{digits}f} ± {math.ceil(half * 10**digits) / 10**digits:.{digits}f}°"


def _robot(session: Session) -> str:
    if session.robot is None:
        return "no description in the session"
    count = len(session.robot.joints)
    return f"{session.robot.name}, {count} joint{'s' if count != 1 else ''}"


def _utc(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _gait(analysis: Analysis | None) -> list[str]:
    if analysis is None or analysis.gait.frequency_hz.value is None:
        return []
    text = f"{analysis.gait.frequency_hz.value:.3f} Hz"
    if analysis.gait.wave is not None:
        text += f", wave {analysis.gait.wave}"
    for plane, lag in analysis.gait.lag_per_joint_rad.items():
        text += f", {math.degrees(lag):.1f}° a joint ({plane})"
    return [text]


def _health(metadata: Mapping[str, Mapping[str, str]]) -> list[str]:
    verdict = metadata.get("undulog.health", {}).get("verdict")
    return [f"verdict {verdict}"] if verdict else []


def _versions(metadata: Mapping[str, Mapping[str, str]]) -> list[str]:
    recorded = metadata.get("undulog", {}).get("undulog")
    return [f"recorded by undulog {recorded}"] if recorded else []
