"""Merge logs: all messages of several logs in one, interleaved by log time.

A topic of the same type in several logs becomes one topic. Equal metadata records and attachments
are kept once, different ones under different names; the sources' ids and hashes are kept. The
record ``undulog`` keeps the facts that are equal in all logs (those of each log are in
``undulog.source.N``), ``undulog.health`` the worst verdict.

Messages are ordered by log time, those of equal times by the order of the logs. A log whose own
messages are not in order of time keeps its order, so that memory holds one chunk per log; readers
of MCAP sort by log time.
"""

from __future__ import annotations

import hashlib
import heapq
import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import combinations
from pathlib import Path

from mcap.records import Schema

from ..common.errors import DataError, UsageError, some_names
from ..common.process import StopRequest
from .columns.layouts import names_of
from .columns.topics import Topics
from .edited_log import (
    EDIT_RECORD,
    HEALTH_RECORD,
    NS,
    EditedLog,
    EditReport,
    RawLog,
    RawMessage,
    earlier_edit_name,
    edited_log,
    free_name,
    portable,
    refuse_output,
)
from .messages.cdr import layout_of
from .messages.definitions import JOINT_STATE, VERDICTS, parse_message_type, stated_reasons

Record = tuple[str, dict[str, str]]

_SESSION_RECORD = "undulog"

LONGEST_MERGE_GAP_S = 86400.0
"""Logs with a longer time between them are merged only on request [s]: one of them is of another
day's session, or a clock was wrong."""

_LATER_S = 60.0


def copy_records(
    sources: Sequence[RawLog], log: EditedLog, robot: str, warnings: list[str]
) -> list[Record]:
    """Copy metadata and attachments.

    Args:
        robot: The robot of the merged session; empty if no log names one.
        warnings: Gets one sentence for each renamed record.

    Returns:
        The records for the end, with name and entries.
    """
    # The records of the robot that the session is of come first: they keep their names.
    ordered = sorted(sources, key=lambda source: bool(robot) and source.robot != robot)
    records, health = _merged_metadata(sources, robot, warnings)
    for name, entries in records:
        log.note(name, entries)
    copies: dict[str, list[bytes]] = {}
    for source in ordered:
        for attachment in source.attachments:
            if attachment.data in copies.get(attachment.name, []):
                continue
            name = free_name(attachment.name, copies, "{stem}-{n}{suffix}")
            if name != attachment.name:
                warnings.append(
                    f"{attachment.name} of {source.path} differs from another one: kept as {name}"
                )
            copies.setdefault(attachment.name, []).append(attachment.data)
            copies.setdefault(name, [attachment.data])
            log.attach(attachment, name)
    return health


def _merged_metadata(
    sources: Sequence[RawLog], robot: str, warnings: list[str]
) -> tuple[list[Record], list[Record]]:
    sessions = [source.file.metadata.get(_SESSION_RECORD) for source in sources]
    first: list[Record] = []
    if any(sessions):
        first.append((_SESSION_RECORD, _merged_session(sources, robot)))
    if len({json.dumps(facts, sort_keys=True) for facts in sessions if facts}) > 1:
        first += [(f"undulog.source.{k + 1}", facts) for k, facts in enumerate(sessions) if facts]
    kept: dict[str, list[dict[str, str]]] = {}
    taken = {name for name, _ in first} | {EDIT_RECORD}
    for source in sources:
        for record in source.metadata:
            is_edit = record.name == EDIT_RECORD or record.name.startswith(f"{EDIT_RECORD}.")
            base = EDIT_RECORD if is_edit else record.name
            if base in (_SESSION_RECORD, HEALTH_RECORD) or record.metadata in kept.get(base, []):
                continue
            name = earlier_edit_name(taken) if is_edit else free_name(base, taken, "{name}.{n}")
            if name != base and not is_edit:
                warnings.append(
                    f"metadata {base} of {source.path} differs from another one: kept as {name}"
                )
            taken.add(name)
            kept.setdefault(base, []).append(record.metadata)
            first.append((name, record.metadata))
    health = _merged_health(sources)
    return first, [(HEALTH_RECORD, health)] if health else []


def _merged_session(sources: Sequence[RawLog], robot: str) -> dict[str, str]:
    """Return the facts that are equal in all logs, with a new id for logs of several sessions."""
    stated = [facts for s in sources if (facts := s.file.metadata.get(_SESSION_RECORD))]
    every = {key: [f[key] for f in stated if key in f] for f in stated for key in f}
    facts = {key: values[0] for key, values in every.items() if len(set(values)) == 1}
    if "session_id" not in facts:
        digests = "".join(source.sha256 for source in sources)
        facts["session_id"] = f"merge-{hashlib.sha256(digests.encode()).hexdigest()[:16]}"
    epochs = [int(value) for value in every.get("epoch_ns", []) if value.isdecimal()]
    if epochs:
        facts["epoch_ns"] = str(min(epochs))
    facts["robot"] = robot
    return facts


