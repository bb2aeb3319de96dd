"""The control socket's file: whose it is, who may take it over, and where it is found."""

import contextlib
import os
import shutil
import socket
import stat
import threading
from pathlib import Path

import pytest

from support.control_clients import connected, drain, echo, polled, polls, started_recorder
from support.processes import repeating, wait_for
from undulog.capture.common.errors import ControlError
from undulog.capture.recorder import control_client
from undulog.capture.recorder.control import TEND_POLLS, ControlServer

# -- the file ------------------------------------------------------------------------------------


def test_only_its_user_can_reach_it_from_the_first_moment(tmp_path):
    path = tmp_path / "c.sock"
    seen = set()

    def look():
        with contextlib.suppress(FileNotFoundError):
            seen.add(stat.S_IMODE(os.lstat(path).st_mode))

    before = os.umask(0)
    try:
        with repeating(look, 0):
            for _ in range(300):
                ControlServer(path, echo).close()
                assert not path.exists()
            held = ControlServer(path, echo)
            wait_for(lambda: seen)
            held.close()
    finally:
        assert os.umask(before) == 0, "the umask is back as it was"
    assert seen == {0o600}


def test_a_second_recorder_is_refused_while_the_first_lives_and_succeeds_it_after_a_kill(tmp_path):
    path = tmp_path / "c.sock"
    with started_recorder(path):
        with pytest.raises(ControlError, match="another recorder listens there"):
            ControlServer(path, echo)
        with control_client.ControlClient(path) as client:
            assert client.ask({"do": "x"}) == {}
    assert path.is_socket(), "a killed recorder leaves its socket"
    with pytest.raises(ControlError, match="no recorder listens there"):
        control_client.ControlClient(path)
    ControlServer(path, echo).close()


@pytest.mark.slow
def test_of_many_recorders_that_find_a_stale_socket_one_gets_it(tmp_path):
    path = tmp_path / "c.sock"
    for _ in range(3):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stale:
            stale.bind(str(path))
        go = "print('up', flush=True); sys.stdin.readline()"
        with contextlib.ExitStack() as started:
            racers = [started.enter_context(started_recorder(path, go, "up\n")) for _ in range(6)]
            for racer in racers:
                racer.stdin.write("go\n")
                racer.stdin.flush()
            lines = [racer.stdout.readline() for racer in racers]
            assert lines.count("ready\n") == 1
            assert sum("another recorder listens" in line for line in lines) == 5
            with control_client.ControlClient(path) as client:
                assert client.ask({"do": "x"}) == {}
        path.unlink()


MAKERS = {
    "file": lambda path: path.write_text("data"),
    "folder": Path.mkdir,
    "link": lambda path: path.symlink_to(path.with_name("precious")),
}


@pytest.mark.parametrize("kind", MAKERS)
def test_what_is_no_socket_is_left_alone(tmp_path, kind):
    path = tmp_path / "c.sock"
    (tmp_path / "precious").write_text("data")
    MAKERS[kind](path)
    with pytest.raises(ControlError, match="no socket"):
        ControlServer(path, echo)
    assert os.path.lexists(path)
    assert (tmp_path / "precious").read_text() == "data"


def test_an_impossible_path_is_reported(tmp_path):
    with pytest.raises(ControlError, match="at most 107 bytes"):
        ControlServer(tmp_path / ("x" * 120), echo)
    with pytest.raises(ControlError, match="No such file"):
        ControlServer(tmp_path / "none" / "c.sock", echo)


def test_the_longest_path_is_served(tmp_path):
    for name in ("x", "x" * (107 - len(str(tmp_path)) - 1)):
        server = ControlServer(tmp_path / name, echo)
        with polled(server), control_client.ControlClient(tmp_path / name) as client:
            client.ask({"do": "x"})
        server.close()
    assert list(tmp_path.iterdir()) == []


def test_whoever_sees_the_file_can_connect(tmp_path):
    paths = [tmp_path / f"{number}.sock" for number in range(200)]
    results = []

    def connect_at_once():
        for path in paths:
            while not path.exists():
                pass
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
                results.append(caller.connect_ex(str(path)))

    thread = threading.Thread(target=connect_at_once)
    thread.start()
    made = [(path, *control_client.listen(path, backlog=8)) for path in paths]
    thread.join()
    for claim in made:
        control_client.release(*claim)
    assert results == [0] * len(paths)


def test_a_successor_s_socket_is_not_removed_by_a_late_close(tmp_path):
    path = tmp_path / "c.sock"
    first = ControlServer(path, echo)
    path.unlink()
    second = ControlServer(path, echo)
    first.close()
    with polled(second), control_client.ControlClient(path) as client:
        client.ask({"do": "x"})
    second.close()
    third = ControlServer(path, echo)  # perhaps of the same inode
    second.close()
    assert path.is_socket()
    third.close()


def test_a_socket_whose_folder_went_with_a_log_out_comes_back_with_the_next_log_in(tmp_path):
    session = tmp_path / "user"
    session.mkdir()
    path, _ = control_client.default_sockets(Path("run.mcap"), {"XDG_RUNTIME_DIR": str(session)})
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
    path, _ = control_client.default_sockets(Path("somewhere/run.mcap"), environ)
    assert path == tmp_path / "undulog" / "run.sock"
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    stale = path.with_name("stale.sock")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(stale))
    (path.parent / "file.sock").write_text("")
    (path.parent / "service").mkdir()
    server = ControlServer(path, echo)
    two = ControlServer(path.parent / "service" / "a.sock", echo)
    paths = [p for p in control_client.find_sockets(environ) if tmp_path in p.parents]
    assert paths == sorted([path, path.parent / "service" / "a.sock"])
    server.close()
    two.close()
    assert [p for p in control_client.find_sockets(environ) if tmp_path in p.parents] == []


def test_a_service_has_its_own_folder_and_no_session_uses_the_temporary_one(tmp_path, monkeypatch):
    service = {"RUNTIME_DIRECTORY": f"{tmp_path}/a:{tmp_path}/b", "XDG_RUNTIME_DIR": "/x"}
    assert control_client.socket_folder(service) == tmp_path / "a"
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    for environ in ({}, {"XDG_RUNTIME_DIR": str(tmp_path / "gone")}):
        assert control_client.socket_folder(environ) == tmp_path / f"undulog-{os.getuid()}"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_not_trusted(tmp_path):
    (tmp_path / "undulog").mkdir()
    os.chown(tmp_path / "undulog", 65534, 65534)
    with pytest.raises(ControlError, match="not a folder of this user"):
        control_client.default_sockets(Path("run.mcap"), {"XDG_RUNTIME_DIR": str(tmp_path)})
