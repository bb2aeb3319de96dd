"""The commands that speak to a running recorder: real recorders, real command lines."""

import contextlib
import functools
import json
import os
import signal
import sys

import pytest

from support import processes
from support.processes import UNDULOG, python, wait_for
from support.read_back import decoded_of
from support.recorders import connected_sender, sockets_of
from undulog.capture.recorder.control_client import ControlClient, find_sockets

PATIENCE_S = 60.0


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder where this test's recorders, and nobody else's, are found."""
    runtime = tmp_path / "r"
    runtime.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setattr("undulog.capture.recorder.control_client._SYSTEM_FOLDER", tmp_path / "none")
    return tmp_path


@pytest.fixture
def recorder(place):
    """Starts recorders of a source with one silent sender, and waits until they can be asked."""
    with contextlib.ExitStack() as started:

        def start(name, *options):
            running = len(find_sockets(os.environ))
            words = (f"unix:{place}/{name}.frames", "-o", place / f"{name}.mcap", "--quiet")
            process = started.enter_context(processes.process(*UNDULOG, "record", *words, *options))
            wait_for(lambda: len(find_sockets(os.environ)) > running, alive=[process])
            started.enter_context(connected_sender(place / f"{name}.frames"))
            return process

        yield start


@pytest.fixture
def ask(place, command):
    """Runs ``undulog record`` with some words to its exit code; returns output and errors."""
    return functools.partial(command, "record")


def decoded(path, topic):
    """Messages by a foreign reader."""
    return [content for *_, content in decoded_of(path, [topic])]


def events(path):
    """Name, level and text of what is on /rosout."""
    return [(event.name, event.level, event.msg) for event in decoded(path, "/rosout")]


def test_without_a_recorder_there_is_nobody_to_ask(place, ask):
    for words in (["status"], ["mark"], ["split"], ["stop"], ["note", "x"]):
        out, err = ask(*words, code=1)
        assert out == ""
        assert "no recorder runs here" in err
    err = ask("stop", "--socket", place / "none.sock", code=1).err
    assert "none.sock: no recorder listens there" in err


def test_a_recording_from_status_to_stop(recorder, place, ask, opened):
    process = recorder("run", "--operator", "Ada")
    assert ask("status").out.startswith(f"{place}/run.mcap: recording, ")
    (status,) = json.loads(ask("status", "--json").out)["recordings"]
    assert status["output"] == f"{place}/run.mcap"
    assert status["socket"] == f"{place}/r/undulog/run.sock"
    assert ask("mark", "slipped", "on", "sand") == ("marked\n", "")
    assert ask("note", "--level", "warn", "battery changed") == ("noted\n", "")
    assert json.loads(ask("split", "--json").out)["part"] == 2
    first, second = place / "run.mcap", place / "run_0002.mcap"
    assert ask("stop", "--wait").out.startswith(f"{first}, {second}: ")
    # The command ends only when the files are whole.
    assert ("operator", 20, "mark: slipped on sand") in events(first)
    assert ("operator", 30, "battery changed") in events(first)
    events(second)
    assert opened(first).metadata["undulog"]["operator"] == "Ada"
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert find_sockets(os.environ) == []


@pytest.mark.slow
def test_of_several_recorders_one_must_be_named(recorder, place, ask):
    first, second = recorder("one"), recorder("two")
    out = ask("status").out
    assert out.index("one.mcap") < out.index("two.mcap")
    err = ask("mark", "x", code=2).err
    assert "2 recorders run; which one?" in err
    assert f"--socket {place}/r/undulog/two.sock" in err
    ask("stop", "--wait", "--socket", f"{place}/r/undulog/two.sock")
    second.communicate(timeout=PATIENCE_S)
    out = ask("status").out
    assert "one.mcap" in out
    assert "two.mcap" not in out
    assert first.poll() is None
    assert ask("stop") == ("stopping\n", "")  # without --wait at once
    first.communicate(timeout=PATIENCE_S)
    assert (first.returncode, second.returncode) == (0, 0)


@pytest.mark.slow
def test_a_recorder_that_is_killed_while_we_wait_is_reported(recorder):
    process = recorder("run")
    process.send_signal(signal.SIGSTOP)
    waiting = processes.start(*UNDULOG, "record", "stop", "--wait")
    wait_for(lambda: sockets_of(waiting.pid), "its question")
    assert waiting.poll() is None, "it waits, however long the recorder hangs"
    process.kill()
    _, err = waiting.communicate(timeout=PATIENCE_S)
    assert waiting.returncode == 1
    assert "run.sock: " in err


def test_a_second_recording_at_that_socket_is_refused_and_leaves_nothing(recorder, place, ask):
    recorder("run")
    (place / "b").mkdir()
    socket = place / "r" / "undulog" / "run.sock"
    words = (f"unix:{place}/b.frames", "-o", place / "b" / "run.mcap", "--socket", socket)
    fault = "another recorder listens there; end it, or name another with --socket"
    assert fault in ask(*words, code=1).err
    assert list((place / "b").iterdir()) == []
    with ControlClient(socket) as client:
        assert client.ask({"do": "status"})["output"] == f"{place}/run.mcap"


@pytest.mark.slow
def test_a_controller_in_another_process_sends_its_gait_for_a_while(recorder, place, ask):
    """Two seconds of a 100 Hz controller, as fast as it is answered."""
    process = recorder("run")
    controller = (
        "import sys, math\n"
        "from pathlib import Path\n"
        "from undulog.capture.recorder.control_client import ControlClient\n"
        "with ControlClient(Path(sys.argv[1])) as recorder:\n"
        "    for k in range(200):\n"
        "        values = {'horizontal.A': 0.4, 'horizontal.phase': math.pi * k / 100}\n"
        "        recorder.ask({'do': 'gait', 'values': values})\n"
    )
    assert python(controller, place / "r" / "undulog" / "run.sock").returncode == 0
    ask("stop", "--wait")
    process.communicate(timeout=PATIENCE_S)
    messages = decoded(place / "run.mcap", "/gait")
    assert len(messages) == 200
    assert messages[50].position[1] == pytest.approx(1.5707963267948966, rel=1e-15)


def test_a_ring_is_written_when_marked(recorder, place, ask):
    process, first = recorder("run", "--ring", "20s"), place / "run_mark0001.mcap"
    assert json.loads(ask("mark", "--json", "slipped").out)["file"] == str(first)
    assert "a ring has no parts" in ask("split", code=1).err
    ask("note", "later")
    ask("mark")
    ask("stop", "--wait")
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert not (place / "run.mcap").exists()
    assert ("operator", 20, "mark: slipped") in events(first)
    assert ("operator", 20, "later") not in events(first)
    assert ("operator", 20, "later") in events(place / "run_mark0002.mcap")


def test_a_note_needs_a_text(ask):
    assert "a note needs a text" in ask("note", code=2).err


def test_the_unit_is_printed_with_this_installation_s_command(ask):
    start = f"ExecStart={sys.prefix}/bin/undulog record --settings /etc/undulog/%i.toml"
    assert start in ask("unit").out


def test_the_unit_is_installed_once(tmp_path, ask):
    printed = ask("unit").out
    install = ("unit", "--install", "--folder", tmp_path)
    path = tmp_path / "undulog-record@.service"
    assert "systemctl enable --now undulog-record@NAME" in ask(*install).out
    assert path.read_text() == printed
    assert path.stat().st_mode & 0o777 == 0o644
    path.write_text("changed here")
    assert str(path) in ask(*install, code=2).err
    assert path.read_text() == "changed here"
    ask(*install, "--force")
    assert path.read_text() == printed
    assert not list(tmp_path.glob("*.part"))


def test_a_unit_that_cant_be_written_is_an_error(tmp_path, ask):
    nowhere = tmp_path / "nowhere"
    assert str(nowhere) in ask("unit", "--install", "--folder", nowhere, code=2).err


@pytest.mark.slow
def test_two_outputs_of_one_name_in_two_folders(recorder, place, ask):
    started = []
    for folder in ("a", "b"):
        (place / folder).mkdir()
        started.append(recorder(f"{folder}/run", "--floor", "0"))
    recordings = json.loads(ask("status", "--json").out)["recordings"]
    sockets = {recording["output"]: recording["socket"] for recording in recordings}
    assert set(sockets) == {str(place / folder / "run.mcap") for folder in ("a", "b")}
    assert f"{place}/r/undulog/run.sock" in sockets.values()
    for socket in sockets.values():
        ask("stop", "--wait", "--socket", socket)
    assert [process.wait(PATIENCE_S) for process in started] == [0, 0]
