"""Rules for the health of a session: findings and a verdict from the measures.

The measures come from :mod:`.tallies`, so the same rules apply to a file and to a live
recording. Every threshold has a name and a reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from ...judgement.fault import Fault as JointFault
from ...judgement.fault import Judgement, clause_of
from ..columns.names import one_name_sentences
from ..messages import COMMAND_TOPIC
from ..messages.definitions import VERDICTS
from ..messages.frames import FRAME_TOPIC_PREFIXES, bus_of
from ..read.facts import TIMES_FROM_FPS
from ..read.joint_messages import JOINT_TYPES
from .findings import WAITING, ChannelFault, Finding
from .freeze import FROZEN_SAMPLES
from .tallies import (
    NS,
    PAUSE_PERIODS,
    PAUSE_S,
    BusHealth,
    ChannelHealth,
    FileHealth,
    JointHealth,
    SeriesHealth,
)

GOOD_LOSS = 1e-3
"""Up to one sample in a thousand may be missing, not finite or repeated in a good session: less
than one in a gait cycle of ten seconds at 100 Hz."""

BAD_LOSS = 0.1
"""Losses above a tenth are rarely random: they follow bus load and hence the motion, so the
remaining samples are biased."""

LONG_GAP_S = 0.1
"""Shortest gap that makes a session degraded. Linear interpolation across T misses up to
1 - cos(pi f T) of the amplitude: 5 % for 0.1 s at 1 Hz, the quickest gaits of such robots."""

BAD_PAUSE = 0.5
"""With pauses over half of the time a session has more holes than data."""

MAX_JITTER = 0.25
"""Standard deviation of the intervals against their median: a quarter means that one sample in
twenty is half an interval off, so the rhythm of the source is disturbed."""

FROZEN_SECONDS = 2
"""Consecutive seconds that make a frozen joint; one alone may be a slow start of the motion."""

LIMIT_RAD = 1e-3
"""Distance at which a joint is at a limit: below one step of a 12-bit encoder (1.5 mrad)."""

MAX_AT_LIMIT = 0.1
"""A sine that just touches both limits of 30 degrees is within 1 mrad of them for
2 / pi arccos(1 - 1e-3 / 0.52) = 4 % of the time; beyond a tenth the joint is held there."""

MAX_BUS_LOAD = 0.8
"""From this part of the bitrate on, frames of low priority wait for many others."""

BAD_JOINTS = 0.5
"""With half of the joints dead the session no longer shows the robot's motion."""

VIEW_AIDS = ("/tf", "/tf_static", "/robot_description")
"""Never analysed, so never judged."""

OFFSET_TOPICS = ("/joint_sample_offset", "/joint_command_offset")
"""Offsets of the joints' sampling times, one message a stamp of the topic that they belong to: its
rhythm is judged."""

RECORDER_TOPICS = ("/rosout", "/diagnostics", "/clock/")
"""Topics of a recorder's own messages, which have no steady rate: an event may be logged late, and
a clock that was not read again repeats its last stamp."""


def judge_file(health: FileHealth) -> Iterator[Finding]:
    """Yield findings on the container."""
    yield from (Finding(2, sentence) for sentence in health.damage)
    if health.unfinished:
        yield Finding(0 if health.running else 1, health.unfinished)
    elif health.truncated:
        yield Finding(1, "the file is cut short: what came after the cut is lost")
    elif not health.indexed:
        yield Finding(1, "the file has no usable index and can only be read from the start")
    yield from (Finding(0, sentence) for sentence in health.notes)
    if health.without_crc:
        without = f"{health.without_crc} of {health.chunks} chunks carry no CRC"
        yield Finding(0, f"{without}: damage in them can't be excluded")


def judge_made_times(facts: Mapping[str, str]) -> Iterator[Finding]:
    """Note that times were made from a frame rate: what their rhythm would show is not in them."""
    if TIMES_FROM_FPS in facts:
        yield Finding(
            0,
            f"times made from fps = {facts[TIMES_FROM_FPS]}: jitter, gaps and lost samples can't "
            "be told, and lags are in error by up to a frame",
        )


