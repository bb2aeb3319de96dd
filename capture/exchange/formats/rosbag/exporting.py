"""A session as a rosbag2 folder: ``metadata.yaml`` and one MCAP file.

Messages keep their bytes, log times, publish times and sequence numbers; metadata and attachments
of the session are in the MCAP file, so that the folder is read as the session is.

Format: https://github.com/ros2/rosbag2, ``rosbag2_storage``, metadata version 8, which ROS 2 from
Humble on reads.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from mcap.records import Channel

from ....common.errors import DataError, UsageError, some_names
from ....common.files import part_folder
from ....common.process import StopRequest
from ....log.edited_log import EditedLog, RawLog
from ....log.file.bag_metadata import METADATA, is_rosbag2
from ....log.messages.definitions import is_latched
from ...reports import ExportReport

MARKER = Path(METADATA)
"""The file by which a folder is a bag."""

_VERSION = 8
_QOS = "offered_qos_profiles"
_ENCODINGS = ("cdr", "ros2msg")
_FOREVER = {"sec": 9_223_372_036, "nsec": 854_775_807}
_LATCHED = {
    "history": 1,  # keep last
    "depth": 1,
    "reliability": 1,  # reliable
    "durability": 1,  # transient local
    "deadline": _FOREVER,
    "lifespan": _FOREVER,
    "liveliness": 1,  # automatic
    "liveliness_lease_duration": _FOREVER,
    "avoid_ros_namespace_conventions": False,
}
"""Quality of service of topics whose last message stays valid."""

_TOPIC_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def export_rosbag2(
    source: Path, output: Path, *, force: bool = False, stop: StopRequest | None = None
) -> ExportReport:
    """Write a session as a rosbag2 folder.

    Args:
        output: The folder.
        force: Replace an existing bag.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the output is a folder but no bag.
        OutputExistsError: If the output is there and ``force`` is not given.
        DataError: If the session has no messages of ROS 2.
        LogError: If the session can't be read, or the bag can't be written.
        UndulogError: If a stop was requested; nothing is left behind then.
    """
    if (output / MARKER).is_file() and not is_rosbag2(output):
        raise UsageError(f"{output}: its {MARKER} is not of rosbag2: it is not replaced")
    with part_folder(output, marker=MARKER, force=force) as part, RawLog(source) as log:
        kept = [
            _offered(log, channel)
            for channel in log.file.channels.values()
            if _is_ros(log, channel)
        ]
        _check_types(log, kept)
        file = part / f"{output.name}_0.mcap"
        with file.open("wb") as stream:
            copy = EditedLog(stream, "ros2")
            ids = {channel.id: copy.channel(log, channel) for channel in kept}
            for record in log.metadata:
                copy.note(record.name, record.metadata)
            for attachment in log.attachments:
                copy.attach(attachment, attachment.name)
            copy.write_all(
                f"export {output.name}",
                ((ids[message.channel_id], message) for message in log.messages(ids)),
                (log.start_ns, log.end_ns),
                stop or StopRequest(),
            )
            copy.finish()
        if copy.first_ns is None:
            raise DataError(f"{source}: has no messages of ROS 2 (CDR with a ros2msg schema)")
        text = _metadata(log, kept, copy, file.name)
        (part / MARKER).write_text(text, encoding="utf-8")
        messages, warnings = dict(sorted(copy.counts.items())), list(log.warnings)
        topics = {channel.topic for channel in kept}
        left_out = {channel.topic for channel in log.file.channels.values()} - topics
    if left_out:
        names = some_names(sorted(left_out), 10)
        warnings.append(f"not messages of ROS 2, left out: {names}")
    if odd := sorted(topic for topic in topics if not _TOPIC_NAME.fullmatch(topic)):
        warnings.append(
            f"ROS 2 can't publish topics of these names, use --remap or --topics of ros2 bag play: "
            f"{some_names(odd, 10)}"
        )
    what = f"{sum(messages.values())} messages of {len(messages)} topics"
    return ExportReport(what, {"messages": messages}, warnings)


def _is_ros(log: RawLog, channel: Channel) -> bool:
    schema = log.file.schemas.get(channel.schema_id)
    return schema is not None and (channel.message_encoding, schema.encoding) == _ENCODINGS


def _offered(log: RawLog, channel: Channel) -> Channel:
    """Return a channel with the quality of service of a latched topic, if it states none."""
    if channel.metadata.get(_QOS) or not is_latched(log.type_name(channel), channel):
        return channel
    return replace(channel, metadata={**channel.metadata, _QOS: "\n".join(_yaml([_LATCHED]))})


def _check_types(log: RawLog, channels: list[Channel]) -> None:
    """Check that each topic has one type, as in a bag.

    Raises:
        DataError: If one has several.
    """
    types: dict[str, str] = {}
    for channel in channels:
        first = types.setdefault(channel.topic, log.type_name(channel))
        if first != log.type_name(channel):
            raise DataError(
                f"{log.path}: {channel.topic} has messages of {first} and of "
                f"{log.type_name(channel)}, and a topic of a bag has one type"
            )


def _metadata(log: RawLog, channels: list[Channel], copy: EditedLog, file: str) -> str:
    start_ns = copy.first_ns or 0
    count = sum(copy.counts.values())
    span: dict[str, Any] = {
        "duration": {"nanoseconds": copy.last_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": count,
    }
    topics = {channel.topic: channel for channel in reversed(channels)}
    facts = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        **span,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": log.type_name(topics[topic]),
                    "serialization_format": "cdr",
                    "offered_qos_profiles": topics[topic].metadata.get(_QOS, ""),
                    "type_description_hash": "",
                },
                "message_count": copy.counts[topic],
            }
            for topic in sorted(topics)
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [{"path": file, **span}],
        "custom_data": None,
        "ros_distro": "",
    }
    return "\n".join(_yaml({"rosbag2_bagfile_information": facts})) + "\n"


def _yaml(value: Any, indent: str = "") -> Iterator[str]:
    """Yield the lines of a tree as YAML; a text is written as in JSON, which YAML reads."""
    if isinstance(value, list):
        for item in cast("list[Any]", value):
            lines = [*_yaml(item, indent + "  ")] if isinstance(item, dict) else [json.dumps(item)]
            yield from (f"{indent}- {lines[0].strip()}", *lines[1:])
        return
    for key, item in cast("dict[str, Any]", value).items():
        if item and isinstance(item, dict | list):
            yield f"{indent}{key}:"
            yield from _yaml(item, indent + "  ")
        else:
            yield f"{indent}{key}: {json.dumps(item)}"
