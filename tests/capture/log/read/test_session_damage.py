"""What is no session, or only part of one: an error or a warning in words."""

import numpy as np
import pytest

from support.read_back import chunks_of, summary_of
from support.written_sessions import write_session
from undulog.capture import Session
from undulog.capture.common.errors import LogError, MissingChannelError, NotALogError

# -- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "the file is empty"),
        (b"hello world", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "without any channel"),
    ],
)
def test_what_is_no_log_is_refused_in_words(tmp_path, content, complaint):
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(NotALogError, match=complaint):
        Session.open(tmp_path / "x.mcap")


def test_a_missing_file_and_a_folder_are_log_errors(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        Session.open(tmp_path / "none.mcap")
    with pytest.raises(LogError, match=r"no session .* is in this folder"):
        Session.open(tmp_path)


def test_a_missing_topic_lists_those_there(tmp_path):
    write_session(tmp_path / "s.mcap", 3)
    with (
        Session.open(tmp_path / "s.mcap") as session,
        pytest.raises(MissingChannelError, match="has no /joint_torque; it has /gait/mode"),
    ):
        session.joints("/joint_torque")


def test_a_cut_file_keeps_every_whole_message_before_the_cut(tmp_path):
    data = write_session(tmp_path / "s.mcap", 6000)
    whole = (tmp_path / "s.mcap").read_bytes()
    previous = 0
    for part in (0.3, 0.5, 0.7, 0.9, 0.999):
        (tmp_path / "cut.mcap").write_bytes(whole[: int(len(whole) * part)])
        with Session.open(tmp_path / "cut.mcap") as session:
            values = np.array(session.joints("/joint_states").values).T
            assert any("cut short" in warning for warning in session.warnings)
        np.testing.assert_array_equal(values, data[: len(values), 0])
        assert len(values) > previous
        previous = len(values)
    assert previous > 5900


def test_a_flipped_bit_in_a_chunk_is_told_and_only_that_chunk_is_missing(tmp_path):
    write_session(tmp_path / "s.mcap", 6000)
    chunks = chunks_of(tmp_path / "s.mcap", "/joint_states")
    middle = chunks[len(chunks) // 2]
    damaged = bytearray((tmp_path / "s.mcap").read_bytes())
    damaged[middle.chunk_start_offset + middle.chunk_length // 2] ^= 0x10
    (tmp_path / "d.mcap").write_bytes(damaged)
    with Session.open(tmp_path / "d.mcap") as session:
        count = len(session.joints("/joint_states").t_ns[0])
        assert any("its messages are missing" in warning for warning in session.warnings)
    assert 3000 < count < 6000


def test_chunks_that_claim_to_have_no_bytes_are_told_as_missing(tmp_path):
    write_session(tmp_path / "s.mcap", 6000)
    damaged = bytearray((tmp_path / "s.mcap").read_bytes())
    for chunk in summary_of(tmp_path / "s.mcap").chunk_indexes:
        # Its compressed length is the last field before its bytes.
        compression = len(chunk.compression.encode())
        at = chunk.chunk_start_offset + 9 + 8 + 8 + 8 + 4 + 4 + compression
        claimed = int.from_bytes(damaged[at : at + 8], "little")
        assert claimed == chunk.compressed_size
        damaged[at : at + 8] = bytes(8)
    (tmp_path / "d.mcap").write_bytes(damaged)
    with Session.open(tmp_path / "d.mcap") as session:
        assert not session.joints("/joint_states").t_ns  # no message tells of a joint
        assert any("its messages are missing" in warning for warning in session.warnings)
