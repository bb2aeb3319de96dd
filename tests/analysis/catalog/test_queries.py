"""Queries of any origin: they read the catalogue alone, and end within memory and time."""

import os
import re
import signal
from pathlib import Path

import pytest

from support.processes import once, processor_ticks
from support.written_sessions import write_session
from undulog.analysis.catalog.catalog import Catalog
from undulog.analysis.catalog.queries import query_process
from undulog.capture.common.errors import DamagedFileError, UsageError

pytestmark = pytest.mark.slow


@pytest.fixture
def lab(tmp_path, monkeypatch):
    folder = tmp_path / "lab"
    folder.mkdir()
    write_session(folder / "a.mcap", count=20)
    (tmp_path / "secret.csv").write_text("a\nsecret\n")
    monkeypatch.chdir(tmp_path)
    catalog = Catalog(str(folder))
    catalog.scan()
    return catalog


def files_below(folder):
    return sorted(str(path) for path in folder.rglob("*") if path.is_file())


CONDITIONS = [
    "1=1; copy (select 1) to 'out.csv'",
    "1=1; attach 'out.db'; --",
    "path in (select a from read_csv('secret.csv'))",
    "not " * 20_000,
    "path in (select content from read_text('secret.csv'))",
    "path in (select file from glob('/*'))",
    "1=1 union select * from read_parquet('lab/.undulog-catalog/sources/*.parquet') --",
    "path in (select a from 'secret.csv')",
    "1=1; set memory_limit = '64GB'",
    "1=1; install httpfs",
    "path in (select a from 'https://127.0.0.1:1/a.csv')",
    "1=1; drop view catalog",
    "path = 'a' or",
    "\0",
    "(" * 40_000,
    "path = '" + "x" * 200_000 + "'",
]


@pytest.mark.parametrize("condition", CONDITIONS)
def test_a_condition_reads_and_writes_nothing_else(lab, tmp_path, condition):
    before = files_below(tmp_path)
    with pytest.raises(UsageError, match="DuckDB") as refused:
        lab.find(condition)
    assert "secret\n" not in str(refused.value)
    assert len(str(refused.value)) < 2000
    assert files_below(tmp_path) == before
    assert len(lab.find("messages >= 0")) == 1


@pytest.mark.parametrize(
    "query",
    [
        "copy (select 1) to 'lab/out.csv'",
        "copy (select 1) to 'lab/.undulog-catalog/out.parquet' (format parquet)",
        "export database 'out'",
        "create table t as select 1",
        "select 1; select 2",
        "pragma database_list",
        "",
        "-- nothing",
    ],
)
def test_a_query_is_one_that_reads(lab, tmp_path, query):
    before = files_below(tmp_path)
    with pytest.raises(UsageError, match="give one query or condition that only reads"):
        lab.sql(query)
    assert files_below(tmp_path) == before


def test_queries_that_read_are_run(lab):
    assert lab.sql("with a as (select 1 as x) select x from a").x.to_list() == [1]
    assert len(lab.sql("pivot catalog on robot using count(*) group by path")) == 1
    assert len(lab.sql("explain select 1")) >= 1


LONG_OR_SIMILAR = (
    ("select * from range(1000000000)", "memory"),
    ("select repeat('x', 2000000000)", "memory"),
    ("select range(1000000000)", "memory"),
    ("select format('{:>2000000000}', 'x')", "memory"),
    ("select count(*) from range(10000000) a, range(10000000) b", "processor time"),
    ("with recursive t as (select 1 n union all select n + 1 from t) from t", "processor time"),
)


@pytest.mark.parametrize(
    ("query", "why"),
    [
        ("select list(x) from range(1000000000) t(x)", "memory"),
        ("with recursive t as (select 'x' n union all select n || n from t) from t", "memory"),
        *(pytest.param(*case, marks=pytest.mark.nightly) for case in LONG_OR_SIMILAR),
    ],
)
def test_memory_and_time_of_a_query_are_bounded(lab, query, why):
    lab.sql("select 1")
    process = query_process()._process
    with pytest.raises(UsageError, match=why):
        lab.sql(query)
    assert len(lab.find()) == 1
    again = query_process()._process
    assert (again is process) or process.poll() is not None
    lines = Path(f"/proc/{again.pid}/status").read_text().splitlines()
    assert next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) < 1 << 20


PROMISED_S = 20
"""Most processor time that an input of any kind may take: docs/explanation/reliability.md."""


def test_the_kernel_limits_the_processor_time_of_a_query_whose_end_is_told(lab):
    """Whole queries of that length are for the night; here SIGXCPU comes at once."""
    lab.sql("select 1")
    process = query_process()._process
    limits = Path(f"/proc/{process.pid}/limits").read_text()
    most_s = int(re.search(r"Max cpu time +(\d+) ", limits)[1])
    used_s = processor_ticks(process.pid) / os.sysconf("SC_CLK_TCK")
    assert used_s < most_s < used_s + PROMISED_S
    busy = processor_ticks(process.pid) + 20
    with (
        once(
            lambda: processor_ticks(process.pid) > busy,
            lambda: process.send_signal(signal.SIGXCPU),
            "it computes",
        ),
        pytest.raises(UsageError, match="processor time"),
    ):
        lab.sql("select count(*) from range(10000000) a, range(10000000) b")
    assert len(lab.find()) == 1


def test_errors_come_back_as_what_they_are(lab, tmp_path):
    (path,) = (tmp_path / "lab" / ".undulog-catalog" / "sessions").iterdir()
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DamagedFileError, match="sets it aside") as damaged:
        Catalog(lab.where + "/.").sql("select 1")  # another address: nothing was checked yet
    assert damaged.value.path.name == path.name


def test_a_query_process_that_is_killed_is_replaced(lab):
    lab.sql("select 1")
    process = query_process()._process
    busy = processor_ticks(process.pid) + 20
    with (
        once(lambda: processor_ticks(process.pid) > busy, process.kill, "it computes"),
        pytest.raises(UsageError, match="memory"),  # whatever kills it: the kernel, most likely
    ):
        lab.sql("select count(*) from range(10000000) a, range(10000000) b")
    assert len(lab.find()) == 1
