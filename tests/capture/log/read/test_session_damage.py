"""What is no session, or only part of one: an error or a warning in words."""

import random

import numpy as np
import pytest

from support.read_back import read, summary_of
from support.written_sessions import write_session
from undulog.capture import Session
from undulog.capture.common.errors import LogError, MissingChannelError, NotALogError
from undulog.capture.log.read.facts import read_facts

# -- bad input ---------------------------------------------------------------------------------


NO_LOGS = {
    "the file is empty": b"",
    "not an MCAP file": b"hello world",
    "without any channel": b"\x89MCAP0\r\n",
}


@pytest.mark.parametrize("fault", NO_LOGS)
def test_what_is_no_log_is_refused_in_words(tmp_path, fault):
    (tmp_path / "x.mcap").write_bytes(NO_LOGS[fault])
    with pytest.raises(NotALogError, match=fault):
        Session.open(tmp_path / "x.mcap")


def test_a_missing_file_and_a_folder_are_log_errors(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        Session.open(tmp_path / "none.mcap")
    with pytest.raises(LogError, match=r"no session .* is in this folder"):
        Session.open(tmp_path)


def test_a_missing_topic_lists_those_there(tmp_path):
    write_session(tmp_path / "s.mcap", 3)
    missing = "has no /joint_torque; it has /gait/mode"
    with Session.open(tmp_path / "s.mcap") as s, pytest.raises(MissingChannelError, match=missing):
        s.joints("/joint_torque")


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


def test_chunks_that_claim_to_have_no_bytes_are_reported_as_missing(tmp_path):
    path = tmp_path / "s.mcap"
    write_session(path, 6000)  # several chunks
    data = bytearray(path.read_bytes())
    for chunk in summary_of(path).chunk_indexes:
        # Its compressed length is the last field before its bytes.
        at = chunk.chunk_start_offset + 9 + 8 + 8 + 8 + 4 + 4 + len(chunk.compression.encode())
        assert int.from_bytes(data[at : at + 8], "little") == chunk.compressed_size
        data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    with Session.open(path) as session:
        assert not session.joints("/joint_states").t_ns  # no message names a joint
        assert any("its messages are missing" in warning for warning in session.warnings)


def test_no_bit_of_a_summary_is_read_wrong(tmp_path):
    path = tmp_path / "s.mcap"
    write_session(path, 50)
    raw = path.read_bytes()
    start = raw.rindex(bytes([0x0F]) + (4).to_bytes(8, "little")) + 9 + 4  # behind the data's end
    truth, warnings = read(path)
    assert len(truth) >= 50
    assert not warnings
    dice = random.Random(3)
    for _ in range(300):
        data = bytearray(raw)
        data[dice.randrange(start, len(raw) - 8)] ^= 1 << dice.randrange(8)
        path.write_bytes(data)
        assert read_facts("s.mcap", len(raw), lambda start, stop: data[start:stop]).damage  # noqa: B023
        messages, warnings = read(path)
        assert messages == truth
        assert any("read record by record" in text for text in warnings)
