"""The sessions of an overlay: what is read of each, and how they are aligned and placed.

``session_time`` counts from each session's own zero: its first sample, or the start of its gait.
``gait_cycle`` is moved by whole cycles only, so that equal places are equal phases; every session
is in its first cycle between 0 and 1 there. The other way round, a sample of one session finds its
counterpart in another one at the same time, or at the same phase.

Where a robot's world has its origin is the choice of whoever tracked it, so by default the other
bodies are moved onto the first one: turned about the vertical and moved on the ground, so that at
the first moment that both sessions share the heads are at one point and the bodies point one way. A
body's direction is the mean of its links' over one cycle of its gait, in which what swings to the
left swings to the right too; without a gait it is that of the moment.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np
import rerun as rr

from undulog.analysis.compare.side import ComparedSession, facts_of, see
from undulog.analysis.signals.stretch import Options
from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import UndulogError, UsageError
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.capture.robot.model import Robot

from ..draw.drawing import palette_of
from ..draw.lines import rhythm_of
from ..draw.motion import HeadPath, read_head
from ..recording import Recording, write_recording
from ..samples.content import Color
from ..samples.timeline import GAIT_CYCLE, SESSION_TIME, LoggedRhythm, TimeColumns
from ..samples.tracks import Track, gaps, interpolate, read_columns, resampled, wanted_fields

COMPARED = "/compared"
"""Where everything goes that belongs to no single session."""

_TOPICS = ("/joint_states", "/gait")

_LOOK_AT = 1000  # samples of the head among which a first moment is looked for

_ROTATION = 0.99  # a quaternion shorter than this is none

_INSTANTS = 48  # of a cycle, at which a body's direction is taken

_SAME_M, _SAME_RAD = 1e-3, math.radians(0.1)


@dataclass(frozen=True)
class Side:
    """A session of an overlay, without its own recording.

    Attributes:
        name: What it is called, e.g. ``twin``.
        path: The session's file.
        start_ns: Time of its first sample [Unix ns].
        end_ns: Time of its last one [Unix ns].
        verdict: Health of the recording, or None where nobody judged it.
        robot: Its robot, or None.
        measured: Measured joint angles [rad].
        head: The head's path, or None where no body can be drawn.
        rhythm: The gait's phase, or None where none was logged.
        palette: Colour by joint name.
        facts: How it was made, by name.
        zero_ns: Its time at 0 of ``session_time`` [Unix ns].
        cycles: Whole cycles that are added to its gait's phase.
    """

    name: str
    path: Path
    session_id: str
    start_ns: int
    end_ns: int
    verdict: str | None
    robot: Robot | None
    measured: tuple[Track, ...]
    head: HeadPath | None
    rhythm: LoggedRhythm | None
    palette: Mapping[str, Color]
    facts: Mapping[str, str]
    zero_ns: int
    cycles: int = 0

    @property
    def clock(self) -> TimeColumns:
        """Timelines that place the session's samples on the common ones."""
        rhythm = self.rhythm
        if rhythm is not None:
            rhythm = LoggedRhythm(rhythm.t_ns, rhythm.cycles + self.cycles)
        return TimeColumns(self.zero_ns, rhythm)

    @property
    def entity(self) -> str:
        """Path under which all of its entities are."""
        return f"/{rr.escape_entity_path_part(self.name)}"

    @property
    def compared(self) -> str:
        """Path under which its comparison with the first session is."""
        return f"{COMPARED}/{rr.escape_entity_path_part(self.name)}"

    @property
    def runs_back(self) -> bool:
        """Whether the gait's phase falls."""
        return self.rhythm is not None and bool(self.rhythm.cycles[-1] < self.rhythm.cycles[0])

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names, head to tail."""
        if self.robot is not None:
            return self.robot.joint_names
        return tuple(track.name for track in self.measured)


def names_of(files: Sequence[Path], requested: Sequence[str] | None) -> tuple[str, ...]:
    """Return the sessions' names.

    Args:
        requested: Requested names, or None for the files' own.

    Returns:
        A name a session, all different.

    Raises:
        UsageError: If their number is wrong, or they aren't different.
    """
    if requested is None:
        stems = [file.stem for file in files]
        if len(set(stems)) == len(stems) and COMPARED.strip("/") not in stems:
            return tuple(stems)
        return tuple(f"{stem} {i + 1}" for i, stem in enumerate(stems))
    names = [name.strip() for name in requested]
    if len(names) != len(files):
        raise UsageError(
            f"--names gives {len(names)} names for {len(files)} sessions; give one each, with "
            "commas between them, e.g. --names robot,twin"
        )
    if not all(names) or len(set(names)) < len(names):
        raise UsageError(f"--names {','.join(names)}: every session needs a name of its own")
    if COMPARED.strip("/") in names:
        raise UsageError(f"--names: {COMPARED.strip('/')!r} is where the differences go")
    return tuple(names)


def read_side(session: SessionView, name: str) -> Side:
    """Read a session for an overlay."""
    topics = {topic: ["position"] for topic in _TOPICS if topic in wanted_fields(session)}
    columns = read_columns(session, topics)
    measured = columns.get(("/joint_states", "position"), ())
    head = None
    if session.robot is not None and measured:
        head = read_head(session, session.robot, measured, [])  # its recording says what is missing
    return Side(
        name=name,
        path=session.path,
        session_id=session.session_id,
        start_ns=session.start_ns,
        zero_ns=session.start_ns,
        end_ns=session.end_ns,
        verdict=session.verdict,
        robot=session.robot,
        measured=measured,
        head=head,
        rhythm=rhythm_of(columns.get(("/gait", "position"), ())),
        palette=palette_of(session.robot, [track.name for track in measured]),
        facts=facts_of(session),
    )


def convert(session: SessionView, path: Path) -> tuple[Recording, ComparedSession | None]:
    """Write the session's own recording, and return it with the input of a comparison.

    Returns:
        The recording, and the analysis, or None where the session can't be analysed; why is
        among the recording's warnings.

    Raises:
        DataError: If the session holds nothing that can be drawn.
        LogWriteError: If the file can't be written.
    """
    notes: list[str] = []
    seen: ComparedSession | None = None
    try:
        seen = see(session, Options(), notes.append)
    except UndulogError as error:  # a session without a gait can be seen too
        notes.append(f"not analysed: {error}")
    session.forget()
    analysis = None if seen is None else seen.analysis
    return write_recording(session, path, analysis=analysis, notes=notes), seen


class Align(StrEnum):
    """How sessions are aligned in time."""

    TIME = "time"
    """The same time since each session's first sample."""

    GAIT = "gait"
    """The same time since the start of each session's gait."""

    PHASE = "phase"
    """The same phase of the gait."""

    @property
    def timeline(self) -> str:
        """The timeline on which aligned samples lie at one place."""
        return GAIT_CYCLE if self is Align.PHASE else SESSION_TIME


