"""Facts of a recording of ROS, without reading its messages: of the kinds that are no plain MCAP.

A rosbag2 folder states them in its metadata.yaml, a .bag of ROS 1 at its end; of a .db3 file the
topics and the index of times are read.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ...common.errors import MissingExtraError, NotALogError, UndulogError
from ..file.bag_metadata import Stated, read_stated
from ..file.bag_parts import Allowance, read_database_facts
from ..file.content import content_id_of
from .facts import LogFacts


def read_bag_facts(path: Path) -> LogFacts:
    """Read the facts of a rosbag2 folder, a .db3 file or a .bag file.

    Raises:
        NotALogError: If it is damaged.
        OSError: If it can't be read.
        MissingExtraError: If ``rosbags`` or the YAML parser is not installed and needed.
    """
    try:
        if path.is_dir():
            stated = read_stated(path)
        else:
            stated = _of_ros1(path) if path.suffix == ".bag" else read_database_facts(path)
    except ImportError as error:
        raise MissingExtraError("reading a recording of ROS", "bags", "rosbags") from error
    facts = LogFacts(
        messages=stated.messages,
        topics=tuple(sorted({*stated.topics})),
        content=content_id_of(stated.files),
    )
    if not stated.messages or stated.start_ns is None or stated.duration_ns is None:
        return facts
    end_ns = stated.start_ns + stated.duration_ns
    return replace(facts, start_ns=stated.start_ns, end_ns=end_ns)


def _of_ros1(path: Path) -> Stated:
    from ..file.bag_ros1 import SummaryReader

    try:
        with SummaryReader(path, Allowance(path, 0)) as bag:
            topics = tuple(connection.topic for connection in bag.connections)
            count = sum(sum(chunk.connection_counts.values()) for chunk in bag.chunk_infos)
            start, stop = bag.start_time, bag.end_time
    except (MemoryError, OSError, UndulogError):
        raise
    except Exception as error:  # rosbags lets errors of struct and dictionaries through
        why = " ".join(str(error).split()) or type(error).__name__
        fix = "run 'rosbag reindex' or 'rosbag fix'"
        raise NotALogError(path, f"can't be read as a bag of ROS 1: {why}; {fix}") from error
    return Stated([path], "", start, stop - 1 - start, count, topics)
