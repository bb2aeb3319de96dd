"""The store of a sweep's rows, read by pandas, and after an end at any moment."""

import json

import pandas as pd
import pytest

from support.sweep_plans import comparable
from undulog.capture.common.errors import InputFileError, UsageError
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
    for one in rows:
        store.add(one)
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
    for one in rows:
        store.add(one)
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


def test_damaged_rows_and_wrong_addresses_are_named(store, tmp_path):
    (tmp_path / "rows" / "rows" / "1.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputFileError, match=r"1\.parquet"):
        store.facts()
    with pytest.raises(InputFileError, match="nowhere"):
        RowStore("nowhere://x/y")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputFileError, match="file"), RowStore(f"{tmp_path}/file").writing():
        pass


def test_what_the_rows_share_is_stored_beside_them(store, tmp_path):
    store.settle("abc", {"scenario": "text"})
    stored = (tmp_path / "rows" / "settings" / "abc.json").read_text()
    assert json.loads(stored) == {"scenario": "text"}
