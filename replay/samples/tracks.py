"""Joint samples as they are drawn: each joint's own times, and samples on other samples' times.

Each servo has its own sampling times; a picture of the whole body needs all of them at one
instant. Between two samples the straight line is drawn, across a gap nothing: there the result is
NaN, and so is everything computed from it.

Values are rounded finer than can be seen and coarse enough to be packed: Rerun packs its files with
LZ4, which finds what repeats, and noise below what a screen shows never does. Values rounded to a
power of two take half the space of those that were logged.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.bus.decoded_topics import JOINT_TOPIC
from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.log.read.sample_times import JointSignals

JOINT_STATE = "sensor_msgs/msg/JointState"

OFFSETS = ("/joint_sample_offset", "/joint_command_offset")
"""JointState topics of sampling times instead of values."""

Columns = dict[tuple[str, str], tuple["Track", ...]]
"""(topic, field of the JointState) to tracks."""

Resampler = Callable[[IntArray, FloatArray, IntArray], FloatArray]

MOST_JOINTS = 1000
"""Of a topic that is drawn."""
MOST_TOPICS = 100
"""JointState topics that are drawn."""

LEVELS = 500
"""Steps that the range of a plotted line is cut into, at least."""
_TAIL = 0.01

GAP_STEPS = 5.0
"""Two samples further apart than this many typical steps have a gap between them."""


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
class TrackTable:
    """Joints that were sampled at the same times.

    Attributes:
        names: Joint names, shape (k,).
        t_ns: Their sampling times [ns], shape (n,).
        values: In SI, shape (n, k).
    """

    names: tuple[str, ...]
    t_ns: IntArray
    values: FloatArray


def drawn_topics(session: SessionView) -> tuple[list[str], int]:
    """Return the JointState topics that are drawn.

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
    """Return the fields of a session's JointState topics that are drawn.

    Returns:
        Topic to fields: the position of every topic, velocity and effort of ``/joint_states``.
    """
    fields = {topic: ["position"] for topic in drawn_topics(session)[0]}
    if "/joint_states" in fields:
        fields["/joint_states"] += ["velocity", "effort"]
    return fields


def read_columns(
    session: SessionView,
    topics: Mapping[str, Sequence[str]] | None = None,
    *,
    start_ns: int | None = None,
    stop_ns: int | None = None,
) -> Columns:
    """Read JointState topics of a session.

    Args:
        topics: Topic to fields; None for all of :func:`wanted_fields`.
        start_ns: First sampling time wanted [Unix ns]; None for the session's start.
        stop_ns: One past the last sampling time wanted [Unix ns]; None for the end.

    Returns:
        (topic, field) to a track for each joint that has at least one sample, in the session's
        order; without what never comes.

    Raises:
        DataError: If a topic has more than :data:`MOST_JOINTS`.
    """
    fields = wanted_fields(session) if topics is None else topics
    window = {"start_ns": start_ns, "stop_ns": stop_ns}
    try:
        columns = session.joint_columns(fields, **window)
    except (MissingChannelError, DataError):  # a field that never comes: take the others singly
        columns: dict[tuple[str, str], JointSignals] = {}
        for topic, field in [(name, field) for name in fields for field in fields[name]]:
            with contextlib.suppress(MissingChannelError, DataError):
                columns[topic, field] = session.joints(topic, field, **window)
    for (topic, _), signals in columns.items():
        if (count := len(signals.names)) > MOST_JOINTS:
            where = f"{session.path.name}: {topic} has {count} joints"
            raise DataError(f"{where}; at most {MOST_JOINTS} are drawn")
    by_field = {key: _tracks(signals) for key, signals in columns.items()}
    return {key: tracks for key, tracks in by_field.items() if tracks}


def _tracks(signals: JointSignals) -> tuple[Track, ...]:
    rows = zip(signals.names, signals.t_ns, signals.values, strict=True)
    tracks = [without_filler(Track(name, *ordered(t_ns, values))) for name, t_ns, values in rows]
    return tuple(track for track in tracks if np.isfinite(track.values).any())


def without_filler(track: Track) -> Track:
    """Leave out the NaN that only fill up messages about something else.

    A robot that reports one quantity, or one servo, a message fills the other places with NaN.
    If half of a joint's samples or more are NaN, these are fillers; fewer are a gap.

    Returns:
        The track without its NaN where they are half or more, else the track itself.
    """
    finite = np.isfinite(track.values)
    whole = 2 * np.count_nonzero(finite) > finite.size
    return track if whole else Track(track.name, track.t_ns[finite], track.values[finite])