def judge_channel(health: ChannelHealth) -> Iterator[ChannelFault]:
    """Yield what is wrong with one channel."""
    topic, expected = health.topic, health.count + (health.sequence.dropped or 0)
    if health.sequence.dropped:
        part = health.sequence.dropped / expected
        dropped = f"{health.sequence.dropped} of {expected} messages were dropped ({part:.2%})"
        text = f"{dropped}, as its sequence numbers prove"
        yield ChannelFault(2 if part >= BAD_LOSS else 1, topic, "", text)
    if health.sequence.reordered:
        yield ChannelFault(
            0, topic, "", f"{health.sequence.reordered} messages are out of sequence"
        )
    if health.unread:
        weight = 2 if health.unread >= BAD_LOSS * health.count else 1
        text = f"{health.unread} of {health.count} messages can't be decoded"
        yield ChannelFault(weight, topic, "", text)


def has_rhythm(topic: str) -> bool:
    """Whether the rhythm of a topic is judged."""
    return topic not in (*VIEW_AIDS, *OFFSET_TOPICS) and not topic.startswith(RECORDER_TOPICS)


def judge_series(
    health: SeriesHealth, start_ns: int, end_ns: int, commands_ns: int | None = None
) -> Iterator[ChannelFault]:
    """Yield what is wrong with the names and the rhythm of one series.

    Args:
        start_ns: Log time of the session's first message [Unix ns].
        end_ns: Log time of its last message [Unix ns].
        commands_ns: Log time of its first command [Unix ns]; None without commands.

    Yields:
        The faults; none for view aids and for the recorder's own topics.
    """
    for sentence in one_name_sentences([health.names]):
        yield ChannelFault(1, health.topic, "", f"{sentence}; give each its name")
    timing, label = health.timing, health.label
    if timing.median_s is None or not has_rhythm(health.topic):
        return
    when = _at(timing.longest_at_ns, timing.first_ns)
    joints = health.type_name.endswith("/JointState")
    span_s = (timing.last_ns - timing.first_ns) / NS
    mostly_paused = joints and timing.paused_s >= BAD_PAUSE * span_s
    if timing.gaps:
        yield from _gaps(health, when, mostly_paused=mostly_paused)
    elif joints and timing.paused_s:
        text = f"silent for {timing.paused_s:.3g} s in all; the longest pause is "
        yield ChannelFault(1 + mostly_paused, label, "", f"{text}{timing.longest_s:.3g} s, {when}")
    if timing.regular:
        faults = _edges_and_jitter(health, start_ns, end_ns, commands_ns)
        yield from (ChannelFault(weight, label, "", text) for weight, text in faults)
    elif joints and timing.count > FROZEN_SAMPLES:
        yield ChannelFault(0, label, "", "no steady rate, so single gaps can't be found")
    if timing.backward:
        yield ChannelFault(1, label, "", f"{timing.backward} stamps go back in time")
    if timing.duplicates:
        caught_up = health.topic == COMMAND_TOPIC and timing.late  # several cycles at once
        weight = int(timing.duplicates > GOOD_LOSS * timing.count and not caught_up)
        yield ChannelFault(weight, label, "", f"{timing.duplicates} stamps are repeated")
    if health.nan and not joints:
        weight = int(health.nan > GOOD_LOSS * health.numbers)
        yield ChannelFault(
            weight, label, "", f"{health.nan} of {health.numbers} numbers are not a number"
        )


def _gaps(health: SeriesHealth, when: str, *, mostly_paused: bool) -> Iterator[ChannelFault]:
    """Yield the faults of the gaps of a series: lost samples, and a sender that was late."""
    timing = health.timing
    lost, longest = timing.gaps - timing.late, f"the longest is {timing.longest_s:.3g} s, {when}"
    long = timing.longest_s > LONG_GAP_S and timing.longest_s > 2.5 * (timing.median_s or 0.0)
    where = (timing.longest_at_ns, timing.longest_at_ns + round(timing.longest_s * NS))
    if lost:
        scattered = timing.scattered / (timing.count + timing.scattered)
        yield ChannelFault(
            2
            if scattered >= BAD_LOSS or mostly_paused
            else int(timing.missing_part > GOOD_LOSS or long),
            health.label,
            "",
            f"{lost} gaps, {timing.missing} samples missing ({timing.missing_part:.2%}); {longest}",
            lost,
            where,
            timing.missing_part,
        )
    if timing.late:
        cycles = "command cycles" if health.topic == COMMAND_TOPIC else "cycles"
        yield ChannelFault(
            int(long and not lost),
            health.label,
            "",
            f"{timing.late} late {cycles} of the sender ({timing.late / timing.count:.2%} of the "
            f"samples), none lost in them; {longest}",
            timing.late,
            where,
            timing.late / timing.count,
            late=True,
        )


