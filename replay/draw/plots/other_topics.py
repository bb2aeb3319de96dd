"""What a bag of another make has beside joints: numbers as plots, words as events.

A topic of any type is plotted field by field, as logged, as long as its first message holds few
numbers; images, clouds and transforms are left out, and a note names them. Sessions of undulog have
views of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import rerun as rr

from undulog.capture import SessionView
from undulog.capture.common.errors import DataError
from undulog.capture.log.columns.topics import Channel

from ...content.content import Signal
from ...content.entities import Series
from ...samples.quantities import topic_entity
from ...samples.sampling import mark_gaps, ordered
from ...samples.stretches import stretch_length_ns
from ...samples.timeline import Clock
from ...samples.tracks import JOINT_STATE
from .gait import EVENTS, changes
from .joints import joint_palette, log_look, log_rows

OTHERS = "/others"

MOST_NUMBERS = 128
"""In a message; one with more of them is a picture, not a few lines."""
MOST_LINES = 12

_WORDS = "std_msgs/msg/String"
_SHOWN_ELSEWHERE = {"/gait/mode", "/rosout", "/robot_description"}
_TAKE_TURNS = {"tf2_msgs/msg/TFMessage"}
"""Types whose messages are each about something else."""
_NOT_PLOTTED = ("covariance", "stamp", "layout", "header")


def is_foreign(session: SessionView) -> bool:
    """Whether undulog has neither recorded nor imported a session.

    Args:
        session: The session.

    Returns:
        True where it doesn't carry undulog's metadata.
    """
    return "undulog" not in session.metadata


def log_others(
    rec: rr.RecordingStream, clock: Clock, session: SessionView, warnings: list[str]
) -> tuple[Signal, ...]:
    """Plot the numbers of every other topic of a foreign bag.

    Args:
        rec: The recording.
        clock: Its timelines.
        session: The session.
        warnings: Grows by a sentence that names the topics left out.

    Returns:
        A signal a topic; none for a session of undulog's own.
    """
    found: list[Signal] = []
    left_out: list[str] = []
    for topic, channel in _others(session):
        if channel.type_name == _WORDS:
            continue
        lines = _lines(session, topic) if _is_plotted(session, channel) else ()
        if not lines:
            left_out.append(f"{topic} ({channel.type_name or channel.encoding})")
            continue
        entity = topic_entity(OTHERS, topic)
        log_look(rec, entity, lines, joint_palette(lines))
        rec.flush()  # else what comes first in the file is chance
        for table in _tables(session, topic):
            known = [line for line in lines if line in table.columns]
            values = np.full((len(table), len(lines)), np.nan)
            values[:, [lines.index(line) for line in known]] = table[known].to_numpy(np.float64)
            t_ns = table.index.to_numpy(dtype=np.int64)
            log_rows(rec, clock, entity, *mark_gaps(*ordered(t_ns, values)))
        found.append(Signal(topic.lstrip("/"), (Series(entity, lines),), of_joints=False))
    if left_out:
        warnings.append(f"not shown: {', '.join(left_out)}")
    return tuple(found)


def log_words(rec: rr.RecordingStream, clock: Clock, session: SessionView) -> bool:
    """Write what String topics of a foreign bag say, each time that it changes, as events.

    Args:
        rec: The recording.
        clock: Its timelines.
        session: The session.

    Returns:
        Whether there was any.
    """
    said: list[tuple[int, str]] = []
    for topic, channel in _others(session):
        if channel.type_name == _WORDS and channel.is_ros2:
            messages = [
                (t_ns, str(message.data))
                for t_ns, message in session.messages(topic)
                if hasattr(message, "data")  # a log's own definition of the type may lack it
            ]
            turns = changes([word for _, word in messages])
            said += [(messages[i][0], f"{topic}: {messages[i][1]}") for i in turns]
    said.sort()
    t_ns = np.array([time for time, _ in said], dtype=np.int64)
    texts = [text for _, text in said]
    for rows, times in clock.rows(t_ns):
        levels = [rr.TextLogLevel.INFO] * (rows.stop - rows.start)
        rec.send_columns(
            f"{EVENTS}/said", times, rr.TextLog.columns(text=texts[rows], level=levels)
        )
    return bool(said)


def _others(session: SessionView) -> Iterator[tuple[str, Channel]]:
    if not is_foreign(session):
        return
    for topic, channel in session.channels.items():
        if channel.count and channel.type_name != JOINT_STATE and topic not in _SHOWN_ELSEWHERE:
            yield topic, channel


def _is_plotted(session: SessionView, channel: Channel) -> bool:
    if not channel.is_ros2 or channel.type_name in _TAKE_TURNS:
        return False
    try:
        _, message = next(session.messages(channel.topic))
    except (DataError, StopIteration):
        return False
    return _count(message) <= MOST_NUMBERS


def _count(value: Any) -> int:
    """Numbers in a message, without looking into long arrays one by one."""
    if isinstance(value, (str, bool)) or value is None:
        return 0
    if isinstance(value, (int, float)):
        return 1
    if isinstance(value, (bytes, bytearray, memoryview, np.ndarray)):
        return len(cast("bytes", value))
    if isinstance(value, (list, tuple)):
        many = cast("list[Any]", value)
        if len(many) > MOST_NUMBERS:
            return len(many)
        return sum(_count(one) for one in many)
    return sum(_count(getattr(value, name)) for name in getattr(value, "__slots__", ()))


def _lines(session: SessionView, topic: str) -> tuple[str, ...]:
    """Fields to plot: those that vary first, if they are many."""
    for table in _tables(session, topic):
        numbers = table.select_dtypes("number")
        names = [
            str(name)
            for name in numbers.columns
            if not any(word in str(name) for word in _NOT_PLOTTED)
        ]
        moving = {name for name in names if numbers[name].nunique() > 1}
        chosen = sorted(names, key=lambda name: name not in moving)[:MOST_LINES]
        return tuple(name for name in names if name in chosen)
    return ()


def _tables(session: SessionView, topic: str) -> Iterator[Any]:
    """The topic's tables, stretch by stretch, those with rows."""
    length_ns = stretch_length_ns(session)
    for start_ns in range(session.start_ns, session.end_ns + 1, length_ns):
        table = session.table(topic, start_ns=start_ns, stop_ns=start_ns + length_ns)
        session.forget()
        if len(table):
            yield table
