"""The commands that speak to a running recorder: real recorders, real command lines."""

import contextlib
import json
import os
import signal
import subprocess
import sys

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import undulog
from support import processes
from support.processes import UNDULOG, python, wait_for
from support.processes import undulog as undulog_command
from undulog.capture import Session
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
    """Starts recorders of a source that nobody feeds, and waits until they can be asked."""
    with contextlib.ExitStack() as started:

        def start(name, *options):
            running = len(find_sockets(os.environ))
            words = (f"unix:{place}/{name}.frames", "-o", place / f"{name}.mcap", "--quiet")
            process = started.enter_context(processes.process(*UNDULOG, "record", *words, *options))
            wait_for(lambda: len(find_sockets(os.environ)) > running, alive=[process])
            return process

        yield start


def said(capsys, *words):
    """Exit code and output of a command."""
    code = undulog.run(["record", *words])
    out, err = capsys.readouterr()
    return code, out, err


def decoded(path, topic):
    """Messages by a foreign reader."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [message for *_, message in reader.iter_decoded_messages([topic])]


def events(path):
    """Who said what on /rosout."""
    return [(event.name, event.level, event.msg) for event in decoded(path, "/rosout")]


def test_without_a_recorder_there_is_nobody_to_ask(place, capsys):
    for words in (["status"], ["mark"], ["split"], ["stop"], ["note", "x"]):
        code, out, err = said(capsys, *words)
        assert (code, out) == (1, "")
        assert "no recorder runs here" in err
    code, _, err = said(capsys, "stop", "--socket", str(place / "none.sock"))
    assert code == 1
    assert "none.sock: no recorder listens there" in err


def test_a_recording_from_status_to_stop(recorder, place, capsys):
    process = recorder("run", "--operator", "Ada")
    code, out, _ = said(capsys, "status")
    assert code == 0
    assert out.startswith(f"{place}/run.mcap: recording, ")
    code, out, _ = said(capsys, "status", "--json")
    (status,) = json.loads(out)["recordings"]
    assert status["output"] == f"{place}/run.mcap"
    assert status["socket"] == f"{place}/r/undulog/run.sock"
    assert said(capsys, "mark", "slipped", "on", "sand") == (0, "marked\n", "")
    assert said(capsys, "note", "--level", "warn", "battery changed") == (0, "noted\n", "")
    code, out, _ = said(capsys, "split", "--json")
    assert json.loads(out)["part"] == 2
    code, out, _ = said(capsys, "stop", "--wait")
    assert code == 0
    first, second = place / "run.mcap", place / "run_0002.mcap"
    assert out.startswith(f"{first}, {second}: ")
    # It was told only when the files were whole.
    assert ("operator", 20, "mark: slipped on sand") in events(first)
    assert ("operator", 30, "battery changed") in events(first)
    events(second)
    with Session.open(first) as session:
        assert session.metadata["undulog"]["operator"] == "Ada"
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert find_sockets(os.environ) == []


def test_of_several_recorders_one_must_be_named(recorder, place, capsys):
    first, second = recorder("one"), recorder("two")
    code, out, _ = said(capsys, "status")
    assert code == 0
    assert out.index("one.mcap") < out.index("two.mcap")
    code, _, err = said(capsys, "mark", "x")
    assert code == 2
    assert "2 recorders run; which one?" in err
    assert f"--socket {place}/r/undulog/two.sock" in err
    code, *_ = said(capsys, "stop", "--wait", "--socket", f"{place}/r/undulog/two.sock")
    assert code == 0
    second.communicate(timeout=PATIENCE_S)
    code, out, _ = said(capsys, "status")
    assert "one.mcap" in out
    assert "two.mcap" not in out
    assert first.poll() is None
    assert said(capsys, "stop") == (0, "stopping\n", "")  # without --wait at once
    first.communicate(timeout=PATIENCE_S)
    assert (first.returncode, second.returncode) == (0, 0)


def test_a_recorder_that_is_killed_while_we_wait_is_told(recorder, capsys):
    process = recorder("run")
    process.send_signal(signal.SIGSTOP)
    waiting = processes.start(*UNDULOG, "record", "stop", "--wait")
    with contextlib.suppress(subprocess.TimeoutExpired):
        waiting.wait(1.0)
    assert waiting.poll() is None, "it waits, however long the recorder hangs"
    process.kill()
    _, err = waiting.communicate(timeout=PATIENCE_S)
    assert waiting.returncode == 1
    assert "run.sock: " in err


def test_a_second_recording_at_that_socket_is_refused_and_leaves_nothing(recorder, place):
    recorder("run")
    (place / "b").mkdir()
    socket = place / "r" / "undulog" / "run.sock"
    words = (f"unix:{place}/b.frames", "-o", place / "b" / "run.mcap", "--socket", socket)
    done = undulog_command("record", *words)
    assert done.returncode == 1
    assert "another recorder listens there; end it, or name another with --socket" in done.stderr
    assert list((place / "b").iterdir()) == []
    with ControlClient(socket) as client:
        assert client.ask({"do": "status"})["output"] == f"{place}/run.mcap"


def test_a_controller_in_another_process_tells_its_gait_for_a_while(recorder, place, capsys):
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
    assert said(capsys, "stop", "--wait")[0] == 0
    process.communicate(timeout=PATIENCE_S)
    found = decoded(place / "run.mcap", "/gait")
    assert len(found) == 200
    assert found[50].position[1] == pytest.approx(1.5707963267948966, rel=1e-15)


def test_a_ring_is_written_when_marked(recorder, place, capsys):
    process = recorder("run", "--ring", "20s")
    code, out, _ = said(capsys, "mark", "--json", "slipped")
    assert code == 0
    first = place / "run_mark0001.mcap"
    assert json.loads(out)["file"] == str(first)
    code, _, err = said(capsys, "split")
    assert code == 1
    assert "a ring has no parts" in err
    said(capsys, "note", "later")
    assert said(capsys, "mark")[0] == 0
    assert said(capsys, "stop", "--wait")[0] == 0
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert not (place / "run.mcap").exists()
    assert ("operator", 20, "mark: slipped") in events(first)
    assert ("operator", 20, "later") not in events(first)
    assert ("operator", 20, "later") in events(place / "run_mark0002.mcap")


def test_a_note_needs_a_text(place, capsys):
    code, _, err = said(capsys, "note")
    assert code == 2
    assert "a note needs a text" in err


def test_the_unit_is_printed_with_this_installation_s_command(place, capsys):
    code, out, _ = said(capsys, "unit")
    assert code == 0
    assert f"ExecStart={sys.prefix}/bin/undulog record --settings /etc/undulog/%i.toml" in out


def test_two_outputs_of_one_name_in_two_folders(recorder, place, capsys):
    started = []
    for folder in ("a", "b"):
        (place / folder).mkdir()
        started.append(recorder(f"{folder}/run", "--floor", "0"))
    _, out, _ = said(capsys, "status", "--json")
    found = {each["output"]: each["socket"] for each in json.loads(out)["recordings"]}
    assert set(found) == {str(place / folder / "run.mcap") for folder in ("a", "b")}
    assert f"{place}/r/undulog/run.sock" in found.values()
    for socket in found.values():
        assert said(capsys, "stop", "--wait", "--socket", socket)[0] == 0
    assert [process.wait(PATIENCE_S) for process in started] == [0, 0]
