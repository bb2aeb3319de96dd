"""Commands ``log info``: what a log holds, and ``log check``: its health, from its data alone."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.console import emit, progress
from ..common.errors import DataError, UsageError
from ..common.part_files import SUFFIX
from ..log.file.content import session_label
from ..log.messages.definitions import CONTRACT_VERSION
from .sessions import SessionLine, each_session, sessions_of, show, stated_gait
from .topic_options import CONTRACT, JointTopicOptions

if TYPE_CHECKING:
    from ..log.columns.topics import Channel
    from ..log.health.bus_tally import SourceHealth
    from ..log.health.contract import Violation
    from ..log.health.session_check import SessionHealth
    from ..log.health.tallies import BusHealth, SeriesHealth
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
            "size_bytes": session.size,
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
    from ..log.messages.frames import FD_TOPIC_PREFIX

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


def log_info(file: Path, /, *more: Path, json: bool = False) -> int:
    """Show what a log holds: robot, times, topics, attachments, and what is wrong with it.

    Several logs, folders of them or patterns give a table, a line each.

    Example: `undulog log info run.mcap`

    Args:
        file: An MCAP file, of any make, or its URL; of a split session any part, or the folder.
        more: More of them; a folder has all logs in it, a pattern such as 'runs/**/*.mcap' too.
        json: Print one JSON object, or for several logs a list of them.
    """
    from ..log.read.session import Session

    paths = sessions_of([file, *more])
    if len(paths) > 1:
        return show(each_session(paths, "log info", _info_line), as_json=json)
    with Session.open(paths[0]) as session:
        facts = describe(session)
    emit(facts, _info_lines(facts), as_json=json)
    return 0


def _info_line(path: Path) -> SessionLine:
    from ..log.read.session import Session

    with Session.open(path) as session:
        facts, gait = describe(session), stated_gait(session.metadata)
    first = next(_info_lines(facts)).removeprefix(f"{_label(facts['session'])}: ")
    left = next((text for text in facts["warnings"] if SUFFIX in text), "")
    first = left or first  # a file that a killed writer left
    robot, verdict = facts["session"]["robot"] or "", facts["session"]["verdict"] or ""
    return SessionLine(robot, gait, verdict, first, facts)


def _label(session: dict[str, Any]) -> str:
    return session_label(session["id"], session["path"])


def _info_lines(facts: dict[str, Any]) -> Iterator[str]:
    session = facts["session"]
    robot = f"{session['robot']}, {session['joints']} joints" if session["robot"] else "no robot"
    messages = sum(topic["messages"] for topic in facts["topics"])
    parts = f" in {len(session['files'])} parts" if len(session["files"]) > 1 else ""
    held = (
        f"{session['duration_s']:.2f} s from {session['start_utc']}, {messages} messages"
        if session["start_utc"]
        else "no messages"
    )
    yield f"{_label(session)}: {robot}, {held}, {_size(session['size_bytes'])}{parts}"
    yield from (f"warning: {warning}" for warning in facts["warnings"])
    foreign = Counter(t["encoding"] or "no encoding" for t in facts["topics"] if not t["read"])
    if foreign:
        order = sorted(foreign.items(), key=lambda item: (-item[1], item[0]))
        listed = ", ".join(f"{encoding} {count}" for encoding, count in order)
        topics = "1 topic is" if foreign.total() == 1 else f"{foreign.total()} topics are"
        yield f"warning: {topics} not of ROS 2 and can't be read, only listed: {listed}"
    names = [_type(topic) for topic in facts["topics"]]
    width = max([len(topic["topic"]) for topic in facts["topics"]] + [5])
    kinds = max([len(name) for name in names] + [4])
    yield ""
    yield f"{'topic':<{width}}  {'type':<{kinds}}  {'messages':>8}  {'rate/Hz':>8}  unit"
    for topic, name in zip(facts["topics"], names, strict=True):
        rate = f"{topic['rate_hz']:8.1f}" if topic["rate_hz"] is not None else " " * 8
        held = f"{topic['frames']} frames" if topic["frames"] is not None else topic["unit"] or ""
        start = f"{topic['topic']:<{width}}  {name:<{kinds}}  {topic['messages']:>8}"
        yield f"{start}  {rate}  {held}".rstrip()
    if facts["attachments"]:
        listed = (f"{name} ({size} bytes)" for name, size in facts["attachments"].items())
        yield ""
        yield f"attached: {', '.join(listed)}"
    writer = session["library"] or "an unnamed program"
    yield f"verdict: {session['verdict'] or 'none stored'}; written by {writer}"


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


def log_check(
    file: Path,
    /,
    *more: Path,
    contract: bool = False,
    topics: JointTopicOptions = CONTRACT,
    json: bool = False,
) -> int:
    """Judge whether a recorded session is good, degraded or bad, and why.

    Everything is computed from the data: rhythm, gaps, jitter and dropped messages of every
    channel, values that are not a number, frozen joints and joints at their limits, the CRC of
    every chunk, error frames and load of the bus. Exit code 1 for a bad session.
    Several logs, folders of them or patterns give a table, a line each.
    With `--contract` the question is another: does a log, of any make, follow the log contract,
    and what has its writer to do where it doesn't?

    Example: `undulog log check run.mcap`

    A bag of ROS: `undulog log check BAG --response-topic /arm/joint_states`

    Args:
        file: An MCAP file, of any make, or its URL, which is fetched whole.
        more: More of them; a folder has all logs in it, a pattern such as 'runs/**/*.mcap' too.
        contract: Check against the log contract; exit code 1 for a log that breaks it.
        topics: Where commands and responses are.
        json: Print one JSON object, or for several logs a list of them.
    """
    from ..log.health.session_check import check_session

    if contract and topics != CONTRACT:
        why = "--contract checks all topics; leave out --command-topic and --response-topic"
        raise UsageError(why)
    paths = sessions_of([file, *more])
    if contract:
        return _check_contracts(paths, as_json=json)
    if len(paths) > 1:
        work = partial(_check_line, topics=topics)
        return show(each_session(paths, "log check", work), as_json=json)
    (file,) = paths
    with progress(f"checking {file.name}", 1.0) as bar:
        health = check_session(file, bar.update, topics=topics.names)
    emit(as_json(health) if json else {}, _check_lines(health), as_json=json)
    return int(health.verdict == "bad")


def _check_contracts(paths: Sequence[Path], *, as_json: bool) -> int:
    from ..log.health.contract import RULES, check_contract

    if len(paths) > 1:
        return show(each_session(paths, "log check", _contract_line), as_json=as_json)
    (path,) = paths
    contract = check_contract(path)
    facts = _contract_facts(path, contract)
    verdict = f"{_count(contract)} of" if contract else f"follows all {len(RULES)} rules of"
    head = f"{path.name}: {verdict} the log contract, version {facts['contract']}"
    emit(facts, [head, *(f"  {violation}" for violation in contract)], as_json=as_json)
    return int(bool(contract))


def _contract_line(path: Path) -> SessionLine:
    from ..log.health.contract import check_contract
    from ..log.read.session import Session

    contract = check_contract(path)
    with Session.open(path) as session:
        robot = session.robot.name if session.robot is not None else ""
        gait = stated_gait(session.metadata)
    first = str(contract[0]) if contract else "follows the log contract"
    verdict = _count(contract) if contract else "follows"
    return SessionLine(robot, gait, verdict, first, _contract_facts(path, contract), not contract)


def _count(violations: Sequence[Violation]) -> str:
    return f"{len(violations)} violation{'s' if len(violations) != 1 else ''}"


def _contract_facts(path: Path, contract: Sequence[Violation]) -> dict[str, Any]:
    violations = [asdict(violation) for violation in contract]
    return {
        "path": str(path),
        "contract": str(CONTRACT_VERSION),
        "follows": not contract,
        "violations": violations,
    }


def _check_line(path: Path, topics: JointTopicOptions) -> SessionLine:
    from ..log.health.session_check import check_session
    from ..log.read.session import Session

    health = check_session(path, topics=topics.names)
    with Session.open(path) as session:
        gait = stated_gait(session.metadata)
    sentences = (*health.reasons, *health.notes, "nothing is wrong with it")
    good = health.verdict != "bad"
    return SessionLine(
        health.robot or "", gait, health.verdict, sentences[0], as_json(health), good
    )


def as_json(health: SessionHealth) -> dict[str, Any]:
    """Return a session's health as plain JSON values.

    Returns:
        ``verdict``, ``reasons``, ``notes``, ``stored``, ``session``, ``file``, ``channels``,
        ``series``, ``joints``, ``buses``, ``sources``; what can't be computed is null.
    """
    series = [
        asdict(series) | {"timing": asdict(series.timing) | {"rate_hz": series.timing.rate_hz}}
        for series in health.series
    ]
    return {
        "verdict": health.verdict,
        "reasons": list(health.reasons),
        "notes": list(health.notes),
        "stored": {
            "verdict": health.stored,
            "reasons": list(health.stored_reasons),
            "differs": None if health.stored is None else health.stored != health.verdict,
        },
        "session": {
            "id": health.session_id,
            "path": str(health.path),
            "robot": health.robot,
            "start_ns": health.start_ns,
            "duration_s": health.duration_s,
        },
        "file": asdict(health.file),
        "channels": [asdict(channel) for channel in health.channels],
        "series": series,
        "joints": [asdict(joint) for joint in health.joints],
        "buses": [asdict(bus) for bus in health.buses],
        "sources": [asdict(source) for source in health.sources],
    }


def _check_lines(health: SessionHealth) -> Iterator[str]:
    robot = f"{health.robot}, " if health.robot else ""
    count = len(health.reasons)
    why = f", for {count} reason{'s' if count != 1 else ''}" if count else ""
    name = session_label(health.session_id, health.path)
    yield f"{health.verdict}: {name}, {robot}{health.duration_s:.2f} s{why}"
    yield from (f"  {sentence}" for sentence in health.reasons)
    yield from (f"  note: {sentence}" for sentence in health.notes)
    yield _stored_line(health)
    yield from _series_lines(health)
    for line in (*map(_bus_line, health.buses), *map(_source_line, health.sources)):
        yield from ("", line)
    yield from _sequence_lines(health)
    file = health.file
    crc = f"{file.checked} of {file.chunks} chunks have the CRC that they should have"
    yield from ("", f"{crc}, {file.without_crc} carry none")
    yield (
        "Intervals are between stamps (log times where there are none); a gap is longer than 1.5 "
        "medians."
    )


def _stored_line(health: SessionHealth) -> str:
    if health.stored is None:
        return "stored verdict: none"
    if health.stored == health.verdict:
        return f"stored verdict: {health.stored}, the same"
    reasons = f" ({'; '.join(health.stored_reasons)})" if health.stored_reasons else ""
    return f"stored verdict: {health.stored}{reasons}; from the data: {health.verdict}"


def _series_lines(health: SessionHealth) -> Iterator[str]:
    width = max([len(series.label) for series in health.series] + [6])
    yield ""
    yield (
        f"{'series':<{width}}  {'samples':>8}  {'rate/Hz':>8}  {'gaps':>5}  {'missing':>7}  "
        f"{'longest/s':>9}  {'jitter':>6}  {'p99':>5}  {'twice':>5}  {'back':>4}  {'NaN':>6}"
    )
    yield from (_series_line(series, width) for series in health.series)


def _series_line(health: SeriesHealth, width: int) -> str:
    timing = health.timing
    rhythm = timing.regular and timing.median_s
    jitter = f"{(timing.std_s or 0) / timing.median_s:.1%}" if rhythm and timing.median_s else "-"
    p99 = f"{(timing.p99_s or 0) / timing.median_s:.2f}" if rhythm and timing.median_s else "-"
    gaps, missing = (timing.gaps, timing.missing) if rhythm else ("-", "-")
    rate = f"{timing.rate_hz:.1f}" if timing.rate_hz is not None else "-"
    return (
        f"{health.label:<{width}}  {timing.count:>8}  {rate:>8}  {gaps:>5}  {missing:>7}  "
        f"{timing.longest_s:>9.3g}  {jitter:>6}  {p99:>5}  {timing.duplicates:>5}  "
        f"{timing.backward:>4}  {health.nan:>6}"
    )


def _sequence_lines(health: SessionHealth) -> Iterator[str]:
    kinds: dict[str, list[str]] = {}
    for channel in health.channels:
        kinds.setdefault(channel.sequence.kind, []).append(channel.topic)
    counted = [channel for channel in health.channels if channel.sequence.kind == "counted"]
    dropped = math.fsum(channel.sequence.dropped or 0 for channel in counted)
    yield ""
    if counted:
        yield f"sequence numbers: {dropped:.0f} messages dropped in {len(counted)} channels"
    if "none" in kinds:
        yield f"no sequence numbers, so drops can't be proved: {', '.join(kinds['none'])}"
    if "not a count" in kinds:
        yield f"sequence numbers that don't count messages: {', '.join(kinds['not a count'])}"


def _source_line(source: SourceHealth) -> str:
    lost = "losses unknown" if source.dropped is None else f"{source.dropped} lost before us"
    return (
        f"source {source.name}, as its recorder counted: {source.frames} frames, {lost}, "
        f"{source.malformed} unreadable, connected again {source.reconnects} times"
    )


def _bus_line(bus: BusHealth) -> str:
    from ..log.messages.frames import FD_TOPIC_PREFIX

    rate = f", {bus.rate_hz:.1f} Hz" if bus.rate_hz is not None else ""
    fd = bus.topic.startswith(FD_TOPIC_PREFIX)
    load = ", load not estimated" if fd else ", load unknown (no bitrate)"
    if bus.load is not None and bus.peak_load is not None:
        load = (
            f", load {bus.load[0]:.1%} to {bus.load[1]:.1%} of the bitrate "
            f"(busiest second {bus.peak_load[0]:.1%} to {bus.peak_load[1]:.1%})"
        )
    return (
        f"{bus.topic}: {bus.frames} frames{rate}, {bus.error_frames} error frames, "
        f"longest silence {bus.longest_s:.3g} s{load}"
    )
