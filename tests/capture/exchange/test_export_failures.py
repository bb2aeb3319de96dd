"""Exports that are stopped, or fail on the way, leave nothing behind and keep what was there."""

import signal

import pytest

from support.written_sessions import write_session
from undulog.capture.common.errors import LogWriteError, UndulogError, UsageError
from undulog.capture.common.process import StopRequest
from undulog.capture.exchange import lerobot_export, rosbag2_export, tum, wide_table
from undulog.capture.exchange.lerobot_export import export_lerobot
from undulog.capture.exchange.rosbag2_export import export_rosbag2
from undulog.capture.exchange.tum import export_tum
from undulog.capture.exchange.wide_table import export_wide

EXPORTS = {
    "x.csv": (export_wide, wide_table, "_seconds"),
    "x.parquet": (export_wide, wide_table, "_seconds"),
    "dataset": (lambda path, *a, **o: export_lerobot([path], *a, fps=30, **o), lerobot_export,
                "aggregate_stats"),
    "bag": (export_rosbag2, rosbag2_export, "_metadata"),
    "x.tum": (export_tum, tum, "_lines"),
}  # fmt: skip


@pytest.mark.parametrize("name", EXPORTS)
def test_what_fails_leaves_nothing_behind(name, tmp_path, monkeypatch):
    export, owner, step = EXPORTS[name]
    write_session(tmp_path / "run.mcap")
    output = tmp_path / name
    stop = StopRequest()
    stop.signal = signal.SIGTERM
    with pytest.raises(UndulogError, match="stopped"):
        export(tmp_path / "run.mcap", output, stop=stop)

    def fail(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(owner, step, fail)
        with pytest.raises(LogWriteError, match="No space left on device"):
            export(tmp_path / "run.mcap", output)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    export(tmp_path / "run.mcap", output)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(UsageError, match="exists already"):
        export(tmp_path / "run.mcap", output)
    with monkeypatch.context() as patch:
        patch.setattr(owner, step, fail)
        with pytest.raises(LogWriteError):
            export(tmp_path / "run.mcap", output, force=True)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
