"""All artefacts of a session: every detector on every joint that it applies to.

A frozen encoder is not a weak servo: what is wrong with samples, or at a limit, is kept apart from
mechanics. Each :class:`~.analysis.common.answer.Artefact` names a joint, a topic and the intervals
in which it holds, and states what it is about: the ``sensor`` (the values are not what the joint
did), the ``record`` (samples are missing) or a ``limit`` (the robot could not do more; the values
are right).

An encoder that wraps around, or loses its place: steps that no joint can make.

Steps of one common size P, up and down, are the wrap of a counter: the position is right again
but for whole turns of P. Any other such step is a jump: from then on the position is another one,
or one sample was wrong. A joint at the limits of its robot is saturated or stalled, which is
neither sensor nor spread.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.common.process import in_threads
from undulog.capture.judgement.levels import HALF
from undulog.capture.judgement.motion import RecordedJoint, Samples, course_of, cycle_s
from undulog.capture.judgement.response import Filtered, fit_response
from undulog.capture.log.read.sample_times import LARGEST, Signal

from ...estimators.series import Series, clean_together
from ...signals.columns import QUANTITIES, Columns
from .holds import clipped, frozen, stale
from .result import FALSIFYING, Artefact, Span
from .scales import (
    SAME_RATE,
    SAME_SCALE,
    against_command,
    against_witness,
    compare,
    inside,
    integral,
    rate_of,
    spans_of,
    turns,
)

ABOVE_NEIGHBOURS = 8.0
"""A step this many times those beside it stands alone."""

ABOVE_USUAL = 20.0
"""A step this many times the median one is unlike any other."""

SAME_SIZE = 0.02
"""Relative spread of the sizes of one counter's wraps."""

_BESIDE = 3
_TURNS = (np.pi, 2 * np.pi, 4 * np.pi)
"""Sizes [rad] by which a single step is known as a wrap."""

AT_LIMIT_RAD = 1e-4
"""A position this close to its limit, or beyond it, is at the limit."""

AT_LIMIT = 0.995
"""So large a part of any other limit is at the limit."""

AT_LIMIT_SHARE = 0.01
"""Less of the time at a limit is touching it."""

STALL_SHARE = 0.9
"""Part of the stall torque that a stalled joint gives at least."""

STALL_S = 0.2
DWELL = 3.0
"""Times the turning point of a sine that a joint of unknown stall torque stands still."""

CONSTANT = 0.05
"""Standard deviation over mean below which an effort is constant."""

STANDING = 0.05
"""Standing still: slower than this part of what the joint does at most."""

GAP_SHARE = 1e-3
"""Less of a session without samples is no gap worth a word."""

DRIVE = frozenset({"effort", "current", "voltage"})
"""Their flat tops may be all that the servo gives."""

MOST_RATE = 50.0
"""Rate that no joint of a robot without description exceeds [rad/s]."""


_Found = Iterator[tuple[str, str, tuple[Span, ...], str]]


@dataclass(frozen=True)
class PositionJumps:
    """What a position does that no joint can do.

    Attributes:
        wrapped: Stretches in which it is off by whole turns of the counter.
        turn_rad: Size of that turn [rad]; 0 where there is none.
        jumped: Instants of other steps, from the sample before to the sample after.
    """

    wrapped: tuple[Span, ...]
    turn_rad: float
    jumped: tuple[Span, ...]


def find_jumps(
    position: Series, most_rate: float, released: tuple[Span, ...] = ()
) -> PositionJumps:
    """Look for wraps and jumps.

    Args:
        most_rate: Rate that the joint can't exceed [rad/s].
        released: Stretches in which the position was frozen: the step at the end of one is the
            way that the joint has gone meanwhile.
    """
    t_s, value = position.t_s, position.values
    nothing = PositionJumps((), 0.0, ())
    if value.size < 16:
        return nothing
    step, dt = np.diff(value), np.diff(t_s)
    at = np.flatnonzero(_alone(step, dt, most_rate))
    if released:
        held = inside(t_s, released)
        near = np.minimum(at[:, None] + np.arange(-1, 3), value.size - 1)
        at = at[~held[near].any(axis=1)]
    if at.size == 0:
        return nothing
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, step.size - 1)
    # Without what the joint itself did meanwhile.
    excess = step[at] - (step[before] + step[after]) / 2
    turn = float(np.median(np.abs(excess)))
    spread = SAME_SIZE * turn + 2 * float(np.median(np.abs(step)))
    alike = bool(np.all(np.abs(np.abs(excess) - turn) < spread))
    # Lone steps of any size may be a jump; a counter's single wrap is known by its size.
    whole_turn = any(abs(turn - size) < spread for size in _TURNS)
    if not alike or not (whole_turn or (at.size > 2 and np.ptp(value) < 2 * turn)):
        return PositionJumps((), 0.0, tuple((float(t_s[k]), float(t_s[k + 1])) for k in at))
    turns = np.zeros(value.size)
    turns[at + 1] = np.rint(excess / turn)
    count = np.cumsum(turns)
    levels, index = np.unique(count, return_inverse=True)
    return PositionJumps(spans_of(t_s, count != levels[np.argmax(np.bincount(index))]), turn, ())


