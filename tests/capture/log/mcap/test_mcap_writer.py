"""Our MCAP writer against the mcap library's: the same calls give the same bytes.

But for one thing: our zstd frames have a checksum, so the library is given a compressor that does
the same.
"""

import contextlib
import errno
import io
import struct
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from undulog.capture.common.process import helpers
from undulog.capture.log.mcap.batch import MessageBatch
from undulog.capture.log.mcap.chunk import BODY_AT
from undulog.capture.log.mcap.writer import McapWriter

NUMBER = st.integers(0, 2**64 - 1)
CALLS = st.lists(
    st.one_of(
        st.tuples(
            st.just("message"), st.integers(0, 9), NUMBER, st.binary(max_size=80), NUMBER,
            st.integers(0, 2**32 - 1),
        ),
        st.tuples(
            st.just("rows"), st.integers(0, 9), st.lists(NUMBER, max_size=12),
            st.binary(max_size=80), st.integers(0, 2**32 - 20),
        ),
        st.tuples(st.just("schema"), st.text(max_size=5), st.binary(max_size=30)),
        st.tuples(st.just("channel"), st.text(max_size=5)),
        st.tuples(st.just("attachment"), NUMBER, st.text(max_size=5), st.binary(max_size=50)),
        st.tuples(st.just("metadata"), st.dictionaries(st.text(max_size=3), st.text(max_size=3))),
        st.just(("flush",)),
    ),
    max_size=40,
)  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def library_with_checksums():
    """The library compresses with checksums while these tests run."""
    compressor = zstandard.ZstdCompressor(write_checksum=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcap.writer.zstandard", SimpleNamespace(compress=compressor.compress))
        yield


def add_rows(writer, channel, times, data, sequence):
    """Add messages of one size: at once by our writer, one by one by the library."""
    payloads = [bytes(b ^ k for b in data) for k in range(len(times))]
    if isinstance(writer, McapWriter):
        rows = np.zeros((len(times), BODY_AT + len(data)), np.uint8)
        rows[:, BODY_AT:] = np.frombuffer(b"".join(payloads), np.uint8).reshape(
            len(times), len(data)
        )
        times_ns = np.array(times, np.uint64)
        writer.add_batch(MessageBatch(channel, times_ns, times_ns, sequence, rows))
        return
    for k, (t_ns, payload) in enumerate(zip(times, payloads, strict=True)):
        writer.add_message(channel, t_ns, payload, t_ns, sequence + k)


def written(kind, calls, chunk_size):
    stream = io.BytesIO()
    writer = kind(stream, chunk_size=chunk_size)
    writer.start("ros2", "a library")
    schema = writer.register_schema("a", "ros2msg", b"float64 x")
    ids = [writer.register_channel("/a", "cdr", schema, {"unit": "m"})]
    for name, *values in calls:
        if name == "message":
            channel, log_time, data, publish_time, sequence = values
            channel = ids[channel % len(ids)]
            writer.add_message(channel, log_time, data, publish_time, sequence)
        elif name == "rows":
            channel, times, data, sequence = values
            add_rows(writer, ids[channel % len(ids)], times, data, sequence)
        elif name == "schema":
            schema = writer.register_schema(values[0], "ros2msg", values[1])
        elif name == "channel":
            ids.append(writer.register_channel(values[0], "cdr", schema, {}))
        elif name == "attachment":
            writer.add_attachment(values[0], values[0] // 2, values[1], "text/plain", values[2])
        elif name == "metadata":
            writer.add_metadata("facts", values[0])
        else:
            writer.flush()
    writer.finish()
    return stream.getvalue(), ids


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(calls=CALLS, chunk_size=st.integers(1, 400))
def test_the_bytes_are_those_of_the_library(calls, chunk_size):
    ours, theirs = (written(kind, calls, chunk_size) for kind in (McapWriter, Writer))
    assert ours == theirs


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(calls=CALLS, chunk_size=st.integers(1, 400), waiting=st.integers(0, 1500))
def test_helper_threads_change_no_byte(calls, chunk_size, waiting):
    with helpers(3) as pool, pytest.MonkeyPatch.context() as patch:
        patch.setattr("undulog.capture.log.mcap.writer._MOST_WAITING", waiting)
        threaded = written(partial(McapWriter, helpers=pool), calls, chunk_size)
    assert threaded == written(McapWriter, calls, chunk_size)


def numbers_in(stream):
    """Sequence numbers of the messages of a file that has no end yet."""
    numbers = []
    with contextlib.suppress(EndOfFile):
        for record in StreamReader(io.BytesIO(stream.getvalue()), record_size_limit=None).records:
            numbers += [record.sequence] if isinstance(record, Message) else []
    return numbers


@settings(max_examples=50, deadline=None)
@given(sizes=st.lists(st.integers(0, 300), max_size=60), waiting=st.integers(0, 1500))
def test_what_is_settled_with_helpers_is_in_the_file(sizes, waiting):
    stream = io.BytesIO()
    with helpers(2) as pool, pytest.MonkeyPatch.context() as patch:
        patch.setattr("undulog.capture.log.mcap.writer._MOST_WAITING", waiting)
        writer = McapWriter(stream, 400, helpers=pool)
        writer.start("", "")
        channel = writer.register_channel("/a", "cdr", 0)
        for number, size in enumerate(sizes):
            writer.add_message(channel, number, bytes(size), number, number)
            assert numbers_in(stream) == [*range(writer.settled)]
        writer.settle(writer.messages)
        assert writer.settled == len(sizes)
        writer.finish()
    stream.seek(0)
    assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == len(sizes)


def test_a_full_disk_is_reported_with_helpers():
    class Full(io.BytesIO):
        def write(self, data):
            if self.tell() + len(data) > 2000:
                raise OSError(errno.ENOSPC, "no space")
            return super().write(data)

    with helpers(2) as pool:
        writer = McapWriter(Full(), 400, helpers=pool)
        writer.start("", "")
        channel = writer.register_channel("/a", "cdr", 0)
        random = np.random.default_rng(1)

        def write():
            for number in range(50):
                writer.add_message(channel, number, random.bytes(200), number, number)
            writer.finish()

        with pytest.raises(OSError, match="no space"):  # at once or at the end, never swallowed
            write()


def test_a_long_file_of_many_channels():
    rng = np.random.default_rng(1)
    calls = [("channel", f"/t{k}") for k in range(30)]
    calls += [
        ("message", int(k), 10**18 + i * 1000, rng.bytes(int(k) * 7), 10**18 + i, i)
        for i, k in enumerate(rng.integers(0, 31, 20_000))
    ]
    ours, theirs = (written(kind, calls, 1 << 17)[0] for kind in (McapWriter, Writer))
    assert ours == theirs
    assert make_reader(io.BytesIO(ours)).get_summary().statistics.message_count == 20_000


def test_a_number_out_of_range_leaves_the_chunk_as_it_was():
    stream = io.BytesIO()
    writer = McapWriter(stream)
    writer.start("", "")
    channel = writer.register_channel("/a", "cdr", 0)
    writer.add_message(channel, 5, b"x", 5, 0)
    with pytest.raises(struct.error):
        writer.add_message(channel, 2**64, b"y", 5, 1)
    writer.finish()
    stream.seek(0)
    assert [m.data for _, _, m in make_reader(stream).iter_messages()] == [b"x"]


@settings(max_examples=200, deadline=None)
@given(
    channels=st.lists(st.integers(0, 5), max_size=120),
    settles=st.sets(st.integers(0, 119)),
    chunk_size=st.integers(1, 600),
)
def test_groups_have_chunks_of_their_own_and_what_is_settled_is_in_the_file(
    channels, settles, chunk_size
):
    """A foreign reader finds each channel whole, in order, and the first messages at any time."""
    stream = io.BytesIO()
    writer = McapWriter(stream, chunk_size, lambda topic, kind: topic if kind == "big" else "")
    writer.start("", "")
    kinds = [writer.register_schema(name, "ros2msg", b"") for name in ("big", "small")]
    ids = [writer.register_channel(f"/t{k}", "cdr", kinds[k % 2]) for k in range(6)]
    for k, channel in enumerate(channels):
        writer.add_message(ids[channel], 7 + k, b"%d" % k * (channel + 1), k, k)
        if k in settles:
            writer.settle(k // 2)
            assert writer.settled >= k // 2
        assert 0 <= writer.settled <= writer.messages == k + 1
        assert set(range(writer.settled)) <= set(numbers_in(stream))
    writer.finish()
    reader = make_reader(io.BytesIO(stream.getvalue()))
    messages = [(c.id, m.sequence, m.data) for _, c, m in reader.iter_messages()]
    assert messages == [(ids[c], k, b"%d" % k * (c + 1)) for k, c in enumerate(channels)]
    for chunk in reader.get_summary().chunk_indexes:
        topics = [key for key in chunk.message_index_offsets if ids.index(key) % 2 == 0]
        assert not topics or list(chunk.message_index_offsets) == topics[:1]
