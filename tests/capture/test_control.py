"""The control socket against real clients: slow, silent, mad, many, and other recorders."""

import contextlib
import json
import os
import resource
import shutil
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from capture.daemon import control
from capture.daemon.control import LATER, MAX_CLIENTS, TEND_POLLS, ControlServer
from capture.daemon.control_client import ControlClient
from capture.daemon.control_lines import BUFFER
from capture.daemon.control_requests import OPERATOR, OperatorLog, request_handler
from capture.daemon.control_socket import default_socket, find_sockets, socket_folder
from capture.errors import ControlError, DataError
from capture.log.writer import SessionWriter

EPOCH_NS = 1_700_000_000_000_000_000
PATIENCE_S = 60.0


def echo(request):
    """A handler that says what it got; some words have effects."""
    if request.get("do") == "refuse":
        raise DataError("not now")
    if request.get("do") == "big":
        return {"text": "x" * request["size"]}
    if request.get("do") == "mistake":
        return {"value": float("nan")} if request.get("nan") else {}["none"]
    if request.get("do") == "later":
        return LATER
    return {"got": dict(request)}


@pytest.fixture
def server(tmp_path):
    """A server that the test polls."""
    server = ControlServer(tmp_path / "c.sock", echo)
    yield server
    server.close()


@contextlib.contextmanager
def polled(server, pause_s=0.001):
    """A server polled by a thread, as by the recorder's loop."""
    ended = threading.Event()

    def loop():  # an exception in here fails the test: pytest warns of it
        while not ended.is_set():
            server.poll()
            time.sleep(pause_s)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def connected(server):
    """A raw client that doesn't block for ever."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.connect(str(server.path))
    client.settimeout(PATIENCE_S)
    return client


def polls(server, until):
    """Poll until a condition holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not until():
        assert time.monotonic() < deadline
        server.poll()


def replies(data):
    """Reply lines, each read as JSON."""
    assert data.endswith(b"\n")
    return [json.loads(line) for line in data.splitlines()]


def drain(server, client, count):
    """Poll and read until so many reply lines have come."""
    data = b""
    client.setblocking(False)
    deadline = time.monotonic() + PATIENCE_S
    while data.count(b"\n") < count:
        assert time.monotonic() < deadline
        server.poll()
        with contextlib.suppress(BlockingIOError):
            got = client.recv(65536)
            assert got, "the server let go"
            data += got
    client.settimeout(PATIENCE_S)
    return replies(data)


# -- requests and replies ------------------------------------------------------------------------


def test_each_request_gets_its_reply_in_order_on_one_connection(server):
    with connected(server) as client:
        client.sendall(b"".join(b'{"do": "n", "k": %d}\n' % k for k in range(500)))
        assert [reply["got"]["k"] for reply in drain(server, client, 500)] == list(range(500))
    assert server.requests == 500


def test_a_socket_can_be_claimed_before_it_is_served(tmp_path):
    server = ControlServer(tmp_path / "c.sock")
    with pytest.raises(ControlError, match="another recorder listens there"):
        ControlServer(server.path)
    with polled(server), ControlClient(server.path) as client:
        with pytest.raises(ControlError, match="not begun yet"):
            client.ask({"do": "x"})
        server.serve(echo)
        assert client.ask({"do": "x"}) == {"got": {"do": "x"}}
    server.close()


def test_a_request_may_come_in_pieces(server):
    with connected(server) as client:
        for byte in b'{"do": "x"}\n':
            client.sendall(bytes([byte]))
            server.poll()
        assert drain(server, client, 1) == [{"ok": True, "got": {"do": "x"}}]


