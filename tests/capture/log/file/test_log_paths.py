"""Logs in folders, with links and odd names."""

import pytest

from undulog.capture.log.file.parts import log_paths


def names(folder):
    return [path.relative_to(folder).as_posix() for path in log_paths(folder)]


@pytest.fixture
def folder(tmp_path):
    for name in ("a.mcap", "b/c.db3", "b/.hidden/d.bag", "z.bag", ".mcap", "b/e.MCAP.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    return tmp_path


def test_logs_come_before_those_of_folders(folder):
    assert names(folder) == ["a.mcap", "z.bag", "b/c.db3"]


def test_links_in_circles_end_and_count_once(folder):
    (folder / "b/up").symlink_to(folder)
    (folder / "b/self").symlink_to(folder / "b/self")
    (folder / "gone.mcap").symlink_to(folder / "none")
    for k in range(30):
        (folder / f"n{k}").mkdir()
        for link in ("left", "right"):
            (folder / f"n{k}" / link).symlink_to(folder / f"n{k + 1}")
    assert names(folder) == ["a.mcap", "z.bag", "b/c.db3"]


def test_a_write_ahead_log_stands_for_its_file(folder):
    (folder / "run.mcap.wal").mkdir()
    assert names(folder) == ["a.mcap", "run.mcap", "z.bag", "b/c.db3"]
