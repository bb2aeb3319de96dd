"""Sessions named by URL, against a web server and an S3 server on loopback."""

import json
import os
import random
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType

from support.bucket import BUCKET, s3_bucket
from support.counting_proxy import counting_proxy
from support.foreign_logs import rewrite
from support.web_servers import web_server
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import InputFileError, LogError, UndulogError
from undulog.capture.common.remote import RemoteFile, RemotePath, as_path
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.write.durable_sink import DurableSink

pytestmark = pytest.mark.slow

T0 = 1_735_689_600_000_000_000
JOINTS = tuple(f"joint{k:02d}" for k in range(1, 6))


def write(path, seconds=20, rate_hz=100, seed=1, parts=1):
    """A session of five joints whose readings are noise to the last bit, so that it stays large."""
    sink = DurableSink(path) if parts > 1 else None
    rng = np.random.default_rng(seed)
    with SessionWriter(path, session_id="far", epoch_ns=T0, sink=sink) as writer:
        commands = writer.joint_state("/joint_commands", JOINTS, unit="rad")
        states = writer.joint_state("/joint_states", JOINTS, unit="rad")
        for k in range(seconds * rate_hz):
            if sink is not None and k and k % (seconds * rate_hz // parts) == 0:
                sink.split()
            t_ns = T0 + k * 1_000_000_000 // rate_hz
            angle = 0.4 * np.sin(2 * np.pi * 0.5 * k / rate_hz - 0.6 * np.arange(5))
            commands.write(t_ns, angle)
            states.write(t_ns, 0.9 * angle + rng.normal(0, 1e-3, 5))
    return path


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return write(tmp_path_factory.mktemp("remote") / "run.mcap", seconds=60)


@pytest.fixture(scope="module")
def chunked(session, tmp_path_factory):
    """The same in chunks of a second of both topics."""
    path = tmp_path_factory.mktemp("remote") / "chunked.mcap"
    rewrite(session, path, compression=CompressionType.ZSTD, chunk_size=40_000)
    return path


@contextmanager
def both(path):
    """A web server of a file, and the session that it is, from there and from here."""
    with (
        web_server(files={f"lab/{path.name}": path.read_bytes()}) as server,
        Session.open(server.url(f"lab/{path.name}")) as far,
        Session.open(path) as near,
    ):
        yield server, far, near


def assert_same(ours, other):
    assert ours.metadata == other.metadata
    assert ours.attachments == other.attachments
    for topic in ("/joint_commands", "/joint_states"):
        a, b = ours.joints(topic), other.joints(topic)
        assert a.names == b.names
        assert all(map(np.array_equal, a.t_ns, b.t_ns))
        assert all(map(np.array_equal, a.values, b.values))


@pytest.mark.parametrize(
    ("given", "text", "name"),
    [
        ("s3://bucket/lab/run.mcap", "s3://bucket/lab/run.mcap", "run.mcap"),
        ("https://host:80/a%20b/run.mcap?sig=x/y", "https://host:80/a%20b/run.mcap", "run.mcap"),
        ("s3://bucket/why?.mcap", "s3://bucket/why?.mcap", "why?.mcap"),
        ("GS://bucket/x.mcap", "gs://bucket/x.mcap", "x.mcap"),
    ],
)
def test_a_url_is_a_path_whose_text_has_no_query(given, text, name):
    for address in (given, Path(given), as_path(given)):  # as the command line makes them
        path = as_path(address)
        assert isinstance(path, RemotePath)
        assert (str(path), path.name, path.suffix) == (text, name, ".mcap")
        assert str(path.with_name("other.mcap")) == text.removesuffix(name) + "other.mcap"
        assert not path.is_dir()


@pytest.mark.parametrize("given", ["run.mcap", "/data/s3/run.mcap", "a:/b", "s3:", "C:/x", "https"])
def test_other_paths_stay_what_they_are(given):
    assert not isinstance(as_path(given), RemotePath)


def test_a_session_on_a_web_server_reads_as_its_file_does(session):
    with both(session) as (server, far, near):
        assert_same(far, near)
        assert far.warnings == near.warnings
        assert far.size == session.stat().st_size
        names = {path for path, _ in server.asked}
    assert names == {"/lab/run.mcap"}  # no other file was looked for


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4, "chunk_size": 20_000},
        {"compression": CompressionType.ZSTD, "chunk_size": 5_000_000},
        {"use_chunking": False},
    ],
)
def test_files_of_another_make_read_as_they_do_here(session, tmp_path, options):
    path = tmp_path / "foreign.mcap"
    rewrite(session, path, **options)
    with both(path) as (_, far, near):
        assert_same(far, near)
        assert far.warnings == near.warnings


