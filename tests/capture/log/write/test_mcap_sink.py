"""A session file without a log beside it: its records, its chunks, and errors with their file."""

import errno
import os
import random

import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Metadata, Schema

from support.read_back import messages_of, metadata_of
from undulog.capture.common.errors import DataError, LogWriteError, OutputExistsError
from undulog.capture.log.write.mcap_sink import (
    McapSink,
    chunk_group,
    create_file,
    library_name,
    own_version,
    write_error,
)

SCHEMA = Schema(1, b"x", "ros2msg", "sensor_msgs/msg/Imu")
WORDS = [f"{word}{k}" for word in ("roll", "pitch", "yaw") for k in range(40)]


def written(path, **options):
    """A file of words that can be compressed well."""
    rng = random.Random(1)
    sink = McapSink(path, **options)
    sink.define(SCHEMA)
    sink.define(Channel(1, "/a", "cdr", {"k": "v"}, 1))
    for number in range(300):
        text = " ".join(rng.choices(WORDS, k=200))
        sink.write(1, 1000 + number, 900 + number, 5 + number, text.encode())
    sink.close((Metadata("end", {"a": "1"}),))
    return path


def test_chunks_are_compressed_at_level_3(tmp_path):
    usual = written(tmp_path / "usual.mcap").read_bytes()
    sizes = {}
    for level in (2, 3, 4):
        data = written(tmp_path / f"{level}.mcap", compression=level).read_bytes()
        sizes[level] = len(data)
        assert (data == usual) is (level == 3)
    assert len(set(sizes.values())) == 3


def test_messages_and_definitions_come_back_with_their_numbers(tmp_path):
    path = written(tmp_path / "run.mcap")
    messages = [(c.topic, m.log_time, m.publish_time, m.sequence) for _, c, m in messages_of(path)]
    assert messages == [("/a", 1000 + k, 900 + k, 5 + k) for k in range(300)]
    assert metadata_of(path)["end"] == {"a": "1"}
    with path.open("rb") as stream:
        header = make_reader(stream).get_header()
    assert (header.profile, header.library) == ("ros2", f"undulog/{own_version()}")
    assert library_name() == header.library


def test_a_definition_with_another_number_than_the_next_is_refused(tmp_path):
    for wrong in (0, 2):
        sink = McapSink(tmp_path / f"{wrong}.mcap")
        with pytest.raises(DataError, match=f"schema sensor has the id {wrong}; the next one is 1"):
            sink.define(Schema(wrong, b"x", "ros2msg", "sensor"))
        sink.close(())
    sink = McapSink(tmp_path / "run.mcap")
    sink.define(SCHEMA)
    with pytest.raises(DataError, match="channel /a has the id 7; the next one is 1"):
        sink.define(Channel(7, "/a", "cdr", {}, 1))
    sink.define(Attachment(3, 4, "a.toml", "application/toml", b"data"))
    sink.close(())
    with (tmp_path / "run.mcap").open("rb") as stream:
        (attachment,) = make_reader(stream).iter_attachments()
    assert (attachment.log_time, attachment.create_time, attachment.name) == (4, 3, "a.toml")
    assert (attachment.media_type, attachment.data) == ("application/toml", b"data")


def test_topics_that_carry_most_have_chunks_of_their_own():
    bulky = ("sensor_msgs/msg/JointState", "std_msgs/msg/UInt8MultiArray", "tf2_msgs/msg/TFMessage")
    assert [chunk_group("/a", name) for name in bulky] == ["/a"] * 3
    assert chunk_group("/a", "sensor_msgs/msg/Imu") == chunk_group("/b", "") == ""


# -- files -----------------------------------------------------------------------------------------


def test_a_file_is_replaced_only_by_force_and_closed_once(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(OutputExistsError) as caught:
        McapSink(path)
    assert (caught.value.path, path.read_bytes()) == (path, b"precious")
    written(path, force=True)
    assert len(messages_of(path)) == 300
    sink = McapSink(tmp_path / "b.mcap")
    sink.close((Metadata("one", {}),))
    sink.close((Metadata("two", {}),))
    assert list(metadata_of(tmp_path / "b.mcap")) == ["one"]
    for force in (False, True):
        with pytest.raises(LogWriteError, match=r"a\.mcap: can't be written: No such file"):
            create_file(tmp_path / "none" / "a.mcap", force=force)


def test_errors_of_the_system_name_the_file_and_their_reason(tmp_path):
    path = tmp_path / "a"
    plain = write_error(path, OSError(errno.EIO, os.strerror(errno.EIO)))
    assert str(plain) == f"{path}: can't be written: Input/output error"
    assert str(write_error(path, OSError("odd"))) == f"{path}: can't be written: odd"
    assert write_error(tmp_path / "b", plain) is plain


def test_a_file_that_no_room_is_left_for_fails_with_its_name():
    sink = McapSink("/dev/full", force=True)
    noise = random.Random(1).randbytes(1 << 20)
    sink.define(SCHEMA)
    sink.define(Channel(1, "/a", "cdr", {}, 1))

    def fill():
        for number in range(50):
            sink.write(1, number, number, number, noise)

    for step in (fill, lambda: sink.close(())):
        with pytest.raises(LogWriteError) as caught:
            step()
        assert str(caught.value) == "/dev/full: can't be written: No space left on device"
    sink.close(())
    assert sink._stream.closed


def test_what_is_not_closed_is_no_whole_file(tmp_path):
    sink = McapSink(tmp_path / "run.mcap")
    sink.define(SCHEMA)
    sink._stream.flush()
    with (tmp_path / "run.mcap").open("rb") as stream, pytest.raises(McapError):
        make_reader(stream).get_summary()
    sink.close(())
    assert messages_of(tmp_path / "run.mcap") == []