def pairs(first: Sequence[Track], second: Sequence[Track]) -> list[tuple[Track, Track]]:
    """Two quantities of each joint that has both, in the order of the first."""
    other = {track.name: track for track in second}
    return [(track, other[track.name]) for track in first if track.name in other]


def one_after_another(pieces: Sequence[Track]) -> Track:
    """Join successive pieces of one track, at least one."""
    t_ns = np.concatenate([piece.t_ns for piece in pieces])
    return Track(pieces[0].name, t_ns, np.concatenate([piece.values for piece in pieces]))


def tables(tracks: Sequence[Track]) -> tuple[TrackTable, ...]:
    """Put joints that were sampled at the same times into one table each.

    Args:
        tracks: The tracks, in chain order.

    Returns:
        The tables, in the order of their first joints; one table where all joints share their
        times.
    """
    return tuple(
        TrackTable(
            tuple(track.name for track in group),
            group[0].t_ns,
            np.stack([track.values for track in group], axis=1),
        )
        for group in sampled_together(tracks)
    )


def sampled_together(tracks: Sequence[Track]) -> list[list[Track]]:
    """Group joints that were sampled at the same times, in the order of their first joints."""
    together: dict[bytes, list[Track]] = {}
    for track in tracks:
        together.setdefault(track.t_ns.tobytes(), []).append(track)
    return list(together.values())


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


def join_tracks(tracks: Sequence[Track]) -> TrackTable:
    """Return joints as one table at the times of the first of them.

    Args:
        tracks: Joints that were sampled together or in turn, at least one.

    Returns:
        One table; the values of the others lie on the straight lines between their samples, which
        is what a plot draws of them.
    """
    first = tracks[0]
    values = [interpolate(track.t_ns, track.values, first.t_ns) for track in tracks]
    return TrackTable(tuple(track.name for track in tracks), first.t_ns, np.stack(values, axis=1))


def resampled(
    tracks: Sequence[Track], names: Sequence[str], at_ns: IntArray, method: Resampler
) -> FloatArray:
    """Return all joints at common times.

    Args:
        tracks: The tracks, in any order.
        names: Joint names, in the order of the result's columns.
        at_ns: The times [ns], shape (n,).
        method: :func:`interpolate` or :func:`hold`.

    Returns:
        Shape (n, number of names); NaN columns for joints without a track.
    """
    values = np.full((at_ns.size, len(names)), np.nan)
    column = {name: i for i, name in enumerate(names)}
    for table in tables([track for track in tracks if track.name in column]):
        values[:, [column[name] for name in table.names]] = method(table.t_ns, table.values, at_ns)
    return values


def plot_step(values: FloatArray) -> float:
    """Return the step that a plotted line is rounded to.

    Args:
        values: Samples of the line, any unit, shape (n,); NaN where there is none.

    Returns:
        A power of two, at most 1/500 of the range that holds all but the lowest and highest
        hundredth of the samples, so that rounding moves none by more than a thousandth of that
        range; 0, for none, where the line is flat.
    """
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0
    low, high = np.quantile(finite, [_TAIL, 1.0 - _TAIL])
    span = float(high - low) or float(finite.max() - finite.min())
    return float(2.0 ** np.floor(np.log2(span / LEVELS))) if span else 0.0


def rounded(values: FloatArray, steps: Sequence[float] | FloatArray) -> FloatArray:
    """Round to multiples of a step.

    Args:
        values: Shape (n, k).
        steps: One a column, shape (k,); 0 leaves a column as it is.

    Returns:
        Shape (n, k); at most half a step from the values.
    """
    step = np.asarray(steps, dtype=np.float64)
    some = step > 0.0
    if not some.any():
        return values
    result = values.copy()
    result[:, some] = np.round(values[:, some] / step[some]) * step[some]
    return result


def typical_step_ns(t_ns: IntArray) -> int:
    """Return the median distance of successive samples.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).

    Returns:
        The step [ns]; 0 where there are fewer than two distinct times.
    """
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return int(np.median(steps)) if steps.size else 0


def gaps(t_ns: IntArray) -> BoolArray:
    """Return which samples are followed by a gap.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).

    Returns:
        Shape (n - 1,), or (0,) for fewer than two samples.
    """
    steps = np.diff(t_ns)
    if steps.size and steps.max() <= GAP_STEPS * steps.min():  # the median is between the two
        return np.zeros(steps.size, dtype=np.bool_)
    return np.asarray(steps > GAP_STEPS * typical_step_ns(t_ns), dtype=np.bool_)