def test_a_cut_file_is_fetched_whole_and_read_as_far_as_it_goes(session, tmp_path):
    path = tmp_path / "cut.mcap"
    path.write_bytes(session.read_bytes()[:-30_000])
    with both(path) as (_, far, near):
        assert_same(far, near)
        assert [w.replace(str(far.path), "") for w in far.warnings] == near.warnings


def test_a_window_fetches_a_part_and_a_second_look_nothing(chunked):
    window = {"start_ns": T0 + 40_000_000_000, "stop_ns": T0 + 41_000_000_000}
    with both(chunked) as (server, far, near):
        opened = server.sent
        got, want = (session.joints("/joint_states", **window) for session in (far, near))
        assert all(map(np.array_equal, got.values, want.values))
        fetched = server.sent
        assert fetched - opened < 0.35 * near.size
        far.joints("/joint_states", **window)
        assert server.sent == fetched


def test_whole_reading_takes_few_requests_and_each_byte_once(chunked):
    with both(chunked) as (server, far, near):
        assert len(far.chunk_times_ns[0]) > 20
        far.columns({"/joint_states": ["position"], "/joint_commands": ["position"]}, {})
        assert server.sent < 1.1 * near.size + 200_000
        assert len(server.asked) < 10


def test_health_is_that_of_the_file(session):
    with web_server(files={"run.mcap": session.read_bytes()}) as server:
        far, near = check_session(server.url("run.mcap")), check_session(session)
    assert (far.verdict, far.reasons, far.file) == (near.verdict, near.reasons, near.file)
    assert far.file.checked == far.file.chunks > 0


def test_a_split_session_is_followed_from_its_first_part(tmp_path):
    write(tmp_path / "run.mcap", parts=4)
    files = {f"lab/{path.name}": path.read_bytes() for path in tmp_path.glob("*.mcap")}
    assert len(files) == 4
    with (
        web_server(files=files) as server,
        Session.open(server.url("lab/run.mcap")) as far,
        Session.open(tmp_path) as near,
    ):
        assert_same(far, near)
        assert len(far.files) == len(files)


@pytest.mark.parametrize(
    ("options", "name", "why"),
    [
        ({}, "none.mcap", "no such object"),
        ({"ranges": False}, "run.mcap", "the server sends no ranges of bytes; download the file"),
        ({"refuse": True}, "run.mcap", "the server refuses access"),
        ({}, "empty.mcap", "the file is empty"),
        ({}, "text.mcap", "not an MCAP file"),
    ],
)
def test_what_cannot_be_read_is_an_error_without_the_query(session, options, name, why):
    files = {"run.mcap": session.read_bytes(), "empty.mcap": b"", "text.mcap": b"hello" * 99}
    with (
        web_server(files=files, **options) as server,
        pytest.raises((InputFileError, LogError), match=why) as error,
    ):
        Session.open(server.url(name) + "?sig=SECRET")
    assert "SECRET" not in str(error.value)


def test_a_server_that_is_gone_is_an_error():
    with web_server() as server:
        url = server.url("run.mcap")
    with pytest.raises(InputFileError, match="can't be reached"):
        Session.open(url)


@pytest.mark.parametrize(
    ("attribute", "value", "why"),
    [
        ("etag", '"second"', "has changed since it was opened"),
        ("refuse", True, "refuses access"),
    ],
)
def test_an_object_that_changes_or_stops_midway_is_an_error(session, attribute, value, why):
    with both(session) as (server, far, _):
        setattr(server, attribute, value)
        with pytest.raises(InputFileError, match=why):
            far.joints("/joint_states")