def _edges_and_jitter(
    health: SeriesHealth, start_ns: int, end_ns: int, commands_ns: int | None
) -> Iterator[tuple[int, str]]:
    """Describe faults of the start, the end and the intervals of a regular series.

    A series that starts with the first command waited for it, as a robot may; that is no fault.
    """
    timing, median_s = health.timing, health.timing.median_s or 0.0
    edge_s = max(PAUSE_S, PAUSE_PERIODS * median_s)
    late_s, early_s = (health.first_log_ns - start_ns) / NS, (end_ns - health.last_log_ns) / NS
    if late_s > edge_s:
        waited = commands_ns is not None and health.first_log_ns - commands_ns <= edge_s * NS
        text = f"starts {late_s:.3g} s after the session"
        yield (0, f"{text}, with the first command") if waited else (1, text)
    if early_s > edge_s:
        yield 1, f"ends {early_s:.3g} s before the session"
    if timing.std_s is not None and timing.std_s > MAX_JITTER * median_s:
        yield 1, f"the intervals jitter by {timing.std_s / median_s:.0%} of their median"


def judge_joints(joints: Sequence[JointHealth], start_ns: int) -> Iterator[ChannelFault]:
    """Yield what is wrong with the joints, each by itself.

    Args:
        joints: Measures of all joints of all topics.
        start_ns: Start of the session [Unix ns].
    """
    together = {topic for topic, same in _by_topic(joints).items() if _paused(same)}
    for topic in together:
        first = next(joint for joint in joints if joint.topic == topic and _is_frozen(joint))
        when = _at(first.frozen_at_ns, start_ns)
        text = f"all joints repeat their values for {first.frozen_s} s while their commands move, "
        yield ChannelFault(1, topic, "", f"{text}{when}: the bus, its driver or the robot paused")
    for joint in joints:
        for weight, text in _joint_faults(joint, start_ns, alone=joint.topic not in together):
            yield ChannelFault(weight, joint.topic, joint.name, text)


def _by_topic(joints: Iterable[JointHealth]) -> dict[str, list[JointHealth]]:
    topics: dict[str, list[JointHealth]] = {}
    for joint in joints:
        topics.setdefault(joint.topic, []).append(joint)
    return topics


def _paused(joints: Iterable[JointHealth]) -> bool:
    """Whether all commanded joints of a topic froze in the same seconds: no joint did it."""
    commanded = [joint for joint in joints if joint.frozen_s is not None]
    if len(commanded) < 2 or not all(map(_is_frozen, commanded)):
        return False
    begin = max(joint.frozen_at_ns for joint in commanded)
    end = min(joint.frozen_at_ns + (joint.frozen_s or 0) * NS for joint in commanded)
    longest_s = max(joint.frozen_s or 0 for joint in commanded)
    return 2 * (end - begin) > longest_s * NS


def _joint_faults(joint: JointHealth, start_ns: int, *, alone: bool) -> Iterator[tuple[int, str]]:
    if joint.nan:
        weight = int(joint.nan > GOOD_LOSS * joint.samples)
        yield weight, f"{joint.nan} of {joint.samples} samples are not a number"
    if alone and _is_frozen(joint):
        when = _at(joint.frozen_at_ns, start_ns)
        yield 1, f"frozen for {joint.frozen_s} s while its command moved, {when}"
    if joint.at_limit is not None and joint.at_limit > MAX_AT_LIMIT:
        yield 1, f"at the robot's limits in {joint.at_limit:.0%} of the samples"


def judge_body(measured: Sequence[JointHealth], lasted_s: float) -> Iterator[Finding]:
    """Yield findings on all measured joints together.

    Args:
        lasted_s: How long the session lasted [s]; a pause of less than :data:`BAD_PAUSE` of it that
            all joints share counts as no joint that is dead.
    """
    names = {joint.name for joint in measured}
    longest_s = max((joint.frozen_s or 0 for joint in measured), default=0)
    paused = _paused(measured) and longest_s < BAD_PAUSE * lasted_s
    dead = {
        joint.name
        for joint in measured
        if (_is_frozen(joint) and not paused) or joint.nan > BAD_LOSS * joint.samples
    }
    if len(names) > 1 and len(dead) >= BAD_JOINTS * len(names):
        yield Finding(2, f"{len(dead)} of {len(names)} joints are frozen or missing")