def test_a_client_that_ends_its_side_still_hears_the_reply_even_without_a_newline(server):
    with connected(server) as client:
        client.sendall(b'{"do": "a"}\n{"do": "b"}')
        client.shutdown(socket.SHUT_WR)
        assert [reply["got"]["do"] for reply in drain(server, client, 2)] == ["a", "b"]
        polls(server, lambda: server.clients == 0)
        assert client.recv(10) == b""


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"status", "not JSON"),
        (b"[1]", "a request is a JSON object"),
        (b'"status"', "a request is a JSON object"),
        (b'{"do": NaN}', "not JSON: NaN"),
        (b"\xff\xfe\xfd", "not JSON"),
        (b"[" * 60_000, "not JSON"),
        (b"9" * 60_000, "not JSON"),
        (b'{"do": "refuse"}', "not now"),
        (b'{"do": "big", "size": 70000}', "the reply has"),
    ],
)
def test_a_bad_request_gets_an_error_and_the_connection_lives(server, line, why):
    with connected(server) as client:
        client.sendall(line + b"\n" + b'{"do": "x"}\n')
        bad, good = drain(server, client, 2)
        assert not bad["ok"]
        assert why in bad["error"]
        assert good["ok"]


def test_a_mistake_of_ours_is_told_and_ends_nothing(server):
    with connected(server) as client:
        client.sendall(b'{"do": "mistake"}\n{"do": "mistake", "nan": true}\n{"do": "x"}\n')
        first, second, third = drain(server, client, 3)
        assert "KeyError" in first["error"]
        assert "ValueError" in second["error"]
        assert third["ok"]
    told = server.take_faults()
    assert len(told) == 2
    assert all("mistake" in text for text in told)
    assert server.take_faults() == ()


@given(st.binary(max_size=400))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_whatever_comes_each_line_gets_one_line(server, data):
    wanted = sum(bool(line.strip()) for line in data.split(b"\n"))
    with connected(server) as client:
        polls(server, lambda: server.clients == 1)
        client.sendall(data)
        client.shutdown(socket.SHUT_WR)
        got = b""
        polls(server, lambda: server.clients == 0)
        while piece := client.recv(65536):
            got += piece
    assert got.count(b"\n") == wanted
    assert all("ok" in reply for reply in (replies(got) if got else []))


# -- nobody holds the recorder up ----------------------------------------------------------------


def test_a_client_that_never_reads_costs_bounded_memory_and_no_one_else_s_time(server):
    with connected(server) as mad, connected(server) as good:
        mad.setblocking(False)
        request = b'{"do": "big", "size": 9000}\n' * 100
        good.sendall(b'{"do": "x"}\n')
        heard, polled_times, worst = b"", 0, 0
        good.setblocking(False)
        while polled_times < 2000:
            with contextlib.suppress(BlockingIOError):
                mad.send(request)
            server.poll()
            polled_times += 1
            for client in server._clients.values():
                worst = max(worst, len(client.outgoing), len(client.incoming))
            with contextlib.suppress(BlockingIOError):
                heard += good.recv(4096)
        assert replies(heard) == [{"ok": True, "got": {"do": "x"}}]
        assert worst <= 2 * BUFFER + 16 * 1024
        good.sendall(b'{"do": "y"}\n')
        assert drain(server, good, 1)[0]["got"] == {"do": "y"}
        # Once it reads, it gets whole replies.
        mad.settimeout(PATIENCE_S)
        with polled(server):
            data = b""
            while data.count(b"\n") < 20:
                data += mad.recv(65536)
        whole = data[: data.rindex(b"\n") + 1]
        assert all(len(reply["text"]) == 9000 for reply in replies(whole))


def test_a_request_without_end_is_refused_and_the_client_let_go(server):
    with connected(server) as client:
        client.setblocking(False)
        data = b""
        for _ in range(1000):
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                client.send(b"x" * 8192)
            server.poll()
            if server.clients == 0 and data:
                break
            with contextlib.suppress(BlockingIOError):
                data += client.recv(4096)
        (reply,) = replies(data)
        assert "longer than 65536 bytes" in reply["error"]
        assert server.clients == 0


def test_silent_clients_make_room_for_the_next_the_longest_silent_first(server):
    silent = [connected(server) for _ in range(MAX_CLIENTS)]
    polls(server, lambda: server.clients == MAX_CLIENTS)
    for client in silent[1:]:
        client.sendall(b'{"do": "x"}\n')
        drain(server, client, 1)
    with connected(server) as late:
        late.sendall(b'{"do": "stop"}\n')
        assert drain(server, late, 1)[0]["ok"]
        assert server.clients == MAX_CLIENTS
        (told,) = replies(silent[0].recv(4096))
        assert not told["ok"]
        assert silent[0].recv(10) == b""
    for client in silent:
        client.close()
    polls(server, lambda: server.clients == 0)