def mark_gaps(
    t_ns: IntArray, values: FloatArray, end_ns: int | None = None
) -> tuple[IntArray, FloatArray]:
    """Put one row of NaN into every gap, a step after its last sample.

    A plot joins neighbouring rows by a line and a body keeps its last pose until the next one;
    the row of NaN ends both where the data end.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        values: Shape (n, k).
        end_ns: Where the session ends [ns]; a silence before it counts as a gap.

    Returns:
        Times and values with the rows put in; the arguments themselves where there is no gap.
    """
    before = np.flatnonzero(gaps(t_ns))
    if end_ns is None and not before.size:
        return t_ns, values
    step = typical_step_ns(t_ns)
    if end_ns is not None and t_ns.size and end_ns - t_ns[-1] > GAP_STEPS * step:
        before = np.append(before, t_ns.size - 1)
    if not before.size:
        return t_ns, values
    after = before + 1
    return np.insert(t_ns, after, t_ns[before] + step), np.insert(values, after, np.nan, axis=0)


def decimate(t_ns: IntArray, rate_hz: float, origin_ns: int | None = None) -> IntArray:
    """Choose samples so that no more than ``rate_hz`` a second remain.

    Every slot of 1 / ``rate_hz`` that holds samples keeps its first one; slots are centred on
    multiples of that period after the origin, so that jitter about a multiple is harmless.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        rate_hz: At most this many samples a second.
        origin_ns: Where the slots are counted from [ns]; None for the first sample.

    Returns:
        Indices into ``t_ns``, ascending.
    """
    if not t_ns.size:
        return np.zeros(0, dtype=np.int64)
    period = round(1e9 / rate_hz)
    slot = (t_ns - (t_ns[0] if origin_ns is None else origin_ns) + period // 4) // period
    first = np.flatnonzero(np.diff(slot, prepend=slot[0] - 1))
    return first.astype(np.int64)


def interpolate(t_ns: IntArray, values: FloatArray, at_ns: IntArray) -> FloatArray:
    """Interpolate linearly between the samples about each time.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        values: Shape (n,) or (n, k).
        at_ns: Wanted times [ns], shape (m,).

    Returns:
        Shape (m,) or (m, k). A wanted time that is a sampling time gets that sample. NaN before
        the first sample, after the last, across a gap and beside a NaN sample.
    """
    if np.array_equal(t_ns, at_ns):
        return values
    result = np.full((at_ns.size, *values.shape[1:]), np.nan)
    if not t_ns.size:
        return result
    left = np.searchsorted(t_ns, at_ns, side="right") - 1  # -1, the last, where none is earlier
    exact = t_ns[left] == at_ns
    result[exact] = values[left[exact]]
    between = ~exact & np.append(~gaps(t_ns), False)[left]  # nothing follows the last
    i = left[between]
    share = (at_ns[between] - t_ns[i]) / (t_ns[i + 1] - t_ns[i])
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    result[between] = (1.0 - share) * values[i] + share * values[i + 1]
    return result


def hold(t_ns: IntArray, values: FloatArray, at_ns: IntArray) -> FloatArray:
    """Return the last sample at or before each time: a servo keeps its command until the next.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        values: Shape (n,) or (n, k).
        at_ns: Wanted times [ns], shape (m,).

    Returns:
        Shape (m,) or (m, k); NaN before the first sample and later than a gap's length after
        the last one, where a lost command can't be distinguished from a held one.
    """
    result = np.full((at_ns.size, *values.shape[1:]), np.nan)
    if not t_ns.size:
        return result
    left = np.searchsorted(t_ns, at_ns, side="right") - 1
    held = (left >= 0) & (at_ns - t_ns[left] <= GAP_STEPS * typical_step_ns(t_ns))
    result[held] = values[left[held]]
    return result


def ordered(t_ns: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Sort samples by time.

    Args:
        t_ns: Sampling times [ns], shape (n,).
        values: Shape (n,) or (n, k).

    Returns:
        Both sorted by time, equal times in their given order; unchanged where sorted already.
    """
    if np.all(t_ns[1:] >= t_ns[:-1]):
        return t_ns, values
    order = np.argsort(t_ns, kind="stable")
    return t_ns[order], values[order]
