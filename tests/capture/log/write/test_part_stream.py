"""The file that is being written: its names, and what becomes of it when it is moved or deleted."""

import hashlib
import os
import random
import re
import shutil

import pytest

from undulog.capture.common.errors import LogWriteError, OutputExistsError
from undulog.capture.log.write import part_stream
from undulog.capture.log.write.part_stream import FileDeletedError, NameTakenError, PartStream

ROOM = 8 << 20  # of a rescue file, beyond what is to be written
LONG = random.Random(1).randbytes((5 << 19) + 7)  # more than is copied at once


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "above" / "here"
    made.mkdir(parents=True)
    return made


@pytest.fixture
def stream(folder):
    made = PartStream(folder / "run.mcap", 3, force=False)
    yield made
    made.close()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def put_all(stream, data):
    left = memoryview(data)
    while left:
        left = left[stream.put(left) :]


def test_what_is_written_is_queued_until_it_is_taken(stream, folder):
    assert (stream.path, stream.number, stream.rescued) == (folder / "run.mcap", 3, False)
    assert (stream.size, stream.tell(), stream.take()) == (0, 0, [])
    assert [stream.write(data) for data in (b"abc", b"", b"de")] == [3, 0, 2]
    stream.flush()
    assert (stream.size, stream.tell()) == (5, 5)
    assert stream.take() == [b"abc", b"de"]
    assert (stream.take(), stream.size) == ([], 5)
    assert names(folder) == ["run.mcap.part"]
    assert (folder / "run.mcap.part").read_bytes() == b""


def test_a_part_gets_its_name_when_it_is_whole(stream, folder):
    put_all(stream, LONG)
    stream.sync()
    put_all(stream, b"more")
    stream.sync()
    assert names(folder) == ["run.mcap.part"]
    stream.publish()
    assert names(folder) == ["run.mcap"]
    assert (folder / "run.mcap").read_bytes() == LONG + b"more"
    assert stream.close() == hashlib.sha256(LONG + b"more").hexdigest()


def test_others_may_read_a_part_as_the_umask_has_it(folder):
    former = os.umask(0o027)
    try:
        stream = PartStream(folder / "run.mcap", 1, force=False)
    finally:
        os.umask(former)
    assert stream.place.stat().st_mode & 0o777 == 0o640
    stream.discard()


@pytest.mark.parametrize("name", ["run.mcap", "run.mcap.part"])
def test_an_earlier_file_is_replaced_only_by_force(folder, name):
    earlier = folder / name
    earlier.write_bytes(b"precious")
    with pytest.raises(OutputExistsError) as caught:
        PartStream(folder / "run.mcap", 1, force=False)
    assert caught.value.path == earlier
    assert (names(folder), earlier.read_bytes()) == ([name], b"precious")
    stream = PartStream(folder / "run.mcap", 1, force=True)
    assert names(folder) == ["run.mcap.part"]
    stream.put(memoryview(b"new"))
    (folder / "run.mcap").write_bytes(b"of another program")
    stream.publish()
    stream.close()
    assert (names(folder), (folder / "run.mcap").read_bytes()) == (["run.mcap"], b"new")


def test_a_link_that_leads_nowhere_counts_as_an_earlier_file(folder):
    (folder / "run.mcap").symlink_to(folder / "nowhere")
    with pytest.raises(OutputExistsError):
        PartStream(folder / "run.mcap", 1, force=False)
    assert names(folder) == ["run.mcap"]


def test_a_folder_that_is_not_there_is_an_error(folder):
    with pytest.raises(LogWriteError, match=r"run\.mcap: can't be written: No such file"):
        PartStream(folder / "none" / "run.mcap", 1, force=False)


# -- moved -----------------------------------------------------------------------------------------


def test_a_file_that_was_moved_gets_its_name_where_it_is(stream, folder):
    assert (stream.misplaced, stream.place) == ("", folder / "run.mcap.part")
    moved = (folder / "run.mcap.part").rename(folder.parent / "elsewhere")
    assert stream.place == moved
    assert stream.misplaced == f"was moved to {moved} while it was being written"
    stream.put(memoryview(b"x"))
    stream.sync()
    stream.publish()
    assert stream.path == folder.parent / "run.mcap"
    assert (names(folder), stream.path.read_bytes()) == ([], b"x")


@pytest.mark.parametrize("step", ["sync_folder", "publish"])
@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("another", [False, True])
def test_a_folder_may_move_between_two_looks_at_it(stream, monkeypatch, step, after, another):
    folder = stream.path.parent
    moved, done = folder.parent / "moved", getattr(part_stream, step)
    seen = []
    if after:
        stream.sync()

    def at_a_bad_moment(*words, **options):
        seen.append(words[0])
        if len(seen) == 1:
            if after and step == "publish":  # when the file has its name
                done(*words, **options)
            folder.rename(moved)
            if another:
                folder.mkdir()
        done(*words, **options)

    put_all(stream, LONG)
    monkeypatch.setattr(part_stream, step, at_a_bad_moment)
    stream.sync()
    stream.publish()
    monkeypatch.undo()
    here = moved if seen else folder
    assert step == "publish" or not seen or moved in seen, "another folder was synced"
    assert names(here) == ["run.mcap"]
    assert (here / "run.mcap").read_bytes() == LONG
    assert stream.path == here / "run.mcap"


