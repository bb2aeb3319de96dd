"""The free space of a recording's disk: the folder's, whatever becomes of its name."""

import errno
import os
import shutil
from types import SimpleNamespace

import pytest

from undulog.capture.common.errors import LogWriteError
from undulog.capture.recorder import free_space
from undulog.capture.recorder.free_space import FreeSpace


def test_the_free_space_is_what_other_users_programs_may_write(tmp_path, monkeypatch):
    free = FreeSpace(tmp_path / "run.mcap")
    assert free() == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.1)
    facts = SimpleNamespace(f_bavail=7, f_bfree=11, f_bsize=4096, f_frsize=512)
    monkeypatch.setattr(free_space.os, "fstatvfs", lambda _: facts)
    assert free() == 7 * 512
    free.close()


def test_the_free_space_of_a_folder_that_was_removed_is_still_known(tmp_path):
    folder = tmp_path / "here"
    folder.mkdir()
    free = FreeSpace(folder / "run.mcap")
    folder.rmdir()
    assert free() > 0
    free.close()


def test_what_is_no_folder_and_a_disk_that_fails_are_errors(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for folder, code in (("none", errno.ENOENT), ("file", errno.ENOTDIR)):
        path = tmp_path / folder / "run.mcap"
        with pytest.raises(LogWriteError) as caught:
            FreeSpace(path)
        assert str(caught.value) == f"{path}: its folder can't be used: {os.strerror(code)}"
    free, errors = FreeSpace(tmp_path / "run.mcap"), [OSError("x"), OSError(errno.EIO, "x")]

    def fails(_):
        raise errors.pop()

    monkeypatch.setattr(free_space.os, "fstatvfs", fails)
    for code in (errno.EIO, 0):
        with pytest.raises(LogWriteError, match=f"can't be used: {os.strerror(code)}$"):
            free()
    free.close()