def test_a_flood_is_taken_in_portions(server, monkeypatch):
    """With no budget left, one request a client and poll."""
    monkeypatch.setattr(control, "BUDGET_NS", -1)
    with connected(server) as client:
        client.sendall(b'{"do": "x"}\n' * 50)
        counts = []
        polls(server, lambda: counts.append(server.requests) or server.requests == 50)
        assert all(b - a <= 1 for a, b in pairwise(counts))
        assert len(drain(server, client, 50)) == 50


def test_clients_that_vanish_leave_nothing_behind(server):
    for k in range(200):
        client = connected(server)
        client.sendall(b'{"do": "big", "size": 60000}\n' * (1 + k % 3))
        if k % 2:
            server.poll()
        client.close()
    for _ in range(10):
        server.poll()
    polls(server, lambda: server.clients == 0)
    assert len(server._selector.get_map()) == 1


def test_without_descriptors_the_recorder_goes_on(server):
    """Clients are not served then, and that's all."""
    with connected(server) as client:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        used = max(int(entry.name) for entry in Path("/proc/self/fd").iterdir())
        resource.setrlimit(resource.RLIMIT_NOFILE, (used, hard))
        try:
            spare = []
            with contextlib.suppress(OSError):
                while True:
                    spare.append(os.dup(0))
            for _ in range(10):
                server.poll()
        finally:
            for handle in spare:
                os.close(handle)
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        client.sendall(b'{"do": "x"}\n')
        assert drain(server, client, 1)[0]["ok"]


# -- the file ------------------------------------------------------------------------------------


def test_only_its_user_can_reach_it_from_the_first_moment(tmp_path):
    path = tmp_path / "c.sock"
    seen, ended = set(), threading.Event()

    def watch():
        while not ended.is_set():
            with contextlib.suppress(FileNotFoundError):
                seen.add(stat.S_IMODE(os.lstat(path).st_mode))

    before = os.umask(0)
    thread = threading.Thread(target=watch)
    thread.start()
    try:
        for _ in range(300):
            ControlServer(path, echo).close()
            assert not path.exists()
        held = ControlServer(path, echo)
        deadline = time.monotonic() + PATIENCE_S
        while not seen and time.monotonic() < deadline:
            time.sleep(0.001)
        held.close()
    finally:
        ended.set()
        thread.join()
        assert os.umask(before) == 0, "the umask is back as it was"
    assert seen == {0o600}


def start_recorder(path, extra=""):
    """A process that serves the socket until it is killed; says 'ready' or why not."""
    code = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from capture.daemon.control import ControlServer\n"
        "from capture.errors import ControlError\n"
        f"{extra}\n"
        "try:\n"
        f"    server = ControlServer(Path({str(path)!r}), lambda request: {{}})\n"
        "except ControlError as error:\n"
        "    sys.exit(print(error, flush=True))\n"
        "print('ready', flush=True)\n"
        "while True:\n"
        "    server.poll()\n"
        "    time.sleep(0.005)\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
    )


def end(process):
    process.send_signal(signal.SIGKILL)
    process.communicate()


def test_a_second_recorder_is_refused_while_the_first_lives_and_succeeds_it_after_a_kill(tmp_path):
    path = tmp_path / "c.sock"
    first = start_recorder(path)
    try:
        assert first.stdout.readline() == "ready\n"
        with pytest.raises(ControlError, match="another recorder listens there"):
            ControlServer(path, echo)
        with ControlClient(path) as client:
            assert client.ask({"do": "x"}) == {}
    finally:
        end(first)
    assert path.is_socket(), "a killed recorder leaves its socket"
    with pytest.raises(ControlError, match="no recorder listens there"):
        ControlClient(path)
    ControlServer(path, echo).close()


