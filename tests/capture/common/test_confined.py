"""Parsers in a child process: however it ends, the parent has an error that names the file."""

import gc
import os
import signal
import socket
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from support import confined_parsers
from support.processes import python_started, wait_for
from undulog.capture.common import confined
from undulog.capture.common.confined import Confined, ParserLimits
from undulog.capture.common.errors import (
    ImportFormatError,
    MissingChannelError,
    MissingExtraError,
    NotALogError,
)
from undulog.capture.common.packets import Packet, receive, send

PARSERS = "support.confined_parsers"
MIB = 1 << 20


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "a file.bin"
    file.write_bytes(b"some bytes")
    return file


@pytest.fixture
def reader():
    opened = Confined(ImportFormatError)
    yield opened
    opened.close()


def is_alive(number):
    """Whether a process runs; one that its new parent has not awaited yet doesn't."""
    try:
        text = Path(f"/proc/{number}/stat").read_text()
    except OSError:
        return False
    return text.rpartition(")")[2].split()[0] != "Z"


def children():
    """Processes that this one has started, ended ones that it has not awaited among them."""
    folder = f"/proc/{os.getpid()}/task"
    return [
        pid for task in Path(folder).iterdir() for pid in (task / "children").read_text().split()
    ]


def test_facts_and_arrays_come_as_they_were_sent(reader, path):
    packet = reader.call(f"{PARSERS}:shapes", path)
    table = np.arange(12.0).reshape(3, 4)
    expected = {"table": table, "turned": table.T, "back": table[::-1, ::2], "none": table[:0]}
    expected |= {"bytes": np.arange(5, dtype="i1"), "day": np.array(["2024-02-29"], "M8[D]")}
    assert packet.facts == {"name": "joint\u202e\udc80", "path": str(path)}
    assert list(packet.arrays) == list(expected)
    for name, array in packet.arrays.items():
        np.testing.assert_array_equal(array, expected[name], strict=True)
    assert packet.arrays["turned"].strides == table.T.strides


def test_views_of_one_array_are_sent_once():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with here, there:
        numbers = np.arange(1 << 17, dtype=float)
        send(here, Packet({}, {f"view{k}": numbers[k:] for k in range(200)}))
        arrays = receive(there, 2 * numbers.nbytes).arrays
        assert all(np.array_equal(arrays[f"view{k}"], numbers[k:]) for k in range(200))


def test_what_is_not_sealed_or_too_large_is_no_packet():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with here, there:
        bare = os.memfd_create("x", os.MFD_ALLOW_SEALING)
        os.write(bare, bytes(100))
        socket.send_fds(here, [b"P"], [bare])
        os.close(bare)
        with pytest.raises(ValueError, match="not sealed"):
            receive(there, MIB)
        send(here, Packet({}, {"x": np.zeros(MIB)}))
        with pytest.raises(ValueError, match="a packet of"):
            receive(there, MIB)
        here.send(b"P")
        with pytest.raises(ValueError, match="without a packet"):
            receive(there, MIB)


def test_one_process_serves_several_calls_and_ends_with_its_reader(reader, path):
    first, second = (reader.call(f"{PARSERS}:process", path).facts for _ in range(2))
    assert first["pid"] == second["pid"] != os.getpid()
    assert is_alive(first["pid"])
    reader.close()
    assert not Path(f"/proc/{first['pid']}").exists()


def test_a_reader_that_is_forgotten_ends_its_process(path):
    reader = Confined(ImportFormatError)
    pid = reader.call(f"{PARSERS}:process", path).facts["pid"]
    del reader
    gc.collect()
    assert not Path(f"/proc/{pid}").exists()


def test_packets_that_are_not_taken_end_the_process(reader, path):
    packets = reader.stream(f"{PARSERS}:sleep", path)
    pid = next(packets).facts["pid"]
    packets.close()
    assert not Path(f"/proc/{pid}").exists()
    assert reader.call(f"{PARSERS}:process", path).facts["pid"] != pid


def test_a_parser_stops_where_its_packets_are_not_taken(reader, path):
    pid = reader.call(f"{PARSERS}:process", path).facts["pid"]
    for taken in range(6):
        packets = reader.stream(f"{PARSERS}:many", path, number=5)
        assert [next(packets).facts["k"] for _ in range(min(taken, 5))] == list(range(taken))[:5]
        packets.close()
        assert reader.call(f"{PARSERS}:process", path).facts["pid"] == pid
    assert int((path.parent / "sent").read_text()) == 5


def test_a_parser_waits_for_a_slow_parent(reader, path):
    packets = reader.stream(f"{PARSERS}:many", path, number=20)
    sent = path.parent / "sent"
    assert next(packets).facts["k"] == 0
    wait_for(lambda: sent.exists() and int(sent.read_text() or 0) >= 2, "it is ahead")
    assert int(sent.read_text()) <= 4
    assert [packet.facts["k"] for packet in packets] == list(range(1, 20))


def test_two_streams_of_one_reader(reader, path):
    pairs = zip(*(reader.stream(f"{PARSERS}:many", path, number=5) for _ in "ab"), strict=True)
    assert [(a.facts["k"], b.facts["k"]) for a, b in pairs] == [(k, k) for k in range(5)]


