"""Names of part files: whose they are, where an open file is now, and which names are tried."""

import ctypes
import errno
import fcntl
import os
import re
import tempfile
from pathlib import Path

import pytest

from undulog.capture.common import part_files
from undulog.capture.common.part_files import (
    NEW_FILE,
    claimed_part,
    finished_path,
    is_recorders,
    present_path,
    publish,
    publish_durably,
    recording_left,
    remove_opened,
    rescue_folders,
    stored_path,
    sync_folder,
    unfinished_path,
)


@pytest.fixture
def opened(tmp_path):
    """An open file and its path."""
    path = tmp_path / "a"
    number = os.open(path, os.O_RDWR | os.O_CREAT)
    yield number, path
    os.close(number)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_an_output_and_its_part_file_have_names_that_tell_them(tmp_path):
    output = tmp_path / "run.mcap"
    assert unfinished_path(output) == tmp_path / "run.mcap.part"
    assert finished_path(tmp_path / "run.mcap.part") == output
    assert finished_path(output) == output
    assert stored_path(output) == output
    unfinished_path(output).mkdir()
    assert stored_path(output) == output


@pytest.mark.parametrize(
    ("name", "is_one"),
    [
        ("run_0002.mcap.part", True),
        ("run_12345.MCAP.part", True),
        ("run_mark0001.mcap.part", True),
        ("a\nb.rescued-0123abcd.mcap.part", True),
        ("run_002.mcap.part", False),
        ("run_0002.mcap", False),
        ("run_0002.json.part", False),
        ("run.rescued-0123abc.mcap.part", False),
        ("_0002.mcap.part", False),
        ("run.mcap.part", False),
    ],
)
def test_the_part_file_of_a_recorder_is_known_by_its_number(tmp_path, name, is_one):
    assert is_recorders(tmp_path / name) is is_one


def test_what_a_recording_left_is_its_part_file_or_its_log(tmp_path):
    output, part = tmp_path / "run.mcap", tmp_path / "run.mcap.part"
    assert recording_left(output) is None
    part.touch()
    assert recording_left(output) is None
    part.unlink()
    log = tmp_path / "run.mcap.wal"
    log.mkdir()
    assert recording_left(output) == log
    part.touch()
    assert recording_left(output) == part
    assert recording_left(tmp_path / "run_0002.mcap") is None


def test_an_open_file_is_found_where_it_was_moved(opened, tmp_path):
    number, path = opened
    assert present_path(number, path) == path
    assert present_path(number, tmp_path / "never") == path
    moved = path.rename(tmp_path / "moved")
    assert present_path(number, path) == moved
    path.write_text("another")
    assert present_path(number, path) == moved
    moved.unlink()
    assert present_path(number, path) is None


def test_only_the_open_file_is_removed(opened, tmp_path):
    number, path = opened
    moved = path.rename(tmp_path / "moved")
    path.write_text("another")
    remove_opened(number, path)
    assert not moved.exists()
    remove_opened(number, path)
    assert path.read_text() == "another"


def test_a_rescue_file_goes_to_the_nearest_folder_above_or_among_temporary_files(tmp_path):
    temporary = Path(tempfile.gettempdir())
    assert list(rescue_folders(tmp_path / "a" / "b" / "c")) == [tmp_path, temporary]
    (tmp_path / "a").mkdir()
    assert list(rescue_folders(tmp_path / "a" / "b" / "c")) == [tmp_path / "a", temporary]
    (tmp_path / "a" / "b").touch()
    assert list(rescue_folders(tmp_path / "a" / "b" / "c")) == [tmp_path / "a", temporary]


def test_without_temporary_files_only_the_folders_above_are_left(tmp_path, monkeypatch):
    def fails():
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "gettempdir", fails)
    assert list(rescue_folders(tmp_path / "a")) == [tmp_path]


def descriptors():
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - of this process


def test_syncing_and_publishing_leave_no_file_open(tmp_path):
    part, output = tmp_path / "a.part", tmp_path / "a"
    before = descriptors()
    sync_folder(tmp_path)
    for replace in (False, True):
        part.write_text(f"{replace}")
        publish_durably(part, output, replace=replace)
        assert (names(tmp_path), output.read_text()) == (["a"], f"{replace}")
    part.write_text("new")
    with pytest.raises(FileExistsError):
        publish_durably(part, output, replace=False)
    with pytest.raises(NotADirectoryError):
        sync_folder(part)
    link = tmp_path / "link"
    link.symlink_to(part)
    with pytest.raises(OSError, match="symbolic links"):
        publish_durably(link, output, replace=True)
    assert output.read_text() == "True"
    assert descriptors() <= before


def test_names_of_the_working_folder_are_given_as_absolute_ones_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    part, output = Path("a.part"), Path("a")
    for replace in (False, True):
        part.write_text(f"{replace}")
        publish(part, output, replace=replace)
        assert (names(tmp_path), output.read_text()) == (["a"], f"{replace}")
    part.write_text("new")
    with pytest.raises(FileExistsError) as caught:
        publish(part, output, replace=False)
    assert (caught.value.filename, caught.value.filename2) == ("a.part", "a")
    assert names(tmp_path) == ["a", "a.part"]


# -- without renameat2 -----------------------------------------------------------------------------


class Library:
    """A C library whose ``renameat2`` fails with a code; without a code it has none."""

    def __init__(self, code):
        self.code = code
        if code is not None:
            self.renameat2 = self._fail

    def _fail(self, *_):
        ctypes.set_errno(self.code)
        return -1