def test_a_damaged_chunk_is_left_out_and_named(chunked, tmp_path, opened):
    data = bytearray(chunked.read_bytes())
    middle = len(opened(chunked).chunk_times_ns[0]) // 2
    with chunked.open("rb") as stream:
        index = make_reader(stream).get_summary().chunk_indexes[middle]
    data[index.chunk_start_offset + index.chunk_length // 2] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    with both(path) as (_, far, near):
        assert_same(far, near)
        assert [w.replace(str(far.path), str(near.path)) for w in far.warnings] == near.warnings
        assert any("its messages are missing" in warning for warning in far.warnings)


@pytest.mark.nightly
def test_mutated_summaries_never_read_otherwise_than_here(chunked, tmp_path):
    """Each byte of the summary may be wrong: the outcome is the file's own, or says what lacks.

    Here the heads of chunks are read with the index; there a chunk has to be what its index says.
    """
    whole = chunked.read_bytes()
    with chunked.open("rb") as stream:
        last = make_reader(stream).get_summary().chunk_indexes[-1]
    dice = random.Random(7)
    path = tmp_path / "mutant.mcap"

    def read(where):
        try:
            with Session.open(where) as opened:
                return opened.joints("/joint_states").values, opened.warnings
        except UndulogError:
            return None, []

    outcomes = []
    with web_server() as server:
        for _ in range(60):
            data = bytearray(whole)
            for _ in range(dice.randint(1, 4)):
                data[dice.randrange(last.chunk_start_offset, len(data))] = dice.randrange(256)
            path.write_bytes(data)
            server.files["m.mcap"] = bytes(data)
            (want, _), (got, warnings) = read(path), read(server.url("m.mcap"))
            assert (got is None) == (want is None)
            same = got is None or all(map(np.array_equal, got, want))
            assert same or warnings  # never otherwise without a word
            outcomes.append(got is not None and same)
    assert sum(outcomes) > 20


def test_a_url_opens_as_a_stream(session):
    data = session.read_bytes()
    with web_server(files={"run.mcap": data}) as server:
        path = as_path(server.url("run.mcap"))
        assert path.read_bytes() == data
        with pytest.raises(InputFileError, match="can only be read"):
            path.open("wb")


@pytest.fixture(scope="module")
def bucket():
    with pytest.MonkeyPatch.context() as patch, s3_bucket(patch) as client:
        yield client


@pytest.mark.nightly
def test_an_hour_in_a_bucket_is_analysed_in_a_window_with_few_of_its_bytes(
    bucket, tmp_path, monkeypatch, command
):
    whole, path = write(tmp_path / "one.mcap", seconds=3600, rate_hz=20), tmp_path / "hour.mcap"
    rewrite(whole, path, compression=CompressionType.ZSTD, chunk_size=60_000)
    bucket.upload_file(str(path), BUCKET, "lab 1/hour.mcap")
    port = int(os.environ["AWS_ENDPOINT_URL"].rpartition(":")[2])
    words = ["--start", "1800", "--stop", "1810", "--json"]
    with counting_proxy(port) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{proxy.port}")
        far = command("analyse", f"s3://{BUCKET}/lab 1/hour.mcap", *words).out
        assert 0 < proxy.sent <= 0.03 * path.stat().st_size
    near, far = json.loads(command("analyse", path, *words).out), json.loads(far)
    assert far["joints"] == near["joints"]
    assert far["gait"] == near["gait"]
    assert far["session"]["path"] == f"s3://{BUCKET}/lab 1/hour.mcap"


def test_missing_credentials_and_objects_in_a_bucket_are_named(bucket, monkeypatch):
    with pytest.raises(InputFileError, match="no such object"):
        Session.open(f"s3://{BUCKET}/none.mcap")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    with pytest.raises(InputFileError, match="no credentials are set: AWS_ACCESS_KEY_ID"):
        Session.open(f"s3://{BUCKET}/none.mcap")


def test_ranges_come_as_they_are_asked_for(session):
    data = session.read_bytes()
    with web_server(files={"run.mcap": data}) as server:
        file = RemoteFile(as_path(server.url("run.mcap")))
        ranges = [(0, 10), (100_000, 100_001), (len(data) - 5, len(data))]
        assert file.read_many(ranges) == [data[a:b] for a, b in ranges]
        assert file.read_many([]) == []