def align(sides: Sequence[Side], how: Align) -> tuple[Side, ...]:
    """Align sessions on common timelines.

    Raises:
        UsageError: If a session has no gait to be aligned by.
    """
    without = ", ".join(side.name for side in sides if side.rhythm is None)
    if without and how is not Align.TIME:
        raise UsageError(
            f"--align {how}: no phase of a gait was logged (/gait) in {without}; "
            "align by --align time"
        )
    back = ", ".join(side.name for side in sides if side.runs_back)
    if back and how is Align.PHASE:
        raise UsageError(
            f"--align phase: the gait's phase runs backwards in {back}, so its "
            "cycles can't be counted; align by --align time"
        )
    return tuple(_aligned(side, how) for side in sides)


def counterparts(a: Side, b: Side, how: Align, t_ns: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the times in one session that correspond to times in another.

    Args:
        a: The session that the times are of.
        t_ns: Times in ``a`` [Unix ns], shape (n,).

    Returns:
        Times in ``b`` [Unix ns], shape (n,), and whether each is known: in a gap of a gait's
        phase, and outside of it, it isn't.
    """
    if how is not Align.PHASE:
        return t_ns - a.zero_ns + b.zero_ns, np.ones(t_ns.shape, dtype=np.bool_)
    rhythm, other = a.clock.rhythm, b.clock.rhythm
    assert rhythm is not None  # noqa: S101 - align() saw to it
    assert other is not None  # noqa: S101
    return times_of(other, interpolate(rhythm.t_ns, rhythm.cycles, t_ns))


def times_of(rhythm: LoggedRhythm, cycles: FloatArray) -> tuple[IntArray, BoolArray]:
    """Return the times at which a gait first reached given phases.

    Args:
        rhythm: The gait's phase.
        cycles: Wanted phases in cycles, cumulative, shape (n,); may be NaN.

    Returns:
        Times [Unix ns], shape (n,), and whether each is known; 0 where it isn't.
    """
    forward = np.flatnonzero(np.diff(np.maximum.accumulate(rhythm.cycles), prepend=-np.inf) > 0)
    t_ns, at = rhythm.t_ns[forward], rhythm.cycles[forward]
    left = np.searchsorted(at, cycles, side="right") - 1
    last = at.size - 1
    within = (left >= 0) & ((left < last) | (cycles == at[-1]))
    left = np.clip(left, 0, max(last - 1, 0))
    if last < 1:
        return np.where(within, t_ns[0], 0), within
    with np.errstate(invalid="ignore"):
        share = np.where(within, (cycles - at[left]) / (at[left + 1] - at[left]), 0.0)
    step = np.round(share * (t_ns[left + 1] - t_ns[left])).astype(np.int64)
    valid = within & (~gaps(t_ns)[left] | (share == 0.0))
    return np.where(valid, t_ns[left] + step, 0), valid


def _aligned(side: Side, how: Align) -> Side:
    rhythm = side.rhythm
    if rhythm is None:
        return side
    zero_ns = int(rhythm.t_ns[0]) if how is Align.GAIT else side.start_ns
    return replace(side, zero_ns=zero_ns, cycles=-int(np.floor(rhythm.cycles[0])))


@dataclass(frozen=True)
class Placement:
    """A turn about the vertical through the origin, then a step on the ground.

    Attributes:
        turn: Angle [rad].
        x: Step [m].
        y: Step [m].
    """

    turn: float = 0.0
    x: float = 0.0
    y: float = 0.0

    def __call__(self, points: FloatArray) -> FloatArray:
        """Move points.

        Args:
            points: [m], shape (..., 3).

        Returns:
            [m], shape (..., 3).
        """
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack([cos * x - sin * y + self.x, sin * x + cos * y + self.y, z], axis=-1)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """The turn as x, y, z, w."""
        return (0.0, 0.0, math.sin(self.turn / 2), math.cos(self.turn / 2))


def placement(a: Side, b: Side, how: Align) -> Placement | None:
    """Return the placement of one body onto another.

    Args:
        a: The session whose world stays.
        b: The one that is moved.

    Returns:
        The placement, or None where either has no body at any shared moment.
    """
    head, other = a.head, b.head
    if head is None or other is None:
        return None
    at_ns, valid = counterparts(a, b, how, head.t_ns)
    valid &= np.isfinite(head.position).all(axis=1)
    rows = np.flatnonzero(valid & (at_ns >= other.t_ns[0]) & (at_ns <= other.t_ns[-1]))[:_LOOK_AT]
    there = interpolate(other.t_ns, other.position, at_ns[rows])
    finite = np.flatnonzero(np.isfinite(there).all(axis=1))
    if not finite.size:
        return None
    first = rows[finite[0]]
    heading, other_heading = _heading(a, int(head.t_ns[first])), _heading(b, int(at_ns[first]))
    if heading is None or other_heading is None:
        return None
    turn = math.remainder(heading - other_heading, 2 * math.pi)
    step = head.position[first] - Placement(turn)(there[finite[0]])
    return Placement(turn, float(step[0]), float(step[1]))


def placement_text(placed: Placement, name: str, first: str) -> str:
    """Return the text of a placement.

    Args:
        name: The session that is moved.
        first: The one it is laid on.

    Returns:
        One sentence without its full stop.
    """
    if math.hypot(placed.x, placed.y) < _SAME_M and abs(placed.turn) < _SAME_RAD:
        return f"{name} starts where {first} does"
    return (
        f"{name} is drawn where {first} starts: turned by {math.degrees(placed.turn):.1f}° about "
        f"its origin and moved by ({placed.x:.3f}, {placed.y:.3f}) m"
    )


def head_distance(a: Side, b: Side, how: Align, placed: Placement, t_ns: IntArray) -> FloatArray:
    """Return the distance of the heads as they are drawn.

    Args:
        a: One session, with a head.
        b: The other, with a head.
        placed: How ``b`` is moved.
        t_ns: Times in ``a`` [Unix ns], shape (n,).

    Returns:
        Distance on the ground [m], shape (n,); NaN where either isn't known.
    """
    head, other = a.head, b.head
    assert head is not None  # noqa: S101 - the caller drew both
    assert other is not None  # noqa: S101
    at_ns, valid = counterparts(a, b, how, t_ns)
    there = np.full((t_ns.size, 3), np.nan)
    there[valid] = placed(interpolate(other.t_ns, other.position, at_ns[valid]))
    apart = there - interpolate(head.t_ns, head.position, t_ns)
    return np.asarray(np.hypot(apart[:, 0], apart[:, 1]), dtype=np.float64)


def _heading(side: Side, t_ns: int) -> float | None:
    """Return a body's heading in the cycle after a time [rad]; None if it isn't known."""
    times, rhythm = np.array([t_ns], dtype=np.int64), side.clock.rhythm
    if rhythm is not None:
        ends, valid = times_of(rhythm, interpolate(rhythm.t_ns, rhythm.cycles, times) + 1.0)
        if valid[0]:
            times = t_ns + np.arange(_INSTANTS) * (int(ends[0]) - t_ns) // _INSTANTS
    forward = _directions(side, times)
    forward = forward[np.isfinite(forward).all(axis=1)]
    if not forward.size:
        return None
    x, y = forward.sum(axis=0)
    return math.atan2(y, x)


def _directions(side: Side, t_ns: IntArray) -> FloatArray:
    """Return the sum of the links' forward axes, shape (n, 2); NaN where a pose isn't known."""
    robot, head = side.robot, side.head
    assert robot is not None  # noqa: S101 - the caller saw a head
    assert head is not None  # noqa: S101
    position = interpolate(head.t_ns, head.position, t_ns)
    quaternion = interpolate(head.t_ns, head.quaternion, t_ns)
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    # Between q and -q, which are the same pose, the straight line leaves the rotations.
    quaternion = np.where(norm > _ROTATION, quaternion / norm, np.nan)
    names, measured = robot.joint_names, {track.name for track in side.measured}
    angles = resampled(side.measured, names, t_ns, interpolate)
    angles[:, [name not in measured for name in names]] = 0.0  # as good a guess as any
    _, rotation = link_poses(robot, position, rotation_from_quaternion(quaternion), angles)
    return rotation[..., :2, 0].sum(axis=1)