@pytest.mark.parametrize("code", [None, errno.EINVAL, errno.ENOSYS, errno.ENOTSUP])
def test_a_file_system_without_exclusive_renaming_still_replaces_nothing(
    tmp_path, monkeypatch, code
):
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Library(code))
    part, output = tmp_path / "a.part", tmp_path / "a"
    part.write_text("new")
    output.symlink_to(tmp_path / "nowhere")
    with pytest.raises(FileExistsError) as caught:
        publish(part, output, replace=False)
    assert (caught.value.errno, caught.value.filename) == (errno.EEXIST, str(output))
    output.unlink()
    publish(part, output, replace=False)
    assert (names(tmp_path), output.read_text()) == (["a"], "new")


@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS])
def test_a_name_that_can_not_be_given_is_an_error_with_both(tmp_path, monkeypatch, code):
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Library(code))
    part, output = tmp_path / "a.part", tmp_path / "a"
    part.write_text("new")
    with pytest.raises(OSError, match=os.strerror(code)) as caught:
        publish(part, output, replace=False)
    assert (caught.value.errno, caught.value.filename, caught.value.filename2) == (
        code, str(part), str(output),
    )  # fmt: skip
    assert names(tmp_path) == ["a.part"]


# -- which names are tried -------------------------------------------------------------------------


def test_flags_of_a_new_file_refuse_what_is_there_and_links(tmp_path):
    path = tmp_path / "a"
    number = os.open(path, os.O_WRONLY | NEW_FILE, 0o600)
    assert fcntl.fcntl(number, fcntl.F_GETFD) & fcntl.FD_CLOEXEC
    os.close(number)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for taken in (path, tmp_path / "link"):
        with pytest.raises(FileExistsError):
            os.open(taken, os.O_WRONLY | NEW_FILE, 0o600)


def test_a_name_that_is_taken_is_followed_by_a_random_one(tmp_path):
    before = descriptors()
    unfinished_path(tmp_path / "a").mkdir()
    with claimed_part(tmp_path / "a") as part:
        assert re.fullmatch(r"a\.[0-9a-f]{8}\.part", part.name)
        with claimed_part(tmp_path / "a") as other:
            assert other != part
    with claimed_part(tmp_path / "b") as part:
        assert part == tmp_path / "b.part"
        assert part.stat().st_mode & 0o777 == 0o666 & ~umask()
    assert descriptors() <= before


def umask():
    present = os.umask(0)
    os.umask(present)
    return present


def test_eight_names_are_tried(tmp_path, monkeypatch):
    """All that are random are taken by another program."""
    monkeypatch.setattr(os, "urandom", bytes)
    for name in ("a.part", "a.00000000.part"):
        (tmp_path / name).mkdir()
    tried, real = [], os.open

    def noted(path, *rest):
        tried.append(Path(path).name)
        return real(path, *rest)

    monkeypatch.setattr(os, "open", noted)
    with pytest.raises(FileExistsError, match=r"a\.00000000\.part"), claimed_part(tmp_path / "a"):
        pass
    monkeypatch.undo()
    created = [name for k, name in enumerate(tried) if name != tried[k - 1] or "0000" in name]
    assert created.count("a.00000000.part") == 7
    assert created.count("a.part") >= 1
    assert names(tmp_path) == ["a.00000000.part", "a.part"]


def test_a_new_file_that_another_process_took_for_an_abandoned_one_is_left_to_it(
    tmp_path, monkeypatch
):
    """It holds the lock before this process has it; or it has removed the file already."""
    real, turns = fcntl.flock, iter(["locked", "removed"])
    holders = []

    def disturbed(number, operation):
        turn = next(turns, "")
        if turn == "locked":
            holders.append(os.open(tmp_path / "a.part", os.O_RDONLY))
            real(holders[0], fcntl.LOCK_EX)
        elif turn == "removed":
            next(tmp_path.glob("a.????????.part")).unlink()
        real(number, operation)

    monkeypatch.setattr(part_files.fcntl, "flock", disturbed)
    before = descriptors()
    with claimed_part(tmp_path / "a") as part:
        assert names(tmp_path) == sorted(["a.part", part.name])
        assert re.fullmatch(r"a\.[0-9a-f]{8}\.part", part.name)
    assert descriptors() <= before + 1
    os.close(holders[0])


def test_without_locks_the_exclusive_creation_has_to_do(tmp_path, monkeypatch):
    def fails(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(part_files.fcntl, "flock", fails)
    with claimed_part(tmp_path / "a") as part:
        assert part == tmp_path / "a.part"
    with claimed_part(tmp_path / "a") as other:  # whether it is abandoned can't be known
        assert other != part


def test_the_abandoned_part_file_of_another_user_is_left(tmp_path, monkeypatch):
    (tmp_path / "a.part").write_text("another's")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with claimed_part(tmp_path / "a") as part:
        assert part.name != "a.part"
    assert (tmp_path / "a.part").read_text() == "another's"


def test_a_living_part_file_that_replaces_an_abandoned_one_is_left(tmp_path, monkeypatch):
    path, real, holders = tmp_path / "a.part", fcntl.flock, []
    path.write_text("abandoned")

    def disturbed(number, operation):
        if not holders:
            path.rename(tmp_path / "moved")
            path.write_text("new")
            holders.append(os.open(path, os.O_RDONLY))
            real(holders[0], fcntl.LOCK_EX)
        real(number, operation)

    monkeypatch.setattr(part_files.fcntl, "flock", disturbed)
    with claimed_part(tmp_path / "a") as part:
        assert part.name != "a.part"
    assert path.read_text() == "new"
    assert (tmp_path / "moved").read_text() == "abandoned"
    os.close(holders[0])
