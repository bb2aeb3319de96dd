"""What is plotted of a session, as logged and what follows from it, and the survey of the whole.

It goes through the session once, stretch by stretch, before anything is drawn, and keeps a few
thousand samples of each line. Where the picture can't wait for the whole, the first stretch and a
little of some others are enough to choose colours, scales and the joints that stand for the body.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import DataError, MissingChannelError

from .content import COMMANDED, ERROR, MEASURED, MECHANICAL, TOTAL
from .timeline import STRETCH_NS, stretches
from .tracks import (
    GAP_STEPS,
    OFFSETS,
    Columns,
    Track,
    decimate,
    hold,
    in_turn,
    interpolate,
    one_after_another,
    pairs,
    read_columns,
    resampled,
    typical_step_ns,
    wanted_fields,
)

DRAWN = {"/joint_states", "/joint_commands", "/gait"}
"""JointState topics that have views of their own."""

SIGNALS = "/signals"

GAIT = "/gait"

_KEPT = 4000  # samples of each line that are kept, about
_LEAST_CONTEXT_NS, _MOST_CONTEXT_NS = 500_000_000, 60_000_000_000
_REACH_STEPS = 1.2 * GAP_STEPS

_LOOKS = 8  # how many stretches after the first one are looked into where not all is read, at most
_LOOK_NS = 2_000_000_000  # how long is looked into each of them [ns]


def tracking_errors(measured: Sequence[Track], commanded: Sequence[Track]) -> tuple[Track, ...]:
    """Return measured minus commanded angles, at the measurement's times.

    Args:
        measured: Measured angles [rad].
        commanded: Commanded angles [rad].

    Returns:
        A track for each joint that has both [rad]; the command is the last one given by then.
    """
    return tuple(
        Track(track.name, track.t_ns, track.values - hold(other.t_ns, other.values, track.t_ns))
        for track, other in pairs(measured, commanded)
    )


def mechanical_power(columns: Columns) -> tuple[Track, ...]:
    """Return the power at the joints, tau q', at the sampling times of the efforts.

    Args:
        columns: The session's columns.

    Returns:
        A track [W] for each joint with effort and velocity; positive where the joint drives.
    """
    effort, velocity = (
        columns.get(("/joint_states", field), ()) for field in ("effort", "velocity")
    )
    return products(effort, velocity)


def electrical_power(columns: Columns) -> tuple[Track, ...]:
    """Return the power of the motors, u i, at the sampling times of the currents.

    Args:
        columns: The session's columns.

    Returns:
        A track [W] for each joint with current and voltage.
    """
    return products(
        columns.get(("/joint_current", "position"), ()),
        columns.get(("/joint_voltage", "position"), ()),
    )


def products(first: Sequence[Track], second: Sequence[Track]) -> tuple[Track, ...]:
    """Return the product of two quantities of each joint.

    Returns:
        A track for each joint that has both; NaN where either is missing.
    """
    return tuple(
        Track(
            track.name, track.t_ns, track.values * interpolate(other.t_ns, other.values, track.t_ns)
        )
        for track, other in pairs(first, second)
    )


def total(tracks: Sequence[Track]) -> Track | None:
    """Return the sum over the joints, at the first joint's sampling times.

    Args:
        tracks: The joints' power [W].

    Returns:
        The sum [W], NaN where any joint's power is missing; None without joints.
    """
    if not tracks:
        return None
    t_ns = tracks[0].t_ns
    parts = [interpolate(track.t_ns, track.values, t_ns) for track in tracks]
    return Track("total", t_ns, np.sum(parts, axis=0))


def power_limit(power_w: FloatArray) -> float:
    """Return the power at which the colour is full: the 99th percentile of its magnitude.

    Args:
        power_w: Mechanical power [W], any shape; NaN where it isn't known.

    Returns:
        [W], rounded up to two digits so that it can be written beside the picture; 1 where no
        power is known or all of it is zero.
    """
    magnitude = np.abs(power_w[np.isfinite(power_w)])
    limit = float(np.percentile(magnitude, 99.0)) if magnitude.size else 0.0
    if not limit:
        return 1.0
    unit = 10.0 ** (np.floor(np.log10(limit)) - 1.0)
    return float(np.ceil(limit / unit) * unit)


def segment_power(joint_power_w: FloatArray) -> FloatArray:
    """Share of the joints' power that each link shows: half of that of the joint at either end.

    Args:
        joint_power_w: Mechanical power of the joints [W], shape (..., m).

    Returns:
        [W], shape (..., m + 1); the sum over the links is the sum over the joints.
    """
    half = joint_power_w / 2.0
    shares = np.zeros((*half.shape[:-1], half.shape[-1] + 1))
    shares[..., :-1] += half
    shares[..., 1:] += half
    return shares


def topic_entity(root: str, topic: str) -> str:
    """Return the entity of a topic.

    Args:
        root: E.g. ``/signals``.
        topic: Any name; it may come from a foreign bag.

    Returns:
        The path of its entity, each part escaped, and empty ones left out.
    """
    parts = (rr.escape_entity_path_part(part) for part in topic.split("/") if part)
    return "/".join((root, *parts))


def quantities(columns: Columns) -> dict[str, tuple[Track, ...]]:
    """Return the plotted quantities.

    Args:
        columns: JointState columns, of the whole session or of a stretch of it.

    Returns:
        Entity to its lines: angles [rad], power [W], and every other JointState topic in its own
        unit below ``/signals``; none without a line.
    """
    measured = columns.get(("/joint_states", "position"), ())
    commanded = columns.get(("/joint_commands", "position"), ())
    mechanical, electrical = mechanical_power(columns), electrical_power(columns)
    lines = {
        COMMANDED: commanded,
        MEASURED: measured,
        ERROR: tracking_errors(measured, commanded),
        MECHANICAL: mechanical,
    }
    for kind, tracks in (("electrical", electrical), ("mechanical", mechanical)):
        if (whole := total(tracks)) is not None:
            lines[f"{TOTAL}/{kind}"] = (whole,)
    lines |= {
        topic_entity(SIGNALS, topic): tracks
        for (topic, field), tracks in columns.items()
        if topic not in DRAWN and field == "position"
    }
    return {entity: tracks for entity, tracks in lines.items() if tracks}


@dataclass(frozen=True)
class Survey:
    """Content of a session.

    Attributes:
        topics: JointState topic to the fields that come.
        samples: Entity to its lines, some of their samples each, in chain order.
        parts: Entity to the names of its lines, those in one part that are drawn at common times.
        drawing_ns: Sampling times of the first measured joint, thinned [ns], shape (n,).
        power_limit_w: Power at which a segment's colour is full [W]; None where none is known.
        context_ns: How far about a stretch its drawing has to look [ns].
        seen: (topic, field) to the joints of which a sample was read.
        is_whole: Whether all of the session was read.
    """

    topics: Mapping[str, Sequence[str]]
    samples: Mapping[str, tuple[Track, ...]]
    parts: Mapping[str, tuple[tuple[str, ...], ...]]
    drawing_ns: IntArray
    power_limit_w: float | None
    context_ns: int
    seen: Mapping[tuple[str, str], set[str]]
    is_whole: bool


def survey(session: SessionView, rate_hz: float, *, brief: bool = False) -> Survey:
    """Survey a session.

    Args:
        rate_hz: How many drawing times a second are kept, at most.
        brief: Of a long session, read the first stretch and a little of some others only.

    Returns:
        What it holds, as far as it was read.
    """
    session.forget()  # an hour's index, as pages of the file
    looks = _looks(session) if brief else []
    share, begin = 1.0, session
    if looks:
        read_ns = sum(stop_ns - start_ns for start_ns, stop_ns in looks)
        share = read_ns / (session.end_ns - session.start_ns)
        begin = session.view(stop_ns=looks[0][1])
    topics = _carried(begin)
    every = {topic: 1 + round(share * session.channels[topic].count) // _KEPT for topic in topics}
    thin = max(every.values(), default=1)
    takes_turns = any(topic in session.channels for topic in OFFSETS)
    names = () if session.robot is None else session.robot.joint_names
    chain = {name: i for i, name in enumerate(names)}
    lines: dict[str, dict[str, list[Track]]] = {}
    parts: dict[str, list[tuple[str, ...]]] = {}
    times: list[IntArray] = []
    powers: list[FloatArray] = []
    seen: dict[tuple[str, str], set[str]] = {}
    context_ns = _LEAST_CONTEXT_NS
    for columns in _columns(session, topics, looks):
        for key, tracks in columns.items():
            seen.setdefault(key, set()).update(track.name for track in tracks)
            reaches_ns = (round(_REACH_STEPS * typical_step_ns(track.t_ns)) for track in tracks)
            context_ns = max(context_ns, *reaches_ns)
        for entity, tracks in quantities(columns).items():
            by_name = lines.setdefault(entity, {})
            for track in tracks:
                # Not a view, which keeps all.
                some = Track(track.name, track.t_ns[::thin].copy(), track.values[::thin].copy())
                by_name.setdefault(track.name, []).append(some)
            parts[entity] = refined(parts.get(entity, []), _parts(tracks, turns=takes_turns))
            if entity == MEASURED:
                times.append(tracks[0].t_ns[decimate(tracks[0].t_ns, rate_hz)])
            if entity == MECHANICAL and session.robot is not None:
                power = resampled(tracks, names, tracks[0].t_ns[::thin], interpolate)
                powers.append(segment_power(power))
    return Survey(
        topics={topic: fields for topic, fields in topics.items() if fields},
        samples={
            entity: tuple(
                one_after_another(line[name])
                for name in sorted(line, key=lambda name: chain.get(name, math.inf))
            )
            for entity, line in lines.items()
        },
        parts={entity: _in_order(part, chain) for entity, part in parts.items()},
        drawing_ns=np.concatenate([np.zeros(0, dtype=np.int64), *times]),
        power_limit_w=power_limit(np.concatenate(powers)) if powers else None,
        context_ns=min(context_ns, _MOST_CONTEXT_NS),
        seen=seen,
        is_whole=not looks,
    )


def _looks(session: SessionView) -> list[tuple[int, int]]:
    """Half-open windows that stand for a long session [Unix ns]; none for a short one."""
    first_ns, last_ns = session.start_ns, session.end_ns
    left_out = (last_ns - first_ns) // (STRETCH_NS * _LOOKS)
    if not left_out:
        return []
    every_ns = STRETCH_NS * (1 + left_out)
    later = range(first_ns + every_ns, last_ns - STRETCH_NS // 2, every_ns)
    return [(first_ns, first_ns + STRETCH_NS), *((at_ns, at_ns + _LOOK_NS) for at_ns in later)]


def _columns(
    session: SessionView, topics: Mapping[str, Sequence[str]], looks: Sequence[tuple[int, int]]
) -> Iterator[Columns]:
    """Columns of windows of a session; without windows, of all of it, stretch by stretch."""
    if not looks:
        yield from (stretch.columns for stretch in stretches(session, topics, 0))
    for start_ns, stop_ns in looks:
        columns = read_columns(session, topics, start_ns=start_ns, stop_ns=stop_ns)
        session.forget()
        yield columns


def _carried(session: SessionView) -> dict[str, list[str]]:
    """The fields that come, but for the gait's, which is read as a whole.

    They are searched in the first second, and if one is missing in the whole session, once.
    """
    topics = {topic: fields for topic, fields in wanted_fields(session).items() if topic != GAIT}
    stop_ns = session.start_ns + 1_000_000_000
    try:
        session.joint_columns(topics, stop_ns=stop_ns)
    except (MissingChannelError, DataError):
        every = topics.items()
        return {k: [field for field in fields if comes(session, k, field)] for k, fields in every}
    return topics


def comes(session: SessionView, topic: str, field: str) -> bool:
    """Whether a field of a JointState topic ever comes."""
    try:
        session.joints(topic, field)
    except (MissingChannelError, DataError):
        return False
    return True


def _parts(tracks: Sequence[Track], *, turns: bool) -> list[tuple[str, ...]]:
    """Lines that were sampled together, or by one message in turn."""
    groups: list[tuple[IntArray, list[str]]] = []
    for track in tracks:
        for t_ns, names in groups:
            if np.array_equal(t_ns, track.t_ns) or (turns and in_turn(t_ns, track.t_ns)):
                names.append(track.name)
                break
        else:
            groups.append((track.t_ns, [track.name]))
    return [tuple(names) for _, names in groups]


def refined(
    before: Sequence[tuple[str, ...]], now: Sequence[tuple[str, ...]]
) -> list[tuple[str, ...]]:
    """Return parts that are together in both; a line in one of them only follows that one."""
    label = {name: i for i, part in enumerate(now) for name in part}
    parts: list[tuple[str, ...]] = []
    for part in before:
        split: dict[int, list[str]] = {}
        first = next((label[name] for name in part if name in label), -1)
        for name in part:
            split.setdefault(label.get(name, first), []).append(name)
        parts += [tuple(names) for names in split.values()]
    earlier = {name for part in before for name in part}
    parts += [new for part in now if (new := tuple(n for n in part if n not in earlier))]
    return parts


def _in_order(
    parts: Sequence[tuple[str, ...]], chain: Mapping[str, int]
) -> tuple[tuple[str, ...], ...]:
    """Parts in the order of their first lines, lines in chain order."""
    inside = [tuple(sorted(part, key=lambda name: chain.get(name, math.inf))) for part in parts]
    return tuple(sorted(inside, key=lambda part: chain.get(part[0], math.inf)))
