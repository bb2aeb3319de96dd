"""Files of a store: whole, or found damaged before anything else reads them."""

import os
import random
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from undulog.capture.common.errors import DamagedFileError, InputFileError
from undulog.capture.common.object_store import ObjectStore, checksum_in

TABLE = pa.table({"key": ["a", "b"], "x": [0.5, 1.5]})


@pytest.fixture
def store(tmp_path):
    (tmp_path / "rows").mkdir()
    return ObjectStore(str(tmp_path))


def test_every_changed_byte_of_a_file_with_a_checksum_is_found(store, tmp_path):
    name = store.write_table("rows/1", TABLE)
    assert store.read_table(name).equals(TABLE)
    whole = (tmp_path / name).read_bytes()
    for at in range(len(whole)):
        changed = bytearray(whole)
        changed[at] ^= 1 << random.Random(at).randrange(8)
        (tmp_path / name).write_bytes(changed)
        for read in (store.read, store.read_table, store.check_parquet):
            with pytest.raises(DamagedFileError, match="checksum"):
                read(name)
    (tmp_path / name).write_bytes(whole)
    store.check_parquet(name)


@pytest.mark.parametrize("cut", [0, 1, 100, -1])
def test_a_file_that_is_cut_is_found(store, tmp_path, cut):
    name = store.write_table("rows/1", TABLE)
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:cut])
    for read in (store.read, store.read_table, store.check_parquet):
        with pytest.raises(DamagedFileError, match=name):
            read(name)


def test_a_folder_in_the_place_of_a_file_is_found(store, tmp_path):
    name = store.write_table("rows/1", TABLE)
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    assert store.files("rows") == []
    (tmp_path / "rows" / "2.parquet").symlink_to("nowhere")
    (tmp_path / "rows" / "3.parquet").symlink_to("3.parquet")
    others = ["rows/2.parquet", "rows/3.parquet"]
    assert store.not_files("rows", ".parquet") == [name, *others]
    for other in others:
        assert not (tmp_path / store.set_aside(other, "damaged")).exists()
    with pytest.raises(DamagedFileError, match="folder"):
        store.read(name)
    goal = store.set_aside(name, "damaged")
    assert (tmp_path / goal).is_dir()
    assert goal.startswith("damaged/")
    assert goal.endswith(".damaged")


def test_a_file_that_is_removed_during_the_listing_is_not_taken_for_something_else(
    store, tmp_path, monkeypatch
):
    name, scandir = store.write_table("rows/1", TABLE), os.scandir

    def listed(folder):
        entries = [*scandir(folder)]
        (tmp_path / name).unlink()
        return entries

    monkeypatch.setattr(os, "scandir", listed)
    assert store.not_files("rows", ".parquet") == []


@pytest.mark.slow
def test_a_file_without_a_checksum_is_read_and_found_damaged_where_it_can_t_be(store, tmp_path):
    path = tmp_path / "rows" / "1790000000000000000-0123abcd.parquet"
    name = f"rows/{path.name}"
    pq.write_table(TABLE, path)
    assert checksum_in(name) is None
    assert store.read_table(name, ("key",)).column_names == ["key"]
    path.write_bytes(path.read_bytes()[:-20])
    for again in (store, ObjectStore(store.where)):  # changed since, or damaged before
        with pytest.raises(DamagedFileError):
            again.read_table(name)
        with pytest.raises(DamagedFileError):
            again.check_parquet(name)


def test_a_file_is_set_aside_once_under_a_name_that_nothing_has(store, tmp_path):
    names = []
    for _ in range(2):
        name = store.write_checked("rows/1", ".json", b"{}")
        names.append(store.set_aside(name, "damaged"))
    assert store.set_aside(name, "damaged") == ""  # another process did it before
    assert sorted(f"damaged/{path.name}" for path in (tmp_path / "damaged").iterdir()) == sorted(
        names
    )


@contextmanager
def as_nobody():
    """Run a block as a user without rights, in a folder of that user's, and yield it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if os.getuid() == 0:
            os.chown(folder, 65534, 65534)
            os.seteuid(65534)
        try:
            yield folder
        finally:
            if os.getuid() == 0:
                os.seteuid(0)


def test_a_file_without_permission_is_not_damaged_but_named_with_the_cure():
    with as_nobody() as folder:
        store = ObjectStore(str(folder))
        (folder / "rows").mkdir()
        name = store.write_table("rows/1", TABLE)
        (folder / name).chmod(0)
        for read in (store.read, store.read_table, store.check_parquet):
            with pytest.raises(InputFileError, match="Permission denied; make it readable") as why:
                read(name)
            assert not isinstance(why.value, DamagedFileError)