@pytest.mark.slow
def test_of_many_recorders_that_find_a_stale_socket_one_gets_it(tmp_path):
    path = tmp_path / "c.sock"
    for _ in range(3):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stale:
            stale.bind(str(path))
        go = "print('up', flush=True); sys.stdin.readline()"
        racers = [start_recorder(path, go) for _ in range(6)]
        try:
            for racer in racers:
                assert racer.stdout.readline() == "up\n"
            for racer in racers:
                racer.stdin.write("go\n")
                racer.stdin.flush()
            said = [racer.stdout.readline() for racer in racers]
            assert said.count("ready\n") == 1
            assert sum("another recorder listens" in line for line in said) == 5
            with ControlClient(path) as client:
                assert client.ask({"do": "x"}) == {}
        finally:
            for racer in racers:
                end(racer)
        path.unlink()


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_what_is_no_socket_is_left_alone(tmp_path, kind):
    path = tmp_path / "c.sock"
    (tmp_path / "precious").write_text("data")
    if kind == "file":
        path.write_text("data")
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(tmp_path / "precious")
    with pytest.raises(ControlError, match="no socket"):
        ControlServer(path, echo)
    assert os.path.lexists(path)
    assert (tmp_path / "precious").read_text() == "data"


def test_an_impossible_path_is_told(tmp_path):
    with pytest.raises(ControlError, match="at most 107 bytes"):
        ControlServer(tmp_path / ("x" * 120), echo)
    with pytest.raises(ControlError, match="No such file"):
        ControlServer(tmp_path / "none" / "c.sock", echo)


def test_a_successor_s_socket_is_not_removed_by_a_late_close(tmp_path):
    path = tmp_path / "c.sock"
    first = ControlServer(path, echo)
    path.unlink()
    second = ControlServer(path, echo)
    first.close()
    with polled(second), ControlClient(path) as client:
        client.ask({"do": "x"})
    second.close()


def test_a_socket_whose_folder_went_with_a_log_out_comes_back_with_the_next_log_in(tmp_path):
    session = tmp_path / "user"
    session.mkdir()
    path = default_socket(Path("run.mcap"), {"XDG_RUNTIME_DIR": str(session)})
    server = ControlServer(path, echo)
    with connected(server) as client:
        client.sendall(b'{"do": "x"}\n')
        drain(server, client, 1)
        shutil.rmtree(session)
        for _ in range(3 * TEND_POLLS):
            server.poll()
        session.mkdir()
        polls(server, path.is_socket)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        with connected(server) as back:
            back.sendall(b'{"do": "y"}\n')
            assert drain(server, back, 1)[0]["got"] == {"do": "y"}
        client.sendall(b'{"do": "z"}\n')
        assert drain(server, client, 1)[0]["got"] == {"do": "z"}
    server.close()
    assert not path.exists()


def test_the_usual_place_and_finding_what_runs(tmp_path):
    environ = {"XDG_RUNTIME_DIR": str(tmp_path)}
    path = default_socket(Path("somewhere/run.mcap"), environ)
    assert path == tmp_path / "undulog" / "run.sock"
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    stale = path.with_name("stale.sock")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(stale))
    (path.parent / "file.sock").write_text("")
    (path.parent / "service").mkdir()
    one = ControlServer(path, echo)
    two = ControlServer(path.parent / "service" / "a.sock", echo)
    found = [p for p in find_sockets(environ) if tmp_path in p.parents]
    assert found == sorted([path, path.parent / "service" / "a.sock"])
    one.close()
    two.close()
    assert [p for p in find_sockets(environ) if tmp_path in p.parents] == []


def test_a_service_has_its_own_folder_and_no_session_uses_the_temporary_one(tmp_path, monkeypatch):
    service = {"RUNTIME_DIRECTORY": f"{tmp_path}/a:{tmp_path}/b", "XDG_RUNTIME_DIR": "/x"}
    assert socket_folder(service) == tmp_path / "a"
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    for environ in ({}, {"XDG_RUNTIME_DIR": str(tmp_path / "gone")}):
        assert socket_folder(environ) == tmp_path / f"undulog-{os.getuid()}"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_not_trusted(tmp_path):
    (tmp_path / "undulog").mkdir()
    os.chown(tmp_path / "undulog", 65534, 65534)
    with pytest.raises(ControlError, match="not a folder of this user"):
        default_socket(Path("run.mcap"), {"XDG_RUNTIME_DIR": str(tmp_path)})


# -- stop and wait -------------------------------------------------------------------------------