def _merged_health(sources: Sequence[RawLog]) -> dict[str, str]:
    """Return the worst verdict, and the reasons of all logs."""
    stated = {
        source: facts for source in sources if (facts := source.file.metadata.get(HEALTH_RECORD))
    }
    if not stated:
        return {}
    facts = list(stated.values())
    if len(stated) == len(sources) and all(other == facts[0] for other in facts):
        return facts[0]
    verdicts = [entry.get("verdict", "") for entry in facts]
    worst = max(verdicts, key=lambda v: VERDICTS.index(v) if v in VERDICTS else len(VERDICTS))
    reasons = [
        f"{source.path.name}: {reason}"
        for source in sources
        for reason in _reasons(stated.get(source))
    ]
    return {"verdict": worst, "reasons": json.dumps(reasons)}


def _reasons(health: dict[str, str] | None) -> list[str]:
    if health is None:
        return ["states no verdict"]
    return [health.get("verdict", "no verdict"), *stated_reasons(health)]


def merge_logs(
    paths: Sequence[Path],
    output: Path,
    *,
    robot: str | None = None,
    apart: bool = False,
    force: bool = False,
    stop: StopRequest | None = None,
) -> EditReport:
    """Write the messages of several logs to one new file.

    Args:
        paths: The logs, two or more.
        robot: The robot of the merged session, for logs of different robots.
        apart: Merge logs with more than :data:`LONGEST_MERGE_GAP_S` between them.

    Raises:
        UsageError: If there are fewer than two logs, one is given twice, they are of different
            robots and ``robot`` names none of them, they lie far apart in time and ``apart`` is
            not given, or the output is not possible.
        DataError: If a topic has different types or units in two logs, or there is no message.
        LogError: If a log can't be read or the new one can't be written.
        UndulogError: If a stop was requested; no file is left then.
    """
    if len(paths) < 2:
        raise UsageError("a merge needs two logs or more")
    refuse_output(output, paths, force=force)
    stop = stop or StopRequest()
    with ExitStack() as stack:
        sources = [stack.enter_context(RawLog(path)) for path in paths]
        _refuse_twice(sources)
        of_robot = _common_robot(sources, robot)
        _refuse_other_types(sources)
        warnings = [*_other_robots(sources, of_robot), *_apart(sources, allowed=apart)]
        warnings += _mixed(sources)
        with edited_log(sources, output, force=force, stop=stop) as log:
            last = copy_records(sources, log, of_robot, warnings)
            merged = heapq.merge(
                *(_in_order(source, log) for source in sources), key=lambda entry: entry[0]
            )
            log.write_all(
                f"merging {len(sources)} logs",
                ((channel_id, message) for _, channel_id, message in merged),
                (
                    min(source.start_ns for source in sources),
                    max(source.end_ns for source in sources),
                ),
                stop,
            )
            if log.first_ns is None:
                raise DataError(f"there is no message in {', '.join(map(str, paths))}")
            warnings += [sentence for source in sources for sentence in source.warnings]
            facts = {
                "verb": "merge",
                "undulog": version("undulog"),
                "sources": json.dumps([source.path.name for source in sources]),
                "session_ids": json.dumps([source.session_id for source in sources]),
                "sha256": json.dumps([source.sha256 for source in sources]),
                "robot": of_robot,
                "warnings": portable(warnings, sources),
            }
            for name, entries in [(EDIT_RECORD, facts), *last]:
                log.note(name, entries)
    return EditReport(
        output=output,
        sources=[source.facts for source in sources],
        **log.measures(),
        warnings=warnings,
    )


def _refuse_twice(sources: Sequence[RawLog]) -> None:
    for first, other in combinations(sources, 2):
        if first.sha256 == other.sha256:
            raise UsageError(f"{first.path} and {other.path} are the same log, byte for byte")


def _common_robot(sources: Sequence[RawLog], chosen: str | None) -> str:
    """Return the robot of the merged session; empty if no log names one."""
    robots = {source.robot: source.path for source in reversed(sources) if source.robot}
    if chosen is not None:
        if chosen not in robots:
            there = ", ".join(sorted(robots)) or "none"
            raise UsageError(f"--robot {chosen}: the logs' robots are: {there}")
        return chosen
    if len(robots) > 1:
        listed = ", ".join(f"{name} ({path})" for name, path in reversed(robots.items()))
        raise UsageError(
            f"the logs are of different robots: {listed}; a session has one robot: choose it by "
            "--robot NAME; its description keeps its name"
        )
    return next(iter(robots), "")


def _refuse_other_types(sources: Sequence[RawLog]) -> None:
    """Refuse topics of one name with different types or units."""
    faults: list[str] = []
    for (first, kinds), (other, others) in combinations(
        [(source, _kinds(source)) for source in sources], 2
    ):
        for topic in sorted(kinds.keys() & others.keys()):
            this, that = kinds[topic], others[topic]
            if this.definitions != that.definitions:
                a, b = ", ".join(sorted(this.names)), ", ".join(sorted(that.names))
                b = b if a != b else "the same name with another definition"
            elif this.units and that.units and this.units != that.units:
                a, b = (f"in {', '.join(sorted(kind.units))}" for kind in (this, that))
            else:
                continue
            faults.append(f"{topic} is {a} in {first.path} and {b} in {other.path}")
    if faults:
        raise DataError(
            f"{'; '.join(faults)}. A topic has one type and one unit: leave it out of one log "
            "first (undulog log cut --topics)"
        )


