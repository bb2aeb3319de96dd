"""A bucket of an S3 server on loopback."""

import os
import socket
import sys
from contextlib import contextmanager

import boto3

from .processes import process, wait_for

BUCKET = "robots"
_KEYS = {"AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any", "AWS_REGION": "us-east-1"}


@contextmanager
def s3_bucket(monkeypatch):
    """A boto3 client and an empty bucket, for this process and those that it starts."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    for name, value in {**_KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}.items():
        monkeypatch.setenv(name, value)
    code = "import sys; from moto.server import main; main(['-H', '127.0.0.1', '-p', sys.argv[1]])"
    with process(sys.executable, "-c", code, str(port), stderr=None, stdout=None):
        with socket.socket() as client:
            wait_for(lambda: client.connect_ex(("127.0.0.1", port)) == 0, "the server", 60)
        address = os.environ["AWS_ENDPOINT_URL"]
        client = boto3.client("s3", endpoint_url=address, region_name="us-east-1")
        client.create_bucket(Bucket=BUCKET)
        yield client
