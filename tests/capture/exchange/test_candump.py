"""The candump format, against its definition in can-utils and against python-can."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from undulog.capture.common.errors import ImportFormatError
from undulog.capture.exchange.formats.candump import candump_lines, read_candump
from undulog.capture.exchange.frame_log import joined
from undulog.capture.log.messages import frames as fr


def read(path, text):
    path.write_text(text)
    with path.open() as stream:
        log = read_candump(path, stream)
        return log, joined(list(log.blocks))


def written(text, path):
    log, block = read(path, text)
    nanoseconds = bool((block.times_ns() % 1000).any())
    lines = candump_lines(block, log.buses, directions=log.directions, nanoseconds=nanoseconds)
    return "".join(lines)


HEX = st.binary(max_size=8).map(lambda data: data.hex().upper())
FD_HEX = st.binary(max_size=64).map(lambda data: data.hex().upper())
CONTENT = st.one_of(
    st.builds("{:03X}#{}".format, st.integers(0, 0x7FF), HEX),
    st.builds("{:08X}#{}".format, st.integers(0, 0x1FFF_FFFF), HEX),
    st.builds("{:08X}#{}".format, st.integers(0x2000_0000, 0x2000_01FF), HEX),
    st.builds("{:03X}#R{}".format, st.integers(0, 0x7FF), st.sampled_from(["", *"12345678"])),
    st.builds("{:03X}##{:X}{}".format, st.integers(0, 0x7FF), st.integers(0, 15), FD_HEX),
    st.builds("{:08X}##{:X}{}".format, st.integers(0, 0x1FFF_FFFF), st.integers(0, 15), FD_HEX),
    st.builds("{:03X}#{}_{}".format, st.just(5), st.just("00" * 8), st.sampled_from("9ABCDEF")),
)
TIME = st.builds("{}.{:06d}".format, st.integers(0, 4_102_444_800), st.integers(0, 999_999))
LOG = st.lists(st.tuples(TIME, st.sampled_from(["can0", "vcan1"]), CONTENT), min_size=1)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(lines=LOG, ways=st.none() | st.lists(st.sampled_from("RT"), min_size=1))
def test_what_is_read_is_written_the_same(lines, ways, tmp_path):
    text = "".join(
        f"({time}) {bus} {content}{'' if ways is None else ' ' + ways[i % len(ways)]}\n"
        for i, (time, bus, content) in enumerate(lines)
    )
    assert written(text, tmp_path / "x.log") == text


def test_frames_of_every_kind(tmp_path):
    log, block = read(
        tmp_path / "x.log",
        "(1717639553.000022) can0 14B#9B01 T\n"
        "(1717639553.000023) can1 18FEF100#0102030405060708 R\n"
        "(1717639553.000024) can0 7FF#R4 R\n"
        "(1717639553.000025) can0 20000080#0000000000000100 R\n"
        "(1717639553.000026123) can0 001#\n",
    )
    frames = block.classic()
    assert log.buses == ["can0", "can1"]
    assert block.bus.tolist() == [0, 1, 0, 0, 0]
    times_ns = [1717639553_000022000 + 1000 * i for i in range(4)]
    assert frames["t_host_ns"].tolist() == [*times_ns, 1717639553_000026123]
    assert not frames["t_device_ns"].any()
    extended, remote = 0x18FEF100 | fr.EXTENDED_FLAG, 0x7FF | fr.REMOTE_FLAG
    assert frames["id_flags"].tolist() == [0x14B, extended, remote, 0x80 | fr.ERROR_FLAG, 1]
    assert frames["dlc"].tolist() == [2, 8, 4, 8, 0]
    assert frames["dir"].tolist() == [fr.DIR_TX, *[fr.DIR_RX] * 4]
    assert frames["data"][0].tolist() == [0x9B, 1, 0, 0, 0, 0, 0, 0]
    assert log.problems == ["1 frames without a direction, unlike the first one"]


def test_can_fd_frames(tmp_path):
    text = f"(1.0) can1 001#00\n(1.000001) can0 001##3{'AB' * 64}\n(1.000002) can1 00000002##5\n"
    log, block = read(tmp_path / "x.log", text)
    assert (len(block), log.problems) == (3, [])
    assert block.is_fd.tolist() == [False, True, True]
    assert block.times_ns().tolist() == [1_000_000_000, 1_000_001_000, 1_000_002_000]
    assert block.bus.tolist() == [0, 1, 0]
    assert block.frames["id_flags"].tolist() == [1, 1, 2 | fr.EXTENDED_FLAG]
    assert block.frames["len"].tolist() == [1, 64, 0]
    assert block.frames["fd_flags"].tolist() == [0, fr.FD_BRS | fr.FD_ESI, fr.FD_BRS | 4]
    assert block.frames["data"].tolist() == [[0] * 64, [0xAB] * 64, [0] * 64]


def test_a_cut_last_line_is_reported(tmp_path):
    log, block = read(tmp_path / "x.log", "(1.000000) can0 001#00 R\n(1.000001) can0 001#0")
    assert len(block) == 1
    assert log.problems == ["the last line is cut short and left out: '(1.000001) can0 001#0'"]


LINES = ("1##1000", "001##", "1234#00", "123#0G")
WRONG = [*(f"(1.0) can0 {line}" for line in LINES), "nonsense", "(x) c 1#"]


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_line_is_named(line, tmp_path):
    text = f"(1.000000) can0 001#00\n\n{line}\n(1.000000) can0 001#00\n"
    with pytest.raises(ImportFormatError, match=r"x\.log: line 3 is no candump line: "):
        read(tmp_path / "x.log", text)


def test_another_format_is_refused(tmp_path):
    with pytest.raises(ImportFormatError, match="is not a candump log; its first line is 'Jan 1"):
        read(tmp_path / "x.log", "Jan 1 kernel: hello\n")
