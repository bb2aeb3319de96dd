"""Recordings of ROS into sessions: joints of any type on the topics of the log contract.

A message of joints gives a message of the session, with its stamp and its log time; a point of a
trajectory gives one at the point's time. Messages of other types are kept if the log contract has
their type, byte for byte; the rest is counted and named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....common.arrays import NS
from ....common.console import progress, refuse_existing
from ....common.errors import DataError, ImportFormatError, MissingChannelError, some_names
from ....common.files import check_stop
from ....common.process import StopRequest
from ....log.cut import cut_log
from ....log.edited_log import RawLog
from ....log.file.bag import check_room, is_bag
from ....log.mcap.chunk import LAST_NS
from ....log.messages.definitions import TRAJECTORY, is_of_contract
from ....log.read.joint_messages import INTERFACE_UNITS, UNITS, JointRows, joint_source
from ....log.read.joint_topics import COMMAND_TOPIC, HOW_TO_CHOOSE, RESPONSE_TOPIC, JointTopics
from ....log.read.sample_times import MOST_JOINTS
from ....log.read.session import Session
from ....log.write.channels import JointStateChannel
from ....log.write.writer import SessionWriter
from ...reports import ImportReport
from ...session_import import digest_of, imported_session

_WINDOW_NS = 20 * NS
_MOST_WINDOWS = 2000
_MOST_NAMED = 20
_COPYING = 0.4
"""Share of the progress that is the copy of a bag that isn't a plain MCAP file."""


def import_bag(
    source: Path,
    output: Path,
    *,
    robot: str | None = None,
    topics: tuple[str, str] = (COMMAND_TOPIC, RESPONSE_TOPIC),
    force: bool = False,
    stop: StopRequest | None = None,
) -> ImportReport:
    """Turn a recording of ROS into a session, one window after the other.

    A session that was exported as a rosbag2 folder is copied, messages and records as they are.

    Args:
        robot: Description of its robot, a name or a file.
        topics: Of commands and responses, as :meth:`.SessionView.joint_topics` takes them.
        stop: Ends the import early, with a whole file of what was written so far.

    Raises:
        NotALogError: If the recording is damaged or of an unknown kind.
        ImportFormatError: If it is the file of a session, has no joints, or is an exported
            session whose robot or topics were to be chosen.
        MissingChannelError: If a topic that was chosen is not there.
        LogError: If the disk has no room.
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If the output can't be written.
    """
    refuse_existing(output, force=force)
    check_room(source, output.absolute().parent)
    with ExitStack() as stack:
        bar = stack.enter_context(progress(f"import {source.name}", 1.0))
        begun = _COPYING if is_bag(source) else 0.0

        def copied(share: float) -> None:
            check_stop(output, stop)
            bar.update(begun * share, "reading")

        session = stack.enter_context(
            Session.open(
                source, column_folder=output.absolute().parent, robot=robot, on_copied=copied
            )
        )
        if session.library.startswith("undulog/"):
            _check_exported(source, robot, topics)
            return _restored(source, session, output, force=force, stop=stop)
        joint_topics = _found(source, session, topics)
        report = ImportReport(
            source, output, session.robot.name if session.robot else "unknown robot"
        )
        report.start_ns, report.end_ns = session.start_ns, session.end_ns
        report.notes += joint_topics.notes
        files = [source] if source.is_file() else sorted(p for p in source.iterdir() if p.is_file())
        facts = {
            "import.format": "rosbag1" if source.suffix == ".bag" else "rosbag2",
            "import.time": "as recorded",
            "import.commands": joint_topics.command,
            "import.responses": joint_topics.response,
        }
        writer = stack.enter_context(
            imported_session(
                source, output, session.robot, epoch_ns=report.start_ns, facts=facts, force=force,
                digest=partial(digest_of, files),
            )
        )  # fmt: skip
        joints = _Joints(session, writer, joint_topics, report)
        for share in joints.write(stop):
            bar.update(begun + (1 - begun) * share / 2, "joints")
        if report.complete:
            others = _Others(session.files[0], session, writer, joints.taken, report)
            for share in others.write(stop):
                bar.update(begun + (1 - begun) * (1 + share) / 2, "other topics")
        report.problems += [
            warning for warning in session.warnings if warning not in report.problems
        ]
        writer.set_verdict(report.verdict, [*report.problems, *report.notes])
    return report