def _is_frozen(joint: JointHealth) -> bool:
    return (joint.frozen_s or 0) >= FROZEN_SECONDS


def judge_following(fault: JointFault) -> Finding:
    """Return the finding on a joint that does not follow its command."""
    when = "" if fault.since_s is None else f" from {fault.since_s:.3g} s"
    when += "" if fault.until_s is None else f" to {fault.until_s:.3g} s"
    return Finding(1, f"{fault.joint}{when} {fault.evidence}: {' or '.join(fault.kinds)}")


def judge_differences(judgement: Judgement) -> Iterator[Finding]:
    """Yield findings on names, and on joints that changed, or that move besides their command."""
    clauses = [clause_of(change, change.joint) for change in (*judgement.changes, *judgement.extra)]
    yield from (Finding(1, clause) for clause in (judgement.naming, *clauses) if clause)


def judge_bus(health: BusHealth) -> Iterator[Finding]:
    """Yield findings on a bus."""
    if health.error_frames:
        part = health.error_frames / health.frames
        weight = 2 if part >= BAD_LOSS else int(part > GOOD_LOSS)
        sentence = f"{health.topic}: {health.error_frames} of {health.frames} are error frames"
        yield Finding(weight, sentence)
    if health.peak_load is not None and health.peak_load[0] > MAX_BUS_LOAD:
        sentence = f"{health.topic}: {health.peak_load[0]:.0%} of the bitrate in the busiest second"
        yield Finding(1, sentence)


def judge_silences(buses: Iterable[BusHealth], start_ns: int) -> Iterator[Finding]:
    """Yield findings on times without any frame of a bus, classic or CAN FD.

    Of a bus with both kinds, the overlap of their longest silences counts.

    Args:
        buses: Measures of all topics of frames.
        start_ns: Start of the session [Unix ns].
    """
    silences: dict[str, tuple[str, int, int]] = {}
    for bus in buses:
        begin, end = bus.longest_at_ns, bus.longest_at_ns + round(bus.longest_s * NS)
        topic, earlier, later = silences.get(bus_of(bus.topic), (bus.topic, begin, end))
        silences[bus_of(bus.topic)] = topic, max(begin, earlier), min(end, later)
    for topic, begin, end in silences.values():
        if (silent_s := (end - begin) / NS) > PAUSE_S:
            yield Finding(1, f"{topic}: silent for {silent_s:.3g} s, {_at(begin, start_ns)}")


def judge_topics(
    types: dict[str, str],
    topics: tuple[str, str],
    joints: Sequence[str],
    seen: Iterable[str],
    undecoded: str | None = None,
    *,
    commanded: bool = False,
) -> Iterator[Finding]:
    """Yield findings on topics of joints that the session lacks.

    Args:
        types: Topic with messages to type.
        topics: Of commands and responses.
        joints: The robot's joints; empty without a robot.
        seen: Joints that the topic of responses carries.
        undecoded: Why almost no raw CAN frame could be decoded, which then is the only reason for
            missing topics; None otherwise.
        commanded: Whether the robot's bus map defines commands: then the frames show that none has
            come, and the session waits for the first.
    """
    if undecoded is not None:
        yield Finding(1, undecoded)
    framed = any(topic.startswith(FRAME_TOPIC_PREFIXES) for topic in types)
    others = sorted(topic for topic, kind in types.items() if kind in JOINT_TYPES)
    commands, responses = topics
    for topic in dict.fromkeys((responses, commands)):
        if topic in types:
            continue
        if topic == commands and framed and commanded and responses in types and not undecoded:
            yield WAITING
            continue
        if others:
            sentence = f"{topic} is missing; joints are on {', '.join(others)}"
        elif undecoded is not None:
            continue
        elif framed:
            sentence = f"{topic} is missing; there are raw CAN frames"
        else:
            sentence = f"{topic} is missing, and no other topic has joints"
        yield Finding(2 if (not others and not framed) else 1, sentence)
    present = set(seen)
    missing = [name for name in joints if name not in present]
    if present and missing:
        yield Finding(1, f"{responses} never carries {', '.join(missing)}")


def verdict_of(findings: Iterable[Finding]) -> str:
    """Return the verdict of the heaviest finding, ``good`` without findings."""
    return VERDICTS[max((finding.weight for finding in findings), default=0)]


def _at(t_ns: int, start_ns: int) -> str:
    return f"at {(t_ns - start_ns) / NS:.3f} s"
