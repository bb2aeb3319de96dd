"""A sweep into a bucket of an S3 server on loopback, read back by pandas and by boto3."""

import json
import os
import socket
import sys
import time

import boto3
import pandas as pd
import pytest

from support.processes import process, undulog
from support.sweep_plans import comparable, write_plan
from undulog.capture import Session
from undulog.replay.sweep.rows import RowStore

KEYS = {"AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any", "AWS_REGION": "us-east-1"}


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture
def bucket(monkeypatch):
    """A boto3 client and an empty bucket, for this process and those that it starts."""
    port = free_port()
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}.items():
        monkeypatch.setenv(name, value)
    code = "import sys; from moto.server import main; main(['-H', '127.0.0.1', '-p', sys.argv[1]])"
    with process(sys.executable, "-c", code, str(port), stderr=None, stdout=None):
        until = time.monotonic() + 60
        while time.monotonic() < until:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                time.sleep(0.05)
        address = os.environ["AWS_ENDPOINT_URL"]
        client = boto3.client("s3", endpoint_url=address, region_name="us-east-1")
        client.create_bucket(Bucket="robots")
        yield client


@pytest.mark.slow
def test_rows_in_a_bucket_are_those_of_a_folder(bucket, tmp_path):
    plan, url = write_plan(tmp_path, (0.1, 0.2), top="sessions = true"), "s3://robots/strength"
    assert undulog("sweep", plan, "-o", tmp_path / "rows").returncode == 0
    done = undulog("sweep", plan, "-o", url, "--json")
    assert done.returncode == 0, done.stderr
    rows = list(RowStore(url).rows())
    assert comparable(rows) == comparable(RowStore(str(tmp_path / "rows")).rows())
    again = json.loads(undulog("sweep", plan, "-o", url, "--json").stdout)
    assert (again["run"], again["there_before"]) == (0, 2)

    found = bucket.list_objects_v2(Bucket="robots")["Contents"]
    names = [one["Key"] for one in found if one["Size"]]
    assert [name.split("/")[1] for name in names] == ["rows", "sessions", "sessions", "settings"]
    bucket.download_file("robots", names[0], str(tmp_path / "rows.parquet"))
    assert pd.read_parquet(tmp_path / "rows.parquet").status.to_list() == ["done", "done"]
    bucket.download_file("robots", names[1], str(tmp_path / "run.mcap"))
    with Session.open(tmp_path / "run.mcap") as session:
        assert session.session_id in {row["session_id"] for row in rows}


@pytest.mark.slow
@pytest.mark.usefixtures("bucket")
def test_a_bucket_that_is_not_there_is_named(tmp_path):
    done = undulog("sweep", write_plan(tmp_path), "-o", "s3://nowhere/strength")
    assert done.returncode == 1
    assert "s3://nowhere/strength" in done.stderr
    assert "Traceback" not in done.stderr