def _check_exported(source: Path, robot: str | None, topics: tuple[str, str]) -> None:
    """Check that a recording that undulog wrote can be copied as a session.

    Raises:
        ImportFormatError: If it is a session's file, or options would change the session.
    """
    if not source.is_dir():
        why = f"is a session of undulog already; use it as it is: undulog analyse {source.name}"
        raise ImportFormatError(source, why)
    if robot is not None or topics != (COMMAND_TOPIC, RESPONSE_TOPIC):
        why = (
            "was exported by undulog and is copied as it is; leave out --robot, --command-topic "
            "and --response-topic here and give them to the commands that read the session"
        )
        raise ImportFormatError(source, why)


def _restored(
    source: Path, session: Session, output: Path, *, force: bool, stop: StopRequest | None
) -> ImportReport:
    """Copy an exported session, with its messages, records and attachments as they are."""
    copied = cut_log(source, output, force=force, stop=stop)
    return ImportReport(
        source,
        output,
        session.robot.name if session.robot else "unknown robot",
        session.start_ns,
        session.end_ns,
        samples=copied.messages,
        problems=copied.warnings,
        notes=[f"session {session.session_id}, exported by undulog, is copied as it is"],
    )


def _found(source: Path, session: Session, topics: tuple[str, str]) -> JointTopics:
    joint_topics = session.joint_topics(*topics)
    names = [joint_topics.command, joint_topics.response]
    if not any(session.joint_channel(name) for name in names):
        there = joint_topics.others or sorted(session.channels)
        raise MissingChannelError(source, " or ".join(names), there, HOW_TO_CHOOSE)
    return joint_topics


@dataclass(frozen=True)
class _Target:
    """A topic of the session and the name of its joints in the recording.

    Attributes:
        joints: All of its joints, in the order of the robot, then of appearance.
        fields: Those that it has.
        is_whole: Whether it is read at once, as trajectories are.
    """

    topic: str
    name: str
    joints: tuple[str, ...]
    fields: tuple[str, ...]
    is_whole: bool
    channel: JointStateChannel

    def rows(self, rows: Sequence[JointRows]) -> list[NDArray[Any]] | None:
        """Return log times, stamps and values of messages of one layout; None without values.

        Args:
            rows: One for each of the fields.

        Returns:
            Arrays of shape (n,), (n,), and (n, k) for each of the fields; joints that the messages
            lack are NaN.
        """
        log_ns, stamp_ns = rows[0].log_ns, rows[0].stamp_ns
        at = {name: j for j, name in enumerate(self.joints)}
        matrices: list[NDArray[Any]] = []
        filled = False
        for row in rows:
            matrix = np.full((len(log_ns), len(self.joints)), np.nan)
            if row.names and row.values.shape == (len(log_ns), len(row.names)):
                matrix[:, [at[name] for name in row.names]] = row.values
                filled = True
            matrices.append(matrix)
        return [log_ns, stamp_ns, *matrices] if filled else None


