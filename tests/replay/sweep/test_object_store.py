"""A sweep into a bucket of an S3 server on loopback, read back by pandas and by boto3."""

import json

import pandas as pd
import pytest

from support.bucket import s3_bucket
from support.processes import undulog
from support.sweep_plans import comparable, write_plan
from undulog.replay.sweep.rows import RowStore


@pytest.fixture
def bucket(monkeypatch):
    with s3_bucket(monkeypatch) as client:
        yield client


@pytest.mark.nightly
def test_rows_in_a_bucket_are_those_of_a_folder(bucket, tmp_path, opened):
    plan, url = write_plan(tmp_path, (0.1, 0.2), top="sessions = true"), "s3://robots/strength"
    assert undulog("sweep", plan, "-o", tmp_path / "rows").returncode == 0
    undulog("sweep", plan, "-o", url, "--json", code=0)
    rows = list(RowStore(url).rows())
    assert comparable(rows) == comparable(RowStore(str(tmp_path / "rows")).rows())
    again = json.loads(undulog("sweep", plan, "-o", url, "--json").stdout)
    assert (again["run"], again["there_before"]) == (0, 2)

    objects = bucket.list_objects_v2(Bucket="robots")["Contents"]
    names = [entry["Key"] for entry in objects if entry["Size"]]
    assert [name.split("/")[1] for name in names] == ["rows", "sessions", "sessions", "settings"]
    bucket.download_file("robots", names[0], str(tmp_path / "rows.parquet"))
    assert pd.read_parquet(tmp_path / "rows.parquet").status.to_list() == ["done", "done"]
    bucket.download_file("robots", names[1], str(tmp_path / "run.mcap"))
    assert opened(tmp_path / "run.mcap").session_id in {row["session_id"] for row in rows}


@pytest.mark.nightly
@pytest.mark.usefixtures("bucket")
def test_a_bucket_that_is_not_there_is_named(tmp_path):
    done = undulog("sweep", write_plan(tmp_path), "-o", "s3://nowhere/strength", code=1)
    assert "s3://nowhere/strength" in done.stderr
    assert "Traceback" not in done.stderr
