"""Bags of ROS: read of both versions, written as a folder of rosbag2."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..format import DirectReader, DirectWriter, Format

if TYPE_CHECKING:
    from ...import_options import ImportOptions
    from ...reports import ExportReport, ImportReport

_MCAP, _ROS1, _DATABASE = b"\x89MCAP0\r\n", b"#ROSBAG V2.0", b"SQLite format 3"


def _sniff(head: bytes, path: Path) -> float:
    """Recognise MCAP, a folder, and, as what opens them goes by the suffix, .bag and .db3 files."""
    from ....log.file.bag_metadata import is_rosbag2

    if path.is_dir():
        return float(is_rosbag2(path))
    kind = path.suffix.lower()
    magic = (kind == ".bag" and _ROS1) or (kind == ".db3" and _DATABASE) or _MCAP
    return float(head.startswith(magic))


def _read(source: Path, output: Path, options: ImportOptions) -> list[ImportReport]:
    from .importing import import_bag

    topics = {"topics": options.topics} if options.topics else {}
    robot = None if options.robot is None else str(options.robot)
    return [
        import_bag(source, output, robot=robot, force=options.force, stop=options.stop, **topics)
    ]


def _write(source: Path, output: Path, **options: Any) -> ExportReport:
    from .exporting import export_rosbag2

    return export_rosbag2(source, output, **options)


FORMAT = Format(
    "rosbag2", "bag of ROS", (".mcap", ".db3", ".bag"), _sniff,
    DirectReader(_read, "is a bag of ROS", ("--command-topic", "--response-topic")),
    DirectWriter(_write, "has all messages"),
)  # fmt: skip
