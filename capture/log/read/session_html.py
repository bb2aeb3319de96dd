"""A session for a notebook: what it is, its topics, and its warnings."""

from __future__ import annotations

from datetime import UTC, datetime
from html import escape
from typing import TYPE_CHECKING

from ...common.amounts import format_size
from ...common.console import plain

if TYPE_CHECKING:
    from ..columns.topics import Channel
    from .session_view import SessionView

_HEAD = "".join(f"<th>{name}</th>" for name in ("topic", "type", "messages", "rate [Hz]", "unit"))

MOST_TOPICS = 40
"""Rows of the table at most."""


def session_html(session: SessionView) -> str:
    """Return a session as HTML; nothing of it is read that is not read when it is opened."""
    robot = session.robot
    who = "no robot description" if robot is None else f"{robot.name}, {len(robot.joints)} joints"
    verdict = f", verdict {session.verdict}" if session.verdict else ""
    head = f"{session.path.name}: {who}, {_length(session)}{verdict}, {format_size(session.size)}"
    topics = sorted(session.channels.items())
    rows = "".join(_row(channel, session.duration_s) for _, channel in topics[:MOST_TOPICS])
    left = len(topics) - MOST_TOPICS
    more = f"<p>{left} more topics in channels</p>" if left > 0 else ""
    remarks = "".join(f"<li>{_text(one)}</li>" for one in session.warnings)
    warnings = f"<details open><summary>warnings</summary><ul>{remarks}</ul></details>"
    return (
        f"<p><strong>{_text(head)}</strong></p><table><thead><tr>{_HEAD}</tr></thead>"
        f"<tbody>{rows}</tbody></table>"
        f"{more}{warnings if remarks else ''}"
    )


def _row(channel: Channel, seconds: float) -> str:
    rate = f"{channel.count / seconds:.4g}" if seconds > 0 else ""
    unit = channel.metadata.get("unit", "")
    cells = (channel.topic, channel.type_name, str(channel.count), rate, unit)
    return f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in cells)}</tr>"


def _length(session: SessionView) -> str:
    if not any(channel.count for channel in session.channels.values()):
        return "no messages"
    start = datetime.fromtimestamp(session.start_ns // 1_000_000_000, UTC)
    return f"{session.duration_s:.2f} s from {start:%Y-%m-%d %H:%M:%S} UTC"


def _text(text: str) -> str:
    return escape(plain(text))
