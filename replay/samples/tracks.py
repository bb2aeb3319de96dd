"""Joint samples as they are drawn: each joint's own times, joints sampled together in one table."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.bus.decoded_topics import JOINT_TOPIC
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.log.read.signals import JointSignals

from .sampling import interpolate, ordered

JOINT_STATE = "sensor_msgs/msg/JointState"

OFFSETS = ("/joint_sample_offset", "/joint_command_offset")
"""JointState topics that say when, not what."""

Columns = dict[tuple[str, str], tuple["Track", ...]]
"""(topic, field of the JointState) to tracks."""

Resampler = Callable[[IntArray, FloatArray, IntArray], FloatArray]


@dataclass(frozen=True)
class Track:
    """One quantity of one joint.

    Attributes:
        name: The joint's name.
        t_ns: Its own sampling times [ns], ascending, shape (n,).
        values: In SI, shape (n,); NaN where the sample is missing.
    """

    name: str
    t_ns: IntArray
    values: FloatArray


@dataclass(frozen=True)
class Table:
    """Joints that were sampled at the same times.

    Attributes:
        names: Joint names, shape (k,).
        t_ns: Their sampling times [ns], shape (n,).
        values: In SI, shape (n, k).
    """

    names: tuple[str, ...]
    t_ns: IntArray
    values: FloatArray


MOST_JOINTS = 1000
"""Of a topic that is drawn."""
MOST_TOPICS = 100
"""JointState topics that are drawn."""


def drawn_topics(session: SessionView) -> tuple[list[str], int]:
    """The JointState topics of a picture.

    Returns:
        At most :data:`MOST_TOPICS`, the contract's before others, in the session's order; and how
        many are left out.
    """
    topics = [
        topic
        for topic, channel in session.channels.items()
        if channel.type_name == JOINT_STATE and channel.count and topic not in OFFSETS
    ]
    usual = set(JOINT_TOPIC.values())
    first = set(sorted(topics, key=lambda topic: topic not in usual)[:MOST_TOPICS])
    return [topic for topic in topics if topic in first], len(topics) - len(first)


def wanted_fields(session: SessionView) -> dict[str, list[str]]:
    """What a picture needs of a session's JointState topics.

    Returns:
        Topic to fields: the position of every topic, velocity and effort of ``/joint_states``.
    """
    wanted = {topic: ["position"] for topic in drawn_topics(session)[0]}
    if "/joint_states" in wanted:
        wanted["/joint_states"] += ["velocity", "effort"]
    return wanted


def read_columns(
    session: SessionView,
    wanted: Mapping[str, Sequence[str]] | None = None,
    *,
    start_ns: int | None = None,
    stop_ns: int | None = None,
) -> Columns:
    """JointState topics of a session.

    Args:
        wanted: Topic to fields; None for all of :func:`wanted_fields`.
        start_ns: First sampling time wanted [Unix ns]; None for the session's start.
        stop_ns: One past the last sampling time wanted [Unix ns]; None for the end.

    Returns:
        (topic, field) to a track for each joint that has at least one sample, in the session's
        order; without what never comes.

    Raises:
        DataError: If a topic has more than :data:`MOST_JOINTS`.
    """
    fields = wanted_fields(session) if wanted is None else wanted
    window = {"start_ns": start_ns, "stop_ns": stop_ns}
    try:
        columns = session.joint_columns(fields, **window)
    except (MissingChannelError, DataError):  # a field that never comes: take the others singly
        columns: dict[tuple[str, str], JointSignals] = {}
        for topic, field in [(one, field) for one in fields for field in fields[one]]:
            with contextlib.suppress(MissingChannelError, DataError):
                columns[topic, field] = session.joints(topic, field, **window)
    for (topic, _), signals in columns.items():
        if (count := len(signals.names)) > MOST_JOINTS:
            where = f"{session.path.name}: {topic} has {count} joints"
            raise DataError(f"{where}; at most {MOST_JOINTS} are drawn")
    found = {key: _tracks(signals) for key, signals in columns.items()}
    return {key: tracks for key, tracks in found.items() if tracks}


def _tracks(signals: JointSignals) -> tuple[Track, ...]:
    tracks = [
        without_filler(Track(name, *ordered(t_ns, values)))
        for name, t_ns, values in zip(signals.names, signals.t_ns, signals.values, strict=True)
    ]
    return tuple(track for track in tracks if np.isfinite(track.values).any())


def without_filler(track: Track) -> Track:
    """Leave out the NaN that only fill up messages about something else.

    A robot that reports one quantity, or one servo, a message fills the other places with NaN.
    Where half of a joint's samples or more are NaN they say nothing; fewer are a gap.

    Returns:
        The track without its NaN where they are half or more, else the track itself.
    """
    known = np.isfinite(track.values)
    if 2 * np.count_nonzero(known) > known.size:
        return track
    return Track(track.name, track.t_ns[known], track.values[known])


def pairs(first: Sequence[Track], second: Sequence[Track]) -> list[tuple[Track, Track]]:
    """Two quantities of each joint that has both, in the order of the first."""
    other = {track.name: track for track in second}
    return [(track, other[track.name]) for track in first if track.name in other]


def one_after_another(pieces: Sequence[Track]) -> Track:
    """Pieces of one track, at least one, as a whole."""
    t_ns = np.concatenate([piece.t_ns for piece in pieces])
    return Track(pieces[0].name, t_ns, np.concatenate([piece.values for piece in pieces]))


def tables(tracks: Sequence[Track]) -> tuple[Table, ...]:
    """Put joints that were sampled at the same times into one table each.

    Args:
        tracks: The tracks, in chain order.

    Returns:
        The tables, in the order of their first joints; one table where all joints share their
        times.
    """
    together: dict[bytes, list[Track]] = {}
    for track in tracks:
        together.setdefault(track.t_ns.tobytes(), []).append(track)
    return tuple(
        Table(
            tuple(track.name for track in group),
            group[0].t_ns,
            np.stack([track.values for track in group], axis=1),
        )
        for group in together.values()
    )


def in_turn(first: IntArray, other: IntArray) -> bool:
    """Whether two joints were sampled in turn: one of the other between any two of the first.

    Args:
        first: Sampling times of one joint [ns], ascending, shape (n,).
        other: Those of the other, shape (m,).

    Returns:
        Whether they take turns throughout.
    """
    place = np.searchsorted(first, other, side="right")
    inner = place[(place > 0) & (place < first.size)]
    return inner.size >= max(first.size - 2, 1) and bool(np.all(np.diff(inner) == 1))


def join_tracks(tracks: Sequence[Track]) -> Table:
    """Joints at the times of the first of them.

    Args:
        tracks: Joints that were sampled together or in turn, at least one.

    Returns:
        One table; the values of the others lie on the straight lines between their samples, which
        is what a plot draws of them.
    """
    first = tracks[0]
    values = [interpolate(track.t_ns, track.values, first.t_ns) for track in tracks]
    return Table(tuple(track.name for track in tracks), first.t_ns, np.stack(values, axis=1))


def resampled(
    tracks: Sequence[Track], names: Sequence[str], at_ns: IntArray, method: Resampler
) -> FloatArray:
    """All joints at common times.

    Args:
        tracks: The tracks, in any order.
        names: Joint names, in the order of the result's columns.
        at_ns: The times [ns], shape (n,).
        method: :func:`.sampling.interpolate` or :func:`.sampling.hold`.

    Returns:
        Shape (n, number of names); NaN columns for joints without a track.
    """
    found = np.full((at_ns.size, len(names)), np.nan)
    column = {name: i for i, name in enumerate(names)}
    for table in tables([track for track in tracks if track.name in column]):
        found[:, [column[name] for name in table.names]] = method(table.t_ns, table.values, at_ns)
    return found
