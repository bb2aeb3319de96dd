"""Exports that are stopped, or fail on the way, leave nothing behind and keep what was there."""

import signal

import numpy as np
import pytest

from support.written_frames import every_kind
from support.written_topics import EPOCH_NS, write_topics
from undulog.capture.common.errors import LogWriteError, UndulogError, UsageError
from undulog.capture.common.process import StopRequest
from undulog.capture.exchange import export, lerobot_export, rosbag2_export, tum, wide_table
from undulog.capture.exchange.export import TABLE_FORMATS, export_columns, export_log
from undulog.capture.exchange.frame_formats import FRAME_FORMATS
from undulog.capture.exchange.lerobot_export import export_lerobot
from undulog.capture.exchange.rosbag2_export import export_rosbag2
from undulog.capture.exchange.tum import export_tum
from undulog.capture.exchange.wide_table import export_wide

EXPORTS = {
    "wide.csv": (export_wide, wide_table, "_seconds"),
    "wide.parquet": (export_wide, wide_table, "_seconds"),
    "dataset": (lambda path, *a, **o: export_lerobot([path], *a, fps=30, **o), lerobot_export,
                "aggregate_stats"),
    "bag": (export_rosbag2, rosbag2_export, "_metadata"),
    "x.tum": (export_tum, tum, "_lines"),
    **{f"x{suffix}": (export_log, export.LossTally, "add") for suffix in FRAME_FORMATS},
    **{f"x{suffix}": (export_columns, export, "_sorted_blocks") for suffix in TABLE_FORMATS},
}  # fmt: skip


@pytest.mark.parametrize("name", EXPORTS)
def test_what_fails_leaves_nothing_behind(name, tmp_path, monkeypatch):
    exporter, owner, step = EXPORTS[name]
    source, output = tmp_path / "run.mcap", tmp_path / name
    angles = np.sin(np.arange(60.0)).reshape(30, 2)
    topics = {f"/joint_{kind}": (("a", "b"), "rad", angles) for kind in ("commands", "states")}
    t_ns = EPOCH_NS + np.arange(30) * 10_000_000

    def begin(writer):
        writer.frames("/can/can0").write(EPOCH_NS, every_kind())

    write_topics(source, t_ns, topics, head=np.zeros((30, 3)), begin=begin)
    stop = StopRequest()
    stop.signal = signal.SIGTERM

    def failing(*_):
        raise OSError(28, "No space left on device")

    def fails(**options):
        with pytest.raises(UndulogError, match="stopped"):
            exporter(source, output, stop=stop, **options)
        with monkeypatch.context() as patch:
            patch.setattr(owner, step, failing)
            with pytest.raises(LogWriteError, match="No space left on device"):
                exporter(source, output, **options)

    fails()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    exporter(source, output)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(UsageError, match="exists already"):
        exporter(source, output)
    fails(force=True)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