def _alone(step: FloatArray, dt: FloatArray, most_rate: float) -> BoolArray:
    size = np.abs(step)
    possible = most_rate * dt
    alone = size > possible
    if not np.any(alone):
        return alone
    # Over a gap a joint goes further; the usual step grows with it.
    alone &= size > ABOVE_USUAL * np.median(size[size > 0]) * np.maximum(dt / np.median(dt), 1.0)
    for k in np.flatnonzero(alone):
        near = np.concatenate((size[max(k - _BESIDE, 0) : k], size[k + 1 : k + 1 + _BESIDE]))
        calm = near[near <= possible[k]]
        alone[k] = calm.size > 1 and size[k] > ABOVE_NEIGHBOURS * float(calm.max())
    return alone


@dataclass(frozen=True)
class JointLimits:
    """What one joint can do, from the robot's description.

    Attributes:
        lower: Angle [rad].
        upper: Angle [rad].
        rate: [rad/s].
        torque: At standstill and full voltage [N m].
        current: At standstill and full voltage [A].
        voltage: Of the supply [V].
        stated: Whether the servo's values are known rather than assumed.
    """

    lower: float
    upper: float
    rate: float
    torque: float
    current: float
    voltage: float
    stated: bool

    @property
    def values(self) -> tuple[float, ...]:
        """All of them, both signs: values at which a channel may stay by itself."""
        sizes = (self.rate, self.torque, self.current, self.voltage)
        return (self.lower, self.upper, *sizes, *(-size for size in sizes))


def limits_of(session: SessionView) -> dict[str, JointLimits]:
    """Return the limits of the session's joints.

    Args:
        session: An open session; a twin may have run other servos than the robot's own.

    Returns:
        By joint name; empty without a robot description.
    """
    robot = session.robot_as_run
    if robot is None:
        return {}
    # A twin's servos are as they are stated, whatever the robot's may be.
    stated = session.run is not None or not {"servo", "joints"} & set(robot.assumed)
    limits: dict[str, JointLimits] = {}
    for joint in robot.joints:
        servo = joint.servo
        sizes = (servo.stall_torque, servo.supply_v / servo.resistance_ohm, servo.supply_v)
        limits[joint.name] = JointLimits(
            joint.lower, joint.upper, joint.max_velocity, *sizes, stated
        )
    return limits


def saturated(series: Series, lower: float, upper: float, slack: float) -> tuple[Span, ...]:
    """Return the stretches in which a channel is at a limit.

    Args:
        slack: This close to a limit is at it.

    Returns:
        The stretches; none if they are less than ``AT_LIMIT_SHARE`` of the samples.
    """
    at = (series.values <= lower + slack) | (series.values >= upper - slack)
    if np.count_nonzero(at) <= AT_LIMIT_SHARE * series.count:
        return ()
    return spans_of(series.t_s, at, join=2)


def stalled(
    effort: Series, position: Series, most: float | None, asked: Series
) -> tuple[Span, ...]:
    """Return the stretches in which a joint pushes with all it has, and stands still.

    Without a known stall torque, a joint has stalled where its effort stays constant at its
    largest value for far longer than a sine at its turning point stands still.

    Args:
        effort: Torque, or motor current.
        most: Torque or current at standstill and full voltage; None where it is not known.
        asked: Its command, or else its position: what it does at most, 95 % of the time less,
            shows what standing still is.

    Returns:
        Stretches of ``STALL_S`` or more.
    """
    largest = float(np.percentile(np.abs(effort.values), 99.5)) if effort.count else 0.0
    pushing = np.abs(effort.values) >= STALL_SHARE * (largest if most is None else most)
    pushing &= largest > 0
    if position.count < 2 or asked.count < 2 or not np.any(pushing):
        return ()
    usual_rate = float(np.percentile(np.abs(np.diff(asked.values)) / np.diff(asked.t_s), 95))
    if usual_rate <= 0:
        return ()
    # Speed over a tenth of a second, so that an encoder's steps and noise are none.
    half = STALL_S / 4
    at = np.flatnonzero(pushing)
    ends = position.at(effort.t_s[at] + half), position.at(effort.t_s[at] - half)
    rate = (ends[0] - ends[1]) / (2 * half)
    pushing[at[np.abs(rate) >= STANDING * usual_rate]] = False
    stalls = spans_of(effort.t_s, pushing, join=2)
    long = STALL_S
    if most is None:
        edges = turns(asked)
        if edges.size < 2:
            return ()
        # A sine is slower than the share s of its peak speed for 2 arcsin(s) / omega.
        omega = 2 * np.pi / float(np.median(np.diff(edges)))
        long = max(STALL_S, DWELL * 2 * float(np.arcsin(STANDING)) / omega)
        stalls = tuple(span for span in stalls if _constant(effort, span))
    return tuple(span for span in stalls if span[1] - span[0] >= long)


