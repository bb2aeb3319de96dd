"""Parquet files of unknown state, read by another process first."""

import base64
import io
import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from support.paths import ROOT
from undulog.capture.common.parquet_trial import ParquetTrial

KEPT = ROOT / "tests" / "campaign" / "kept" / "dataset-level-histogram-import.json"
"""A case with a file that ends the process that reads it: an uncaught exception of pyarrow."""


def parquet_of(table, **options):
    out = io.BytesIO()
    pq.write_table(table, out, **options)
    return out.getvalue()


@pytest.fixture(scope="module")
def trial():
    return ParquetTrial()


@pytest.mark.slow
def test_a_file_that_ends_its_reader_is_a_fault_and_the_next_one_is_read(trial):
    files = json.loads(KEPT.read_text())["files"]
    (data,) = (base64.b64decode(d) for n, d in files.items() if n.endswith("file-000.parquet"))
    whole = parquet_of(pa.table({"x": [1.0]}))
    for file in (whole, data, whole, whole, data):
        assert bool(trial.fault(file)) == (file is data)


@pytest.mark.slow
def test_files_cut_empty_or_of_another_kind_have_a_reason(trial):
    whole = parquet_of(pa.table({"key": ["a"] * 1000, "x": [*range(1000)]}))
    assert trial.fault(whole) == ""
    for data in (b"", b"PAR1", whole[:-1], whole[: len(whole) // 2], b"{}"):
        assert trial.fault(data)


@pytest.mark.nightly
def test_a_value_that_expands_beyond_any_row_is_a_fault(trial):
    column = pa.array([b"\0" * (700 << 20)])
    packed = parquet_of(pa.table({"x": column}), compression="zstd", use_dictionary=False)
    assert len(packed) < 1 << 20
    assert trial.fault(packed)