@dataclass
class _Kind:
    """Types and units of a topic; one entry each, unless the log is inconsistent.

    Attributes:
        names: Types, with their encoding if it is not that of ROS 2.
    """

    names: set[str] = field(default_factory=set[str])
    definitions: set[object] = field(default_factory=set[object])
    units: set[str] = field(default_factory=set[str])


def _kinds(source: RawLog) -> dict[str, _Kind]:
    kinds: dict[str, _Kind] = {}
    definitions = {key: _definition(schema) for key, schema in source.file.schemas.items()}
    for channel in source.file.channels.values():
        kind = kinds.setdefault(channel.topic, _Kind())
        schema = source.file.schemas.get(channel.schema_id)
        coding = channel.message_encoding, schema.encoding if schema is not None else ""
        name = source.type_name(channel) or "without a type"
        kind.names.add(name if coding == ("cdr", "ros2msg") else f"{name} ({'/'.join(coding)})")
        kind.definitions.add((name, coding, definitions.get(channel.schema_id)))
        if channel.metadata.get("unit"):
            kind.units.add(channel.metadata["unit"])
    return kinds


def _definition(schema: Schema) -> object:
    """Return a message definition for comparison, without comments and spaces."""
    if schema.encoding == "ros2msg":
        with suppress(DataError):  # what can't be parsed is compared as bytes
            return parse_message_type(schema.name, schema.data.decode("utf-8", "replace"))
    return schema.data


def _other_robots(sources: Sequence[RawLog], robot: str) -> Iterator[str]:
    """Warn of logs that are not, or probably not, of the merged session's robot."""
    for source in sources:
        if source.robot and source.robot != robot:
            fact = f"{source.path} is of {source.robot}, not of {robot}"
            yield f"{fact}: its messages are merged all the same"
    joints = [(source, _joint_names(source)) for source in sources]
    for (first, names), (other, others) in combinations(joints, 2):
        unstated = not first.robot or not other.robot
        if unstated and names and others and names.isdisjoint(others):
            here, there = (some_names(sorted(group), 3) for group in (names, others))
            yield (
                f"{first.path} has {here}, {other.path} has {there}: no joint "
                "is in both, are they of one robot?"
            )


def _joint_names(source: RawLog) -> set[str]:
    """Return the joints in the first message of each JointState topic."""
    topics, names = Topics(source.file, source.warn), set[str]()
    pending = {
        topic
        for topic, channel in topics.channels.items()
        if channel.type_name == JOINT_STATE and channel.is_ros2 and channel.count
    }
    for topic, message in topics.raw_of(pending):
        pending.discard(topic)
        with suppress(DataError):  # of a damaged message
            names.update(names_of(layout_of(topics.message_type(topic), message)))
    return names


def _apart(sources: Sequence[RawLog], *, allowed: bool) -> Iterator[str]:
    """Warn of logs with time between them, and refuse those that are far apart."""
    ordered = sorted(
        (source for source in sources if source.end_ns), key=lambda source: source.start_ns
    )
    for k, later in enumerate(ordered[1:], start=1):
        earlier = max(ordered[:k], key=lambda source: source.end_ns)
        gap_s = (later.start_ns - earlier.end_ns) / NS
        sentence = f"{later.path} begins {_span(gap_s)} after {earlier.path} ends"
        if gap_s > LONGEST_MERGE_GAP_S and not allowed:
            raise UsageError(f"{sentence}: not one session; --apart merges them all the same")
        if gap_s > _LATER_S:
            yield sentence


def _span(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0)):
        if seconds > size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


def _mixed(sources: Sequence[RawLog]) -> Iterator[str]:
    """Warn of logs that hold the same topics at the same times."""
    for first, other in combinations(sources, 2):
        start, stop = max(first.start_ns, other.start_ns), min(first.end_ns, other.end_ns)
        topics = {c.topic for c in first.file.channels.values() if first.file.counts.get(c.id)} & {
            c.topic for c in other.file.channels.values() if other.file.counts.get(c.id)
        }
        if start <= stop and topics:
            yield (
                f"{first.path} and {other.path} overlap by {(stop - start) / NS:.2f} s and share "
                f"{len(topics)} topics ({', '.join(sorted(topics)[:3])}"
                f"{', ...' if len(topics) > 3 else ''}): their messages are mixed"
            )


def _in_order(source: RawLog, log: EditedLog) -> Iterator[tuple[int, int, RawMessage]]:
    """Yield latest log time so far, new channel id and message, in the order of the file."""
    ids = {c.id: log.channel(source, c) for c in source.file.channels.values()}
    latest_ns = 0
    for message in source.messages(ids):
        latest_ns = max(latest_ns, message.log_time_ns)
        yield latest_ns, ids[message.channel_id], message