def _constant(effort: Series, span: Span) -> bool:
    """Return whether an effort keeps one value over a span."""
    i, j = np.searchsorted(effort.t_s, span)
    inside = effort.values[i : j + 1]
    return bool(np.std(inside) < CONSTANT * abs(float(np.mean(inside))))


@dataclass(frozen=True)
class _Joint:
    """One joint's channels over the whole session, as recorded and cleaned."""

    name: str
    raw: Mapping[str, Signal]
    series: Mapping[str, Series]
    limits: JointLimits | None
    driven: bool


def find_artefacts(session: SessionView, columns: Columns) -> tuple[Artefact, ...]:
    """Look at the whole session, joint by joint.

    Returns:
        What was found, in chain order.
    """
    limits = limits_of(session)
    commanded = columns.commanded()
    origin_ns = session.start_ns

    def of_joint(name: str) -> list[Artefact]:
        signals = {key: columns.of(key).get(name) for key in QUANTITIES}
        raw = {
            key: signal
            for key, signal in signals.items()
            if signal is not None and signal.t_ns.size
        }
        series = {
            key: channel for key, channel in clean_together(raw, origin_ns).items() if channel.count
        }
        joint = _Joint(name, raw, series, limits.get(name), name in commanded)
        return [
            Artefact(name, columns.topics.get(quantity, ""), quantity, flag, spans, note)
            for quantity, flag, spans, note in _of_joint(joint, origin_ns)
        ]

    samples = sum(signal.t_ns.size for key in QUANTITIES for signal in columns.of(key).values())
    return tuple(chain.from_iterable(in_threads(of_joint, columns.names, samples, session.forget)))


def _of_joint(joint: _Joint, origin_ns: int) -> _Found:
    """Quantity, flag, stretches and note of whatever one joint shows."""
    of_sensors = [*_of_sensors(joint)]
    yield from of_sensors
    # What a sensor falsifies says nothing about a limit.
    false = {quantity for quantity, flag, _, _ in of_sensors if flag in FALSIFYING}
    yield from (at_limit for at_limit in _at_limits(joint) if at_limit[0] not in false)
    for quantity in ("command", "position"):
        if quantity in joint.series:
            yield from _of_record(quantity, joint, origin_ns)


def _of_sensors(joint: _Joint) -> _Found:
    levels = () if joint.limits is None else joint.limits.values
    command = joint.series.get("command") if joint.driven else None
    sensed = {key: series for key, series in joint.series.items() if key != "command"}
    against = {"position": command}
    tops = {key: clipped(channel, levels, against.get(key)) for key, channel in sensed.items()}
    if "position" not in joint.series:
        yield "position", "not_recorded", (), ""
    else:
        yield from _of_position(joint, joint.series["position"], tops["position"])
    for quantity, spans in tops.items():
        if spans:
            yield quantity, "cut_off" if quantity in DRIVE else "clipped", spans, ""


def _of_position(joint: _Joint, position: Series, tops: tuple[Span, ...]) -> _Found:
    command, velocity = joint.series.get("command"), joint.series.get("velocity")
    way = None if velocity is None or velocity.count < 2 else integral(velocity)
    # Without a command the velocity says that a joint moves; one that is held still may stand.
    motion = way if command is None else command if joint.driven else None
    if stopped := _stalled(joint):
        yield "effort", "stalled", stopped, ""
    held: tuple[Span, ...] = ()
    if motion is not None:
        held = _apart(frozen(position, motion, way), [*stopped, *tops])
        if held:
            yield "position", "frozen", held, ""
        if old := stale(position):
            yield "position", "stale", old, ""
    rate = MOST_RATE if joint.limits is None else joint.limits.rate
    jumps = find_jumps(position, rate, (*held, *stopped))
    if jumps.wrapped:
        yield "position", "wrapped", jumps.wrapped, f"turn of {jumps.turn_rad:.4g} rad"
        return
    scales = [*_of_scale(joint, position, command if joint.driven else None, way)]
    yield from scales
    # A sign or unit that changes makes a step, somewhere in the cycles around.
    if jumps.jumped:
        edges = np.zeros(0) if motion is None else turns(motion)
        cycle = float(np.median(np.diff(edges))) if edges.size > 1 else 0.0
        scaled = chain.from_iterable(spans for q, _, spans, _ in scales if q == "position")
        other = [(a - cycle, b + cycle) for a, b in scaled]
        if left := _apart(jumps.jumped, other):
            yield "position", "jump", left, ""