class _Joints:
    """Joints on their way into the session.

    Attributes:
        taken: Topics of the recording that are written, and those of the session.
    """

    def __init__(
        self, session: Session, writer: SessionWriter, topics: JointTopics, report: ImportReport
    ) -> None:
        self._session, self._report = session, report
        self._targets: list[_Target] = []
        self.taken: set[str] = set()
        names = {
            COMMAND_TOPIC: topics.command,
            RESPONSE_TOPIC: topics.response,
            **topics.quantities,
        }
        for topic, name in names.items():
            source = joint_source(name, session.channels)
            if source is None or (target := self._target(writer, topic, name)) is None:
                continue
            self._targets.append(target)
            self.taken |= {topic, source.topic}
            if topic != name:
                report.notes.append(f"{topic} is {name} of the recording")

    def _target(self, writer: SessionWriter, topic: str, name: str) -> _Target | None:
        carried = self._session.joint_fields(name)
        every = dict.fromkeys(joint for joints in carried.values() for joint in joints)
        if len(every) > MOST_JOINTS:
            why = f"{name} has {len(every)} joints; at most {MOST_JOINTS} are imported"
            raise ImportFormatError(self._report.source, why)
        chain = self._session.robot.joint_names if self._session.robot else ()
        joints = [joint for joint in chain if joint in every]
        joints += [joint for joint in every if joint not in chain]
        allowed = UNITS if topic == RESPONSE_TOPIC else ("position",)
        if rest := [field for field in carried if field not in allowed]:
            self._report.notes.append(
                f"{name}: {' and '.join(rest)} left out, {topic} has no place"
            )
        fields = tuple(field for field in carried if field in allowed)
        if not joints or not fields:
            return None
        channel = writer.joint_state(
            topic,
            joints,
            unit=INTERFACE_UNITS.get(topic.removeprefix("/joint_"), "rad"),
            velocity="velocity" in fields,
            effort="effort" in fields,
        )
        source = joint_source(name, self._session.channels)
        kind = self._session.channels[source.topic].type_name if source else ""
        return _Target(topic, name, tuple(joints), fields, kind == TRAJECTORY, channel)

    def write(self, stop: StopRequest | None) -> Iterator[float]:
        """Write all windows; yields the share that is done."""
        first, last = self._session.start_ns, self._session.end_ns + 1
        windowed = [target for target in self._targets if not target.is_whole]
        self._write_window([target for target in self._targets if target.is_whole], None, None)
        step = max(_WINDOW_NS, (last - first) // _MOST_WINDOWS)
        spans = self._session.chunk_times_ns
        begins, ends = (np.minimum(span, LAST_NS).astype(np.int64) for span in spans)
        for start in range(first, last, step):
            if not ((begins < start + step) & (ends >= start)).any():
                continue  # a gap
            if stop is not None and stop.requested:
                self._report.complete, self._report.end_ns = False, start
                return
            self._write_window(windowed, start, start + step)
            self._session.forget()
            yield (start - first) / (last - first)

    def _write_window(
        self, targets: Sequence[_Target], start_ns: int | None, stop_ns: int | None
    ) -> None:
        fields = {target.name: target.fields for target in targets}
        messages = self._session.joint_messages(fields, start_ns, stop_ns) if targets else {}
        for target in targets:
            groups = zip(*(messages[target.name, field] for field in target.fields), strict=True)
            parts = [part for rows in groups if (part := target.rows(rows)) is not None]
            if not parts:
                continue
            log_ns, stamp_ns, *values = (
                np.concatenate(arrays) for arrays in zip(*parts, strict=True)
            )
            if (early := stamp_ns < 0).any():
                stamp_ns = np.where(early, log_ns, stamp_ns)
                text = f"{target.topic}: stamps before 1970 are replaced by log times"
                self._report.problems += [text] if text not in self._report.problems else []
            order = np.argsort(log_ns, kind="stable")
            by_field = dict(zip(target.fields, (value[order] for value in values), strict=True))
            none = [()] * len(order)
            columns = (by_field.get(field, none) for field in UNITS)
            write = target.channel.write
            for t_ns, logged, position, velocity, effort in zip(
                stamp_ns[order].tolist(), log_ns[order].tolist(), *columns, strict=True
            ):
                write(t_ns, position, velocity, effort, log_time_ns=logged)
            counts = self._report.samples
            counts[target.topic] = counts.get(target.topic, 0) + len(order)


class _Others:
    """The other topics of a recording on their way into the session."""

    def __init__(
        self,
        path: Path,
        session: Session,
        writer: SessionWriter,
        taken: set[str],
        report: ImportReport,
    ) -> None:
        self._path, self._writer, self._report = path, writer, report
        self._kept: dict[str, Mapping[str, str]] = {}
        left: list[str] = []
        for topic, channel in session.channels.items():
            if topic in taken or not channel.count:
                continue
            if channel.is_ros2 and _has_place(session, topic):
                self._kept[topic] = channel.metadata
            else:
                left.append(f"{topic} ({channel.type_name or 'no type'}, {channel.count})")
        if left:
            named = some_names(left, _MOST_NAMED)
            report.notes.append(f"topics without a place left out: {named}")

    def write(self, stop: StopRequest | None) -> Iterator[float]:
        """Write all messages; yields the share that is done."""
        if not self._kept:
            return
        with RawLog(self._path) as log:
            sends = {
                key: (channel.topic, self._writer.messages(channel.topic, kind, metadata))
                for key, channel in log.file.channels.items()
                if (metadata := self._kept.pop(channel.topic, None)) is not None
                and (kind := log.type_name(channel))
            }
            total = max(1, sum(log.file.counts.get(key, 0) for key in sends))
            for count, message in enumerate(log.messages(sends)):
                if not count % 4096:
                    yield min(1.0, count / total)
                    if stop is not None and stop.requested:
                        self._report.complete = False
                        return
                topic, send = sends[message.channel_id]
                send(message.log_time_ns, message.publish_time_ns, message.data)
                self._report.samples[topic] = self._report.samples.get(topic, 0) + 1
            self._report.problems += log.warnings


def _has_place(session: Session, topic: str) -> bool:
    """Whether the log contract has a topic's type, with the same fields."""
    try:
        return is_of_contract(session.message_type(topic))
    except DataError:  # a damaged definition
        return False
