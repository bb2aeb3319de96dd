"""The disk that forgets, by which the syncs of the product are tested, forgets what it should."""

import errno

from support.forgetting_disk import Loss

START = "import ctypes, mmap, os, signal, sys"

FILES = """
os.chdir(sys.argv[1])
folder = os.open(".", os.O_RDONLY)

def written(name, data, flags=0):
    opened = os.open(name, os.O_RDWR | os.O_CREAT | flags, 0o666)
    os.write(opened, data)
    return opened

os.fsync(written("synced", b"one"))
written("unsynced", b"two")
late = written("late", b"1234")
os.fdatasync(late)
os.write(late, b"5678")
written("through", b"three", os.O_DSYNC)
os.mkdir("sub")
os.fsync(written("sub/lost", b"four"))
os.rename("old", "new")
os.unlink("removed")
os.fsync(folder)
os.fsync(written("nameless", b"five"))
os.rename("synced", "renamed")
os.unlink("kept")
again = written("again", b"six")  # may have got the inode of what was removed
os.close(again)
mapped = written("mapped", bytes(3 * mmap.PAGESIZE))
os.fsync(mapped), os.fsync(folder)
view = mmap.mmap(mapped, 0)
for page in range(3):
    view[page * mmap.PAGESIZE] = 1 + page
view.flush(mmap.PAGESIZE, mmap.PAGESIZE)
written("last", b"seven")
os.unlink("late")
os.kill(os.getpid(), signal.SIGKILL)
"""


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_what_is_left_is_what_was_synced(disk):
    for name in ("old", "removed", "kept"):
        (disk.root / name).write_text(name)
    disk.settle()
    disk.run(FILES, disk.root)
    page = bytes(4096)
    common = {
        "unsynced": b"",
        "through": b"three",
        "nameless": b"five",
        "new": b"old",
        "again": b"",
        "mapped": page + b"\2" + page[1:] + page,
    }
    everything = {"renamed": b"one", "late": b"1234"}
    zeros = {
        "unsynced": bytes(3),
        "again": bytes(3),
        "renamed": b"one",
        "sub/lost": b"four",
        "last": bytes(5),
    }
    left = disk.after(Loss.EVERYTHING)
    assert contents(left) == common | everything
    assert (left / "sub").is_dir()
    assert contents(disk.after(Loss.BYTES)) == common | zeros


UNNAMED = """
os.chdir(sys.argv[1])
opened = os.open("a", os.O_RDWR | os.O_CREAT, 0o666)
os.write(opened, b"12")
os.fsync(opened)
os.rename("b", "c")
"""


def test_a_name_is_there_once_its_folder_was_synced(disk):
    (disk.root / "b").write_text("b")
    disk.settle()
    disk.run(UNNAMED, disk.root, code=0)
    assert contents(disk.after(Loss.EVERYTHING)) == {"b": b"b"}
    assert contents(disk.after(Loss.BYTES)) == {"a": b"12", "c": b"b"}


FAULTS = """
os.chdir(sys.argv[1])
opened = os.open("a.part", os.O_RDWR | os.O_CREAT, 0o666)
other = os.open("b", os.O_RDWR | os.O_CREAT, 0o666)
os.fsync(os.open(".", os.O_RDONLY))
for _ in range(3):
    try:
        print(os.write(opened, b"123"))
        os.fsync(other)
        os.fsync(opened)
    except OSError as error:
        print(error.errno)
"""


def test_a_sync_fails_and_the_next_one_has_nothing_to_write(disk):
    _, printed = disk.run(FAULTS, disk.root, code=0, fails=2, name=".part")
    assert printed == ["3", "3", str(errno.EIO), "3"]
    assert contents(disk.after(Loss.EVERYTHING)) == {"a.part": b"123", "b": b""}


def test_writes_end_where_the_room_ends(disk):
    _, printed = disk.run(FAULTS, disk.root, code=0, room=4)
    assert printed == ["3", "1", str(errno.ENOSPC)]
    assert contents(disk.after(Loss.EVERYTHING)) == {"a.part": b"1231", "b": b""}


def test_a_process_is_killed_as_it_begins_a_sync(disk):
    disk.run(FAULTS, disk.root, ends=3, name=".part")
    assert contents(disk.after(Loss.EVERYTHING)) == {"a.part": b"123123", "b": b""}
