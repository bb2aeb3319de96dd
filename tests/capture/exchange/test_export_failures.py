"""Exports that are stopped, or fail on the way, leave nothing behind and keep what was there."""

import signal

import numpy as np
import pytest

from support.imported import FRAME_SUFFIXES, TABLE_SUFFIXES, export_file, export_wide
from support.written_frames import every_kind
from support.written_topics import EPOCH_NS, write_topics
from undulog.capture.common.errors import LogWriteError, UndulogError, UsageError
from undulog.capture.common.process import StopRequest
from undulog.capture.exchange import frame_export, long_table, wide_table
from undulog.capture.exchange.formats import tum
from undulog.capture.exchange.formats.lerobot import exporting as lerobot
from undulog.capture.exchange.formats.rosbag import exporting as rosbag
from undulog.capture.exchange.formats.tum import export_tum

EXPORTS = {
    "wide.csv": (export_wide, wide_table, "_cells"),
    "wide.parquet": (export_wide, wide_table, "_cells"),
    "dataset": (lambda path, *a, **o: lerobot.export_lerobot([path], *a, fps=30, **o), lerobot,
                "aggregate_stats"),
    "bag": (rosbag.export_rosbag2, rosbag, "_metadata"),
    "x.tum": (export_tum, tum, "_lines"),
    **{f"x{suffix}": (export_file, frame_export.LossTally, "add") for suffix in FRAME_SUFFIXES},
    **{f"x{suffix}": (export_file, long_table, "_sorted_blocks") for suffix in TABLE_SUFFIXES},
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