def test_a_name_that_was_taken_is_not_written_over(stream, folder):
    stream.put(memoryview(b"x"))
    (folder / "run.mcap").write_bytes(b"of another program")
    with pytest.raises(NameTakenError) as caught:
        stream.publish()
    where = folder / "run.mcap.part"
    assert str(caught.value) == (
        f"{folder / 'run.mcap'}: another program made a file of this name; "
        f"the recording is in {where}, whole: rename it"
    )
    assert (folder / "run.mcap").read_bytes() == b"of another program"
    assert where.read_bytes() == b"x"


@pytest.mark.parametrize("moved", [False, True])
def test_a_part_that_is_given_up_leaves_nothing(folder, moved):
    stream = PartStream(folder / "run.mcap", 2, force=False)
    if moved:
        stream.place.rename(folder.parent / "elsewhere")
    stream.discard()
    assert (names(folder), names(folder.parent)) == ([], ["here"])
    gone = PartStream(folder / "run.mcap", 2, force=False)
    gone.place.unlink()
    gone.discard()
    assert names(folder) == []


# -- deleted ---------------------------------------------------------------------------------------


def test_a_file_that_was_deleted_is_reported(stream, folder):
    (folder / "run.mcap.part").unlink()
    assert stream.place is None
    for step in (stream.sync, stream.publish):
        with pytest.raises(FileDeletedError) as caught:
            step()
        text = "was deleted while it was being written"
        assert str(caught.value) == f"{folder / 'run.mcap'}: {text}"
    shutil.rmtree(folder)
    text = f"its folder, {folder}, was deleted while it was being written"
    assert stream.misplaced == text
    folder.mkdir()  # another one of that name
    assert stream.misplaced == text


def rescued(stream, folder):
    """The only rescue file in a folder, which is checked to have what was written."""
    stream.rescue(0)
    assert stream.rescued
    assert stream.path.parent == folder
    assert re.fullmatch(r"run(\.rescued-[0-9a-f]{8})+\.mcap", stream.path.name)
    unfinished = stream.path.with_name(stream.path.name + ".part")
    assert unfinished.read_bytes() == LONG
    assert unfinished.stat().st_mode & 0o777 == 0o600
    put_all(stream, b"more")
    stream.sync()
    stream.publish()
    assert stream.path.read_bytes() == LONG + b"more"
    assert stream.close() == hashlib.sha256(LONG + b"more").hexdigest()
    return stream.path


@pytest.fixture
def deleted(folder):
    """A file that was deleted after something was written to it."""
    made = PartStream(folder / "run.mcap", 1, force=True)
    put_all(made, LONG)
    (folder / "run.mcap.part").unlink()
    return made


def test_a_rescue_file_lies_in_the_folder(deleted, folder):
    path = rescued(deleted, folder)
    assert names(folder) == [path.name]


def test_a_rescue_file_lies_above_a_folder_that_is_gone(deleted, folder):
    shutil.rmtree(folder)
    path = rescued(deleted, folder.parent)
    assert names(folder.parent) == [path.name]


def test_a_rescue_file_is_not_put_into_a_new_folder_of_that_name(deleted, folder):
    shutil.rmtree(folder)
    folder.mkdir()
    path = rescued(deleted, folder.parent)
    assert names(folder.parent) == sorted(["here", path.name])


def test_a_rescue_file_never_replaces_another_nor_is_it_ever_replaced(deleted, folder):
    deleted.rescue(0)
    deleted.path.write_bytes(b"of another program")
    with pytest.raises(NameTakenError):
        deleted.publish()


def test_a_rescue_file_that_was_deleted_is_rescued_again(deleted, folder):
    deleted.rescue(0)
    deleted.place.unlink()
    rescued(deleted, folder)


@pytest.mark.parametrize("missing", [0, 1])
def test_a_rescue_file_needs_room_for_what_is_to_come(deleted, folder, monkeypatch, missing):
    needed = len(LONG) + 1000 + ROOM
    asked = []

    def free_bytes(place):
        asked.append(place)
        return needed - 5 if len(asked) == 1 else needed - missing

    monkeypatch.setattr(part_stream, "free_bytes", free_bytes)
    monkeypatch.setattr("tempfile.tempdir", str(folder.parent))
    if not missing:
        deleted.rescue(1000)
        assert deleted.path.parent == asked[1] == folder.parent
        deleted.discard()
        return
    with pytest.raises(LogWriteError) as caught:
        deleted.rescue(1000)
    above = f"{folder.parent} has {needed - 1} bytes free"
    assert str(caught.value) == (
        f"{folder / 'run.mcap'}: no rescue file of {needed} bytes can be made: "
        f"{folder} has {needed - 5} bytes free; {above}; {above}"
    )
    assert not deleted.rescued
    deleted.close()


def test_a_rescue_file_that_can_not_be_filled_is_removed(deleted, folder, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(folder.parent))
    os.truncate(f"/proc/self/fd/{deleted._file}", len(LONG) - 1)
    with pytest.raises(LogWriteError) as caught:
        deleted.rescue(0)
    fault = f"{folder / 'run.mcap'} can't be read to its end"
    assert str(caught.value).endswith(
        f"can be made: {folder}: {fault}; {folder.parent}: {fault}; {folder.parent}: {fault}"
    )
    assert (names(folder), names(folder.parent)) == ([], ["here"])
    deleted.close()
