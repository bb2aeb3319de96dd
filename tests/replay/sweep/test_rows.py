"""The store of a sweep's rows, read by pandas, and after an end at any moment."""

import json
import random

import pandas as pd
import pyarrow.parquet as pq
import pytest

from support.sweep_plans import comparable
from undulog.capture.common.errors import DamagedFileError, InputFileError, UsageError
from undulog.replay.sweep.rows import GATHER, RowStore


def row(k, **columns):
    return {"key": f"{k:032x}", "seed": k, "session": "", "status": "done", "error": "", **columns}


@pytest.fixture
def store(tmp_path):
    store = RowStore(str(tmp_path / "rows"))
    with store.writing():
        yield store


def parquet(store):
    return pd.read_parquet(f"{store.where}/rows").sort_values("key", ignore_index=True)


def test_rows_are_whole_in_parquet_and_before(store):
    rows = [row(k, gain=[1.0, None], joint=["a", "b"], x=k / 3) for k in range(GATHER + 3)]
    for record in rows:
        store.add(record)
    assert comparable(store.rows()) == comparable(rows)
    store.gather()
    assert comparable(RowStore(store.where).rows()) == comparable(rows)
    frame = parquet(store)
    assert frame.seed.to_list() == list(range(GATHER + 3))
    assert frame.x.to_list() == [k / 3 for k in range(GATHER + 3)]


def test_columns_of_failed_rows_and_of_other_types_fit_together(store):
    store.add(row(1, status="failed", error="why"))
    store.add(row(2, gain=[1.0], **{"servo.x": 1, "robot": "a", "mixed": 1.5, "flag": True}))
    store.add(row(3, gain=[None], **{"servo.x": 2.5, "robot": "b", "mixed": "text"}))
    store.gather()
    store.add(row(4, gain=[], **{"servo.x": 3}))
    store.gather()
    frame = parquet(store)
    assert frame["servo.x"].to_list()[1:] == [1.0, 2.5, 3.0]
    assert frame.mixed.to_list()[1:3] == ["1.5", "text"]
    assert frame.error.to_list() == ["why", "", "", ""]


def test_rows_that_were_gathered_but_not_removed_are_there_once(store, tmp_path):
    rows = [row(k) for k in range(5)]
    for record in rows:
        store.add(record)
    pending = {path: path.read_bytes() for path in (tmp_path / "rows" / "pending").iterdir()}
    store.gather()
    for path, data in pending.items():  # as if killed between the two
        path.write_bytes(data)
    again = RowStore(store.where)
    assert len(list(again.rows())) == 5
    again.add(row(9))
    again.gather()
    assert parquet(again).key.is_unique
    assert len(parquet(again)) == 6


def test_dropped_rows_are_gone_and_the_others_stay(store):
    for k in range(GATHER + 10):
        store.add(row(k))
    store.drop([row(0)["key"], row(GATHER + 5)["key"], "none"])
    assert parquet(store).seed.to_list() == [k for k in range(GATHER + 10) if k not in (0, 261)]
    assert store.facts().keys() == set(parquet(store).key)


def test_only_one_sweep_writes_into_a_folder(store):
    with pytest.raises(UsageError, match="another sweep"), RowStore(store.where).writing():
        pass


def test_wrong_addresses_are_named(tmp_path):
    with pytest.raises(InputFileError, match="nowhere"):
        RowStore("nowhere://x/y")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputFileError, match="file"), RowStore(f"{tmp_path}/file").writing():
        pass


def test_what_the_rows_share_is_stored_beside_them(store, tmp_path):
    store.settle("abc", {"scenario": "text"})
    stored = (tmp_path / "rows" / "settings" / "abc.json").read_text()
    assert json.loads(stored) == {"scenario": "text"}


# -- damage --------------------------------------------------------------------------------


def flipped(data, rng):
    changed = bytearray(data)
    for _ in range(rng.choice([1, 40])):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return changed


def emptied(_data, _rng):
    return b""


def cut(data, rng):
    return data[: rng.randrange(len(data))]


@pytest.mark.parametrize("damage", [flipped, cut, emptied])
@pytest.mark.parametrize("seed", range(5))
def test_damaged_files_are_set_aside_and_the_other_rows_stay(store, tmp_path, damage, seed):
    rng, folder = random.Random(seed), tmp_path / "rows"
    for k in range(9):
        store.add(row(k, gain=[k / 3]))
        if k in (2, 5):
            store.gather()
    hit = [rng.choice(sorted((folder / name).iterdir())) for name in ("rows", "pending")]
    lost = {json.loads(hit[1].read_bytes())["key"], *pq.read_table(hit[0])["key"].to_pylist()}
    for path in hit:
        path.write_bytes(damage(path.read_bytes(), rng))
    damaged_bytes = {path.read_bytes() for path in hit}
    again = RowStore(store.where)
    with pytest.raises(DamagedFileError, match="makes their runs again"):
        list(again.rows())
    assert again.facts().keys() == {row(k)["key"] for k in range(9)} - lost
    assert len(again.set_damaged_aside()) == 2
    assert {path.read_bytes() for path in (folder / "damaged").iterdir()} == damaged_bytes
    for k in range(9):
        if row(k)["key"] in lost:
            again.add(row(k, gain=[k / 3]))
    again.gather()
    assert comparable(again.rows()) == comparable(row(k, gain=[k / 3]) for k in range(9))
    assert again.facts()
    assert again.damaged == {}


def test_folders_and_files_of_others_in_the_place_of_rows_are_set_aside(store, tmp_path):
    folder = tmp_path / "rows"
    store.add(row(0))
    (folder / "pending" / f"{1:032x}.json").mkdir()
    (folder / "rows" / "1.parquet").mkdir()
    pd.DataFrame({"key": [1], "x": [2.0]}).to_parquet(folder / "rows" / "2.parquet")
    (folder / "pending" / f"{3:032x}.json").write_text(json.dumps(row(4)))
    (folder / "pending" / f"{5:032x}.json").write_text("[" * 100_000)
    assert store.facts().keys() == {row(0)["key"]}
    texts = "\n".join(store.set_damaged_aside())
    for why in ("1.parquet: is no file", "no texts", f"not hold the row {3:032x}", "is no JSON"):
        assert why in texts
    assert len(list((folder / "damaged").iterdir())) == 5
    store.gather()
    assert len(parquet(store)) == 1


@pytest.mark.slow
def test_files_of_earlier_versions_are_read(store, tmp_path):
    folder = tmp_path / "rows"
    pd.DataFrame([row(k) for k in range(3)]).to_parquet(folder / "rows" / "17-0123abcd.parquet")
    (folder / "pending" / f"{3:032x}.json").write_text(json.dumps(row(3)))
    assert store.facts().keys() == {row(k)["key"] for k in range(4)}
    assert store.damaged == {}
    store.gather()
    assert list((folder / "pending").iterdir()) == []
    assert len(parquet(store)) == 4


def test_rows_that_a_kill_left_in_two_files_are_in_one_afterwards(store, tmp_path):
    for k in range(4):
        store.add(row(k))
    store.gather()
    (path,) = (tmp_path / "rows" / "rows").iterdir()
    before = path.read_bytes()
    store.drop([row(0)["key"]])
    path.write_bytes(before)  # as if killed before it was removed
    again = RowStore(store.where)
    assert len(again.facts()) == 4
    again.drop([])
    assert parquet(again).key.is_unique
    assert again.facts().keys() == {row(k)["key"] for k in range(4)}
