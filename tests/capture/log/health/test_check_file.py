"""`undulog log check` against faults planted in the file, and logs of other makes."""

import re
import struct

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType

from support.checked_sessions import EPOCH_NS, NAMES, ROBOT, TICKS, at, gait, timing_of, write_raw
from support.read_back import chunks_of
from support.written_sessions import joint_state, write_foreign
from support.written_topics import write_topics
from undulog.capture import SessionWriter
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.mcap.chunk import walk_records

pytestmark = pytest.mark.slow


def flip(data, at_byte):
    data[at_byte] ^= 0x10


def changed(path, source, change):
    """The health of a copy of a file with changed bytes."""
    data = bytearray(source.read_bytes())
    change(data)
    path.write_bytes(data)
    return check_session(path)


@pytest.mark.parametrize("part", [0.02, 0.5, 0.9])
def test_a_flipped_bit_is_found_and_bad(clean, tmp_path, part):
    chunk = chunks_of(clean, "/joint_states")[0]
    at_byte = chunk.chunk_start_offset + 60 + int(part * (chunk.chunk_length - 60))
    health = changed(tmp_path / "s.mcap", clean, lambda data: flip(data, at_byte))
    assert health.verdict == "bad"
    assert health.file.checked == health.file.chunks - 1
    (fault,) = health.file.damage
    assert "the chunk at byte" in fault
    left = timing_of(health).count
    assert 0 < left < TICKS
    held = re.search(r"; it held (\d+) messages: (\d+) of /joint_states$", fault)
    assert held is not None  # the index has it, whatever is around it in the file
    assert int(held[1]) == int(held[2]) == TICKS - left
    assert timing_of(health, "/joint_commands").count == TICKS


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
@pytest.mark.parametrize("indexed", [True, False])
def test_a_flipped_bit_is_found_however_the_chunk_is_stored(tmp_path, compression, indexed):
    kinds = IndexType.ALL if indexed else IndexType.NONE
    options = {"compression": compression, "chunk_size": 20_000, "index_types": kinds}
    path = write_raw(tmp_path / "s.mcap", list(range(500)), **options)
    data = path.read_bytes()
    chunks = [span for span in walk_records(data, 8, len(data)) if span[0] == 6]
    assert check_session(path).file.damage == ()
    _, start, stop = chunks[2]
    health = changed(path, path, lambda data: flip(data, (start + stop) // 2))
    assert health.verdict == "bad"
    assert len(health.file.damage) == 1
    assert health.file.indexed is indexed


def test_an_index_that_lists_a_message_twice_is_found(tmp_path):
    path = write_raw(tmp_path / "s.mcap", list(range(100)))
    data = bytearray(path.read_bytes())
    _, start, _ = next(span for span in walk_records(bytes(data), 8, len(data)) if span[0] == 7)
    data[start + 14 : start + 22] = data[start + 30 : start + 38]  # no CRC covers it
    path.write_bytes(data)
    health = check_session(path)
    assert health.verdict == "bad"
    assert "does not list its messages" in health.file.damage[0]


def test_a_summary_that_counts_more_than_there_is_is_found(tmp_path):
    path = write_raw(tmp_path / "s.mcap", list(range(100)), enable_crcs=False)
    data = bytearray(path.read_bytes())
    counts = struct.pack("<HQHQ", 1, 100, 2, 100)
    assert data.count(counts) == 1
    at_count = data.index(counts) + 2
    data[at_count : at_count + 8] = struct.pack("<Q", 107)
    path.write_bytes(data)
    fault = "the summary counts 107 messages of /joint_commands, 100 are in the file"
    assert check_session(path).file.damage == (fault,)


def test_a_flipped_bit_in_an_attachment_is_found(clean, tmp_path):
    at_byte = clean.read_bytes().index(b"+-30 degrees")
    health = changed(tmp_path / "s.mcap", clean, lambda data: flip(data, at_byte))
    assert health.verdict == "bad"
    assert "the attachment" in health.file.damage[0]


def test_a_cut_file_is_degraded_with_what_is_left(clean, tmp_path):
    chunk = chunks_of(clean, "/joint_states")[0]
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    (tmp_path / "s.mcap").write_bytes(clean.read_bytes()[:middle])
    health = check_session(tmp_path / "s.mcap")
    assert health.file.truncated
    assert health.verdict == "degraded"
    assert health.reasons[0].startswith("the file is cut short")
    assert 0 < timing_of(health).count < TICKS


def test_a_file_without_index_is_degraded(tmp_path):
    health = check_session(write_raw(tmp_path / "s.mcap", list(range(300)), use_chunking=False))
    assert (health.file.truncated, health.file.indexed) == (False, False)
    assert health.verdict == "degraded"
    assert timing_of(health).count == 300


def test_an_uncovered_chunk_is_noted(tmp_path):
    health = check_session(write_raw(tmp_path / "s.mcap", list(range(300)), enable_crcs=False))
    assert health.verdict == "good"
    assert "carry no CRC" in health.notes[0]


# -- foreign bags ----------------------------------------------------------------------------------


def foreign(path, topic, names):
    """Each tick one message a list of names, as mcap-ros2-support writes them."""
    messages = [
        (topic, t_ns, joint_state(t_ns, group, [float(np.sin(tick / 20 + k))] * len(group)))
        for tick in range(400)
        for k, group in enumerate(names)
        for t_ns in [at(tick) + k * 200_000]
    ]
    return write_foreign(path, messages)


def test_a_foreign_bag_is_checked_joint_by_joint(tmp_path):
    health = check_session(foreign(tmp_path / "s.mcap", "/joint_states", [["a"], ["b"], ["c"]]))
    gaps = {series.label: series.timing.gaps for series in health.series}
    assert gaps == {f"/joint_states ({name})": 0 for name in "abc"}
    assert [channel.sequence.kind for channel in health.channels] == ["none"]
    assert health.reasons == ("/joint_commands is missing; joints are on /joint_states",)


def test_missing_contract_topics_are_named(tmp_path):
    health = check_session(foreign(tmp_path / "s.mcap", "/arm/state", [["a", "b"]]))
    assert health.verdict == "degraded"
    assert "/joint_states is missing; joints are on /arm/state" in health.reasons
    with SessionWriter(tmp_path / "t.mcap", session_id="t", epoch_ns=EPOCH_NS) as writer:
        writer.string("/gait/mode").write(EPOCH_NS, "walk")
    assert check_session(tmp_path / "t.mcap").verdict == "bad"


def test_a_joint_without_samples_is_named(tmp_path):
    ticks = np.arange(300)
    commands = np.array([gait(tick) for tick in ticks])
    states = commands[:, :-1] + 1e-3 * np.sin(ticks)[:, None]
    topics = {"/joint_commands": (NAMES, "rad", commands)}
    topics["/joint_states"] = (NAMES[:-1], "rad", states)
    path = write_topics(tmp_path / "s.mcap", at(ticks), topics, epoch_ns=EPOCH_NS, robot=ROBOT)
    assert check_session(path).reasons == ("/joint_states never carries joint25",)


def test_what_is_no_log_is_an_error(tmp_path, command):
    (tmp_path / "x.mcap").write_bytes(b"no log at all")
    assert "not an MCAP file" in command("log", "check", tmp_path / "x.mcap", code=1).err
