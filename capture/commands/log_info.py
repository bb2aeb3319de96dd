"""Command ``log info``: what a log holds, of our making or not."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..common.console import echo, emit_json
from ..common.errors import DataError
from ..log.columns.topics import Channel
from ..log.messages.frames import FD_TOPIC_PREFIX
from ..log.read.session import Session

_MESSAGES_PER_LOOK = 1000


def describe(session: Session) -> dict[str, Any]:
    """Return the contents of a session as plain JSON values.

    Returns:
        ``session``, ``topics`` (in order of name), ``metadata``, ``attachments``, ``warnings``. A
        topic's ``read`` states whether its messages can be read: those of other encodings are only
        listed; ``frames`` is the number of CAN FD frames of their topics, None for others. Without
        messages there is no start.
    """
    seconds = session.duration_s
    empty = not any(channel.count for channel in session.channels.values())
    topics = [
        {
            "topic": channel.topic,
            "type": channel.type_name,
            "messages": channel.count,
            "rate_hz": round(channel.count / seconds, 3) if seconds > 0 else None,
            "unit": channel.metadata.get("unit"),
            "encoding": channel.encoding or None,
            "schema": channel.schema_encoding or None,
            "read": channel.is_ros2,
            "frames": _fd_frames(session, channel),
        }
        for _, channel in sorted(session.channels.items())
    ]
    return {
        "session": {
            "id": session.session_id,
            "path": str(session.path),
            "robot": session.robot.name if session.robot is not None else None,
            "joints": len(session.robot.joints) if session.robot is not None else None,
            "start_ns": None if empty else session.start_ns,
            "start_utc": None if empty else _utc(session.start_ns),
            "duration_s": seconds,
            "size_bytes": sum(path.stat().st_size for path in session.files),
            "files": [path.name for path in session.files],
            "profile": session.profile,
            "library": session.library,
            "verdict": session.verdict,
        },
        "topics": topics,
        "metadata": {name: dict(facts) for name, facts in session.metadata.items()},
        "attachments": {name: len(data) for name, data in session.attachments.items()},
        "warnings": session.warnings,
    }


def _fd_frames(session: Session, channel: Channel) -> int | None:
    """Count the CAN FD frames of a topic, a window at a time; None for any other topic."""
    if not channel.topic.startswith(FD_TOPIC_PREFIX) or not channel.is_ros2:
        return None
    windows = max(1, channel.count // _MESSAGES_PER_LOOK)
    span_ns = session.end_ns - session.start_ns
    edges = [session.start_ns + span_ns * k // windows for k in range(windows)]
    try:
        return sum(
            len(session.fd_frames(channel.topic, start_ns=start_ns, stop_ns=stop_ns))
            for start_ns, stop_ns in pairwise([*edges, None])
        )
    except DataError:  # a foreign topic of that name
        return None


def log_info(file: Path, /, *, json: bool = False) -> None:
    """Show what a log holds: robot, times, topics, attachments, and what is wrong with it.

    Example: `undulog log info run.mcap`

    Args:
        file: An MCAP file, of any make; of a split session any part, or the folder.
        json: Print one JSON object.
    """
    with Session.open(file) as session:
        facts = describe(session)
    if json:
        emit_json(facts)
    else:
        _print_facts(facts)


def _print_facts(facts: dict[str, Any]) -> None:
    session = facts["session"]
    robot = f"{session['robot']}, {session['joints']} joints" if session["robot"] else "no robot"
    messages = sum(topic["messages"] for topic in facts["topics"])
    parts = f" in {len(session['files'])} parts" if len(session["files"]) > 1 else ""
    held = (
        f"{session['duration_s']:.2f} s from {session['start_utc']}, {messages} messages"
        if session["start_utc"]
        else "no messages"
    )
    echo(f"{session['id']}: {robot}, {held}, {_size(session['size_bytes'])}{parts}")
    echo(*(f"warning: {warning}" for warning in facts["warnings"]))
    foreign = Counter(t["encoding"] or "no encoding" for t in facts["topics"] if not t["read"])
    if foreign:
        order = sorted(foreign.items(), key=lambda item: (-item[1], item[0]))
        listed = ", ".join(f"{encoding} {count}" for encoding, count in order)
        topics = "1 topic is" if foreign.total() == 1 else f"{foreign.total()} topics are"
        echo(f"warning: {topics} not of ROS 2 and can't be read, only listed: {listed}")
    names = [_type(topic) for topic in facts["topics"]]
    width = max([len(topic["topic"]) for topic in facts["topics"]] + [5])
    kinds = max([len(name) for name in names] + [4])
    echo("", f"{'topic':<{width}}  {'type':<{kinds}}  {'messages':>8}  {'rate/Hz':>8}  unit")
    for topic, name in zip(facts["topics"], names, strict=True):
        rate = f"{topic['rate_hz']:8.1f}" if topic["rate_hz"] is not None else " " * 8
        held = f"{topic['frames']} frames" if topic["frames"] is not None else topic["unit"] or ""
        echo(
            f"{topic['topic']:<{width}}  {name:<{kinds}}  {topic['messages']:>8}  "
            f"{rate}  {held}".rstrip()
        )
    if facts["attachments"]:
        listed = (f"{name} ({size} bytes)" for name, size in facts["attachments"].items())
        echo("", f"attached: {', '.join(listed)}")
    writer = session["library"] or "an unnamed program"
    echo(f"verdict: {session['verdict'] or 'none stored'}; written by {writer}")


def _type(topic: dict[str, Any]) -> str:
    """Return a topic's type, with the encodings where they aren't those of ROS 2."""
    if topic["read"]:
        return topic["type"]
    encodings = f"{topic['encoding'] or 'no encoding'}, {topic['schema'] or 'no schema'}"
    return f"{topic['type']} ({encodings})".lstrip()


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f} MB" if size_bytes >= 1e5 else f"{size_bytes / 1e3:.1f} kB"


def _utc(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