def test_the_reply_to_a_later_answer_comes_with_the_close(server):
    with polled(server):
        client = connected(server)
        client.sendall(b'{"do": "later"}\n{"do": "x"}\n')
        deadline = time.monotonic() + PATIENCE_S
        while not server.requests and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(0.05)
    assert server.requests == 1, "what comes after waits"
    server.close({"verdict": "good"})
    server.close({"verdict": "twice"})
    with client:
        assert replies(client.recv(4096)) == [{"ok": True, "verdict": "good"}]


def test_a_client_is_told_when_the_recorder_dies_before_it_answers(tmp_path):
    path = tmp_path / "c.sock"
    process = start_recorder(path)
    try:
        assert process.stdout.readline() == "ready\n"
        with ControlClient(path) as client:
            client.ask({"do": "x"})
            process.send_signal(signal.SIGSTOP)
            killer = threading.Timer(0.3, process.send_signal, [signal.SIGKILL])
            killer.start()
            with pytest.raises(ControlError, match="the recorder went"):
                client.ask({"do": "x"})
            killer.join()
    finally:
        end(process)


def test_a_recorder_that_hangs_is_told(tmp_path):
    server = ControlServer(tmp_path / "c.sock", echo)
    with (
        ControlClient(server.path, patience_s=0.1) as client,
        pytest.raises(ControlError, match=r"no answer in 0\.1 s"),
    ):
        client.ask({"do": "x"})
    server.close()


# -- what can be asked ---------------------------------------------------------------------------


class Actions:
    """A recorder that notes what it is told to do."""

    def __init__(self):
        self.done = []

    def status(self):
        return {"output": "run.mcap", "elapsed_s": 1.5}

    def mark(self, text):
        self.done.append(("mark", text))
        return {"file": "run_mark0001.mcap"}

    def split(self):
        raise DataError("this recording has no parts")

    def stop(self):
        self.done.append(("stop",))


@pytest.fixture
def session(tmp_path):
    """A server of a real session: path of the file, writer, actions, server, and its clock."""
    path = tmp_path / "run.mcap"
    actions, clock = Actions(), [EPOCH_NS]
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        events = writer.log()
        log = OperatorLog(
            writer,
            lambda level, who, text: events.write(clock[0], level, who, text),
            lambda: clock[0],
        )
        server = ControlServer(tmp_path / "c.sock", request_handler(actions, log))
        yield path, writer, actions, server, clock
        server.close()