def _linear(position: Series, command: Series) -> Series:
    """Return what a joint makes of a command that is no rhythm; a rhythm as it is."""
    asked, moved = (Samples(channel.t_s, channel.values) for channel in (command, position))
    course = course_of([RecordedJoint(command.name, asked, moved)])
    if course is None or np.isfinite(cycle_s(course.command[0], course.step_s)):
        return command
    row = course.command[0], course.position[0], course.present[0], course.step_s
    response = fit_response(*row)
    if response.explained < HALF:
        return command
    output = Filtered(course.command, course.step_s).output(response)[0]
    return Series(command.name, course.t_s, abs(response.gain) * output)


def _of_scale(
    joint: _Joint, position: Series, command: Series | None, way: Series | None
) -> _Found:
    """Sign, unit and scale against the command, a second sensor and the velocity's integral."""
    flags: set[str] = set()
    command, second, way = (
        channel if channel is not None and np.ptp(channel.values) > 0 else None
        for channel in (command, joint.series.get("reference"), way)
    )
    leader = command or second or way
    if leader is None:
        return
    edges = turns(leader)
    if command is not None:
        leading = _linear(position, command)
        both = (compare(position, channel, edges) for channel in (leading, rate_of(leading)))
        for flag, spans in against_command(*both).items():
            flags.add(flag)
            yield "position", flag, spans, ""
    if second is not None:
        by_second = compare(position, second, edges, noisy=True)
        for flag, spans in against_witness(by_second, SAME_SCALE).items():
            flags.add(flag)
            scale = float(np.nanmedian(by_second.ratio))
            yield "position", flag, spans, f"{scale:.3g} of the second sensor's"
    if way is not None:
        by_rate = compare(position, way, edges, noisy=True)
        # What the position is blamed for already is no fault of the velocity.
        for flag, spans in against_witness(by_rate, SAME_RATE).items():
            if flag not in flags:
                scale = 1 / float(np.nanmedian(by_rate.ratio))
                note = f"{scale:.3g} times the derivative of the position"
                yield "velocity", flag, spans, note if flag == "scale_mismatch" else ""


def _stalled(joint: _Joint) -> tuple[Span, ...]:
    position = joint.series["position"]
    limits = joint.limits if joint.limits is not None and joint.limits.stated else None
    for quantity, most in (
        ("effort", limits and limits.torque),
        ("current", limits and limits.current),
    ):
        if quantity in joint.series:
            asked = joint.series.get("command", position)
            return stalled(joint.series[quantity], position, most, asked)
    return ()


def _at_limits(joint: _Joint) -> _Found:
    limits = joint.limits
    if limits is None:
        return
    for quantity in ("command", "position"):
        if quantity in joint.series:
            channel = joint.series[quantity]
            if spans := saturated(channel, limits.lower, limits.upper, AT_LIMIT_RAD):
                yield quantity, "saturated", spans, "angle"
    sizes = [("velocity", limits.rate, "rate")]
    if limits.stated:
        sizes += [
            ("effort", limits.torque, "torque"),
            ("current", limits.current, "current"),
            ("voltage", limits.voltage, "voltage"),
        ]
    for quantity, most, note in sizes:
        slack = (1 - AT_LIMIT) * most
        channel = joint.series.get(quantity)
        if channel is not None and (spans := saturated(channel, -most, most, slack)):
            yield quantity, "saturated", spans, note


def _of_record(quantity: str, joint: _Joint, origin_ns: int) -> _Found:
    raw, channel = joint.raw[quantity], joint.series[quantity]
    seconds = (raw.t_ns - origin_ns).astype(np.float64) * 1e-9
    if channel.dropped_nan:
        yield quantity, "nan", spans_of(seconds, ~(np.abs(raw.values) <= LARGEST)), ""
    if channel.dropped_duplicates:
        again = np.concatenate((np.diff(raw.t_ns) == 0, [False]))
        yield quantity, "duplicate_stamps", tuple((t, t) for t in np.unique(seconds[again])), ""
    if channel.count < 2:
        return
    begin, end = channel.t_s[channel.gaps], channel.t_s[channel.gaps + 1]
    if float(np.sum(end - begin)) > GAP_SHARE * (channel.t_s[-1] - channel.t_s[0]):
        yield quantity, "gaps", tuple(zip(begin.tolist(), end.tolist(), strict=True)), ""


def _apart(spans: Sequence[Span], others: Sequence[Span]) -> tuple[Span, ...]:
    """Return the stretches that meet none of some others."""
    return tuple(s for s in spans if not any(s[0] < end and s[1] > start for start, end in others))