@pytest.mark.parametrize(
    ("parser", "why"),
    [
        ("crash", "is damaged: its reader was ended by SIGSEGV; export or record it again"),
        ("abort", "is damaged: its reader was ended by SIGABRT; export or record it again"),
        ("end", "can't be read: the process that read it ended early"),
        ("fail", "can't be read: ZeroDivisionError: of a library"),
    ],
)
def test_the_end_of_a_parser_is_an_error_of_the_file(reader, path, parser, why, capfd):
    for _ in range(2):  # and the next one works
        with pytest.raises(ImportFormatError) as caught:
            list(reader.stream(f"{PARSERS}:{parser}", path))
        assert (str(caught.value), caught.value.path) == (f"{path}: {why}", path)
    assert reader.call(f"{PARSERS}:shapes", path).facts["path"] == str(path)
    assert capfd.readouterr() == ("", "")


def test_errors_of_the_tree_come_as_they_are(reader, path):
    for parser, kind in [
        ("no_log", NotALogError), ("no_channel", MissingChannelError),
        ("no_extra", MissingExtraError),
    ]:  # fmt: skip
        with pytest.raises(kind) as caught:
            reader.call(f"{PARSERS}:{parser}", path)
        with pytest.raises(kind) as same:
            getattr(confined_parsers, parser)(path, None)
        assert str(caught.value) == str(same.value)
        assert vars(caught.value).get("path") == vars(same.value).get("path")


@pytest.mark.parametrize("parser", ["fill", "wrapped"])
@pytest.mark.slow
def test_a_parser_that_fills_the_memory(reader, path, parser):
    with pytest.raises(ImportFormatError, match="more than 640 MiB of memory"):
        reader.call(f"{PARSERS}:{parser}", path)
    assert reader.call(f"{PARSERS}:process", path).facts


@pytest.mark.slow
def test_a_parser_that_never_ends(reader, path, monkeypatch):
    monkeypatch.setattr(confined, "_CPU_S", 1)
    with pytest.raises(ImportFormatError, match="more than 1 s of processor time"):
        reader.call(f"{PARSERS}:turn", path)


@pytest.mark.slow
def test_a_parser_that_stands_still(reader, path, monkeypatch):
    monkeypatch.setattr(confined, "_STILL_S", 1.0)
    monkeypatch.setattr(confined, "_LOOK_S", 0.5)
    with pytest.raises(ImportFormatError, match="stood still for 1 s"):
        list(reader.stream(f"{PARSERS}:sleep", path))


def test_the_processor_time_counts_for_each_file(reader, path, monkeypatch):
    """A process that has served long doesn't end for it."""
    monkeypatch.setattr(confined, "_CPU_S", 1)
    for _ in range(3):
        assert len(list(reader.stream(f"{PARSERS}:many", path, number=100))) == 100


def test_a_file_that_a_parser_writes_has_a_bound(reader, path, tmp_path):
    target = str(tmp_path / "written")
    assert reader.call(f"{PARSERS}:write", path, target=target, length=1 << 30).facts == {}
    with pytest.raises(ImportFormatError, match="File too large"):
        reader.call(f"{PARSERS}:write", path, target=target, length=1 << 31)


def test_the_limits_grow_with_the_file():
    small, large = ParserLimits.of(1000), ParserLimits.of(5 << 30)
    assert (small.memory >> 20, small.cpu_s) == (640, 15)
    assert large.memory > 5 << 30
    assert large.cpu_s > 3600
    assert large.file_size > 5 << 30


def test_a_file_that_is_not_there_or_no_file(reader, tmp_path):
    with pytest.raises(ImportFormatError, match="No such file"):
        reader.call(f"{PARSERS}:process", tmp_path / "none")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ImportFormatError, match="a named pipe, not a file"):
        reader.call(f"{PARSERS}:process", tmp_path / "pipe")


def test_neither_the_folder_nor_the_environment_run_code(reader, path, tmp_path, monkeypatch):
    """A module beside a file, or start-up files, are not of the parser."""
    (tmp_path / "struct.py").write_text("raise SystemExit('run')")
    (tmp_path / "usercustomize.py").write_text("raise SystemExit('run')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    facts = reader.call(f"{PARSERS}:process", path).facts
    assert facts["cwd"] == str(tmp_path)
    assert str(tmp_path) not in facts["path"]


def test_an_interpreter_that_is_not_there(reader, path, monkeypatch):
    for name in ("", str(path.parent / "no-python")):
        monkeypatch.setattr(sys, "executable", name)
        with pytest.raises(ImportFormatError, match="no process can be started"):
            reader.call(f"{PARSERS}:process", path)


def test_a_thread_that_ends_does_not_end_the_process(reader, path):
    """As PR_SET_PDEATHSIG would."""
    numbers = []
    packets = reader.stream(f"{PARSERS}:many", path, number=3)
    thread = threading.Thread(target=lambda: numbers.append(next(packets).facts["k"]))
    thread.start()
    thread.join()
    assert numbers + [packet.facts["k"] for packet in packets] == [0, 1, 2]


_PARENT = f"""
import sys
from pathlib import Path
from undulog.capture.common.confined import Confined
from undulog.capture.common.errors import ImportFormatError
sys.path[:0] = sys.argv[2:]
packets = Confined(ImportFormatError).stream("{PARSERS}:sleep", Path(sys.argv[1]))
print(next(packets).facts["pid"], flush=True)
next(packets)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_end_of_the_parent_ends_the_process(path, number):
    paths = [entry for entry in sys.path if entry.endswith("tests")]
    parent = python_started(_PARENT, path, *paths)
    with parent:
        pid = int(parent.stdout.readline())
        parent.send_signal(number)
        parent.communicate()
    assert parent.returncode != 0
    wait_for(lambda: not is_alive(pid), "the child ends with its parent")


def test_no_process_is_left_after_all_this(path):
    gc.collect()
    left = set(children())
    with pytest.raises(ImportFormatError):
        Confined(ImportFormatError).call(f"{PARSERS}:crash", path)
    gc.collect()
    assert set(children()) <= left