def read(path, topic):
    """Log time and decoded message of each, by a foreign reader."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages([topic])
        return [(message.log_time, decoded) for _, _, message, decoded in found]


def test_a_controller_s_gait_is_in_the_session_as_it_was_said(session):
    path, writer, _, server, clock = session
    said = []
    with polled(server, pause_s=0), ControlClient(server.path) as client:
        for k in range(1000):
            clock[0] = EPOCH_NS + k * 10_000_000
            values = {"horizontal.phase": 0.1 * k, "horizontal.A": 0.4 + k / 7}
            t_ns = clock[0] - 3_000_001 if k % 2 else None
            request = {"do": "gait", "values": values}
            assert client.ask(request if t_ns is None else {**request, "t_ns": t_ns}) == {}
            said.append((clock[0], t_ns or clock[0], values))
    writer.close()
    found = read(path, "/gait")
    assert len(found) == 1000
    for (log_ns, t_ns, values), (found_ns, state) in zip(said, found, strict=True):
        assert dict(zip(state.name, state.position, strict=True)) == values
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == t_ns
        assert found_ns == log_ns
    assert list(found[0][1].name) == ["horizontal.A", "horizontal.phase"]


def test_notes_marks_and_modes_are_in_the_session(session):
    path, writer, actions, server, clock = session
    with polled(server), ControlClient(server.path) as client:
        assert client.ask({"do": "status"}) == {"output": "run.mcap", "elapsed_s": 1.5}
        client.ask({"do": "note", "text": "wet sand"})
        assert client.ask({"do": "mark", "text": "slipped", "level": "warn"}) == {
            "file": "run_mark0001.mcap"
        }
        client.ask({"do": "mark"})
        client.ask({"do": "mode", "text": "walk"})
        clock[0] += 7
        client.ask({"do": "mode", "text": "avoid"})
        client.ask({"do": "stop"})
    writer.close()
    events = [(event.name, event.level, event.msg) for _, event in read(path, "/rosout")]
    assert events == [
        (OPERATOR, 20, "wet sand"),
        (OPERATOR, 30, "mark: slipped"),
        (OPERATOR, 20, "mark"),
    ]
    modes = [(log_ns, mode.data) for log_ns, mode in read(path, "/gait/mode")]
    assert modes == [(EPOCH_NS, "walk"), (EPOCH_NS + 7, "avoid")]
    assert actions.done == [("mark", "slipped"), ("mark", ""), ("stop",)]


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        ({}, "do: found nothing; valid: status, mark"),
        ({"do": "spilt"}, "did you mean split?"),
        ({"do": ["stop"]}, "do: found"),
        ({"do": "status", "json": True}, "json: found true; valid: status has none"),
        ({"do": "mark", "txt": "x"}, "did you mean text?"),
        ({"do": "split"}, "this recording has no parts"),
        ({"do": "stop", "wait": 1}, "wait: found 1; valid: true or false"),
        ({"do": "note"}, "text: found nothing"),
        ({"do": "note", "text": " "}, "not empty"),
        ({"do": "note", "text": "x" * 5000}, "at most 4096"),
        ({"do": "note", "text": "\0"}, "text: found"),
        ({"do": "note", "text": "\ud800"}, "text: found"),
        ({"do": "mode", "text": "\udfff"}, "text: found"),
        ({"do": "note", "text": "x", "level": "loud"}, "level: found"),
        ({"do": "gait"}, "values: found nothing"),
        ({"do": "gait", "values": {}}, "values: found a table"),
        ({"do": "gait", "values": {"vertical.omegas": 1}}, "did you mean vertical.omega?"),
        ({"do": "gait", "values": {"horizontal.A": "1"}}, "values.horizontal.A: found"),
        ({"do": "gait", "values": {"horizontal.A": True}}, "a finite number"),
        ({"do": "gait", "values": {"horizontal.A": 10**400}}, "a finite number"),
        ({"do": "gait", "values": {"horizontal.A": 1}, "t_ns": 1.5}, "t_ns: found 1.5"),
        ({"do": "gait", "values": {"horizontal.A": 1}, "t_ns": 5}, "off this recorder's clock"),
        ({"do": "gait", "values": {"horizontal.A": 1}, "t_ns": -(10**30)}, "off this recorder"),
    ],
)
def test_a_wrong_request_says_what_would_be_right(session, request_, why):
    path, writer, actions, server, _ = session
    with polled(server), ControlClient(server.path) as client:
        with pytest.raises(ControlError) as refused:
            client.ask(request_)
        assert why in str(refused.value)
        client.ask({"do": "status"})
    writer.close()
    assert actions.done == []
    assert [*read(path, "/rosout"), *read(path, "/gait"), *read(path, "/gait/mode")] == []


def test_an_infinite_number_is_no_gait(session):
    *_, server, _ = session
    with connected(server) as client:
        client.sendall(b'{"do": "gait", "values": {"horizontal.A": 1e999}}\n')
        (reply,) = drain(server, client, 1)
        assert "a finite number" in reply["error"]


def test_other_names_than_at_first_are_refused_and_the_first_go_on(session):
    path, writer, _, server, _ = session
    with polled(server), ControlClient(server.path) as client:
        client.ask({"do": "gait", "values": {"horizontal.A": 1.0}})
        with pytest.raises(ControlError, match="the names that this session's gait began with"):
            client.ask({"do": "gait", "values": {"horizontal.A": 1.0, "vertical.A": 2.0}})
        client.ask({"do": "gait", "values": {"horizontal.A": 3.0}})
    writer.close()
    assert [state.position[0] for _, state in read(path, "/gait")] == [1.0, 3.0]


def test_a_gait_that_a_source_writes_is_not_taken_from_outside(session):
    _, writer, _, server, _ = session
    writer.joint_state("/gait", ["horizontal.A"], unit="rad")
    with (
        polled(server),
        ControlClient(server.path) as client,
        pytest.raises(ControlError, match="/gait is open already"),
    ):
        client.ask({"do": "gait", "values": {"horizontal.A": 1.0}})
