"""The recorder as a user without rights, and beside other users in a shared folder."""

import json
import os
import signal
import socket
import stat

import pytest

from support.paths import ROOT
from support.processes import UNDULOG, process, run, start, wait_for
from support.read_back import messages_of
from support.users import NOBODY, as_nobody, as_other, environment
from undulog.capture.common.errors import ControlError, LogWriteError
from undulog.capture.log.wal.writer import WriteAheadLog
from undulog.capture.log.write.durable_sink import DurableSink
from undulog.capture.recorder import control_client
from undulog.capture.recorder.live_feed import LiveFeed


@pytest.fixture
def shared(tmp_path):
    """A folder in which everybody may make files, but remove only their own; of nobody's here."""
    as_nobody()
    place = tmp_path / "shared"
    place.mkdir()
    place.chmod(0o1777)
    for parent in (tmp_path, *tmp_path.parents[:2]):
        parent.chmod(parent.stat().st_mode | 0o055)
    return place


@pytest.mark.slow
def test_nobody_records_marks_asks_and_stops(shared):
    options = {"cwd": shared, "env": environment(shared, PYTHONPATH=str(ROOT))}
    words = (*as_nobody(), *UNDULOG, "record")

    def ask(*more):
        return run(*words, *more, **options)

    recording = ("unix:a.sock", "--ring", "30s", "--floor", "0", "-o", "run.mcap", "--quiet")
    with process(*words, *recording, **options) as running:
        wait_for((shared / f"undulog-{NOBODY}" / "run.sock").exists, alive=[running])
        wait_for(lambda: not ask("status").returncode, "the recorder", alive=[running])
        assert "ring" not in ask("mark", "slipped").stderr
        report = json.loads(ask("stop", "--wait", "--json").stdout)
    (mark,) = report["files"]
    assert (shared / mark).stat().st_uid == NOBODY
    messages_of(shared / mark)
    assert stat.S_IMODE((shared / f"undulog-{NOBODY}").stat().st_mode) == 0o700
    done = ask("unit", "--install")
    assert (done.returncode, done.stdout) == (1, "")
    assert "no right to write; sudo" in done.stderr
    closed = shared / "closed"
    closed.mkdir()
    done = ask("unix:b.sock", "--floor", "0", "-o", closed / "run.mcap")
    assert (done.returncode, done.stdout) == (1, "")
    assert "can't be created: Permission denied" in done.stderr
    assert list(closed.iterdir()) == []


PLANT_FOLDER = """
import os, socket, sys
folder = sys.argv[1]
os.mkdir(folder)
listener = socket.socket(socket.AF_UNIX)
listener.bind(folder + "/run.sock")
listener.listen()
print("ready", flush=True)
sys.stdin.read()
"""


def test_the_folder_of_sockets_that_another_user_made_is_not_used(shared, monkeypatch):
    for name in ("XDG_RUNTIME_DIR", "RUNTIME_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(control_client.tempfile, "gettempdir", lambda: str(shared))
    folder = shared / f"undulog-{os.getuid()}"
    with process(*as_other(PLANT_FOLDER, folder), stdin=-1) as other:
        assert other.stdout.readline() == "ready\n"
        assert folder / "run.sock" not in control_client.find_sockets(os.environ)
        with pytest.raises(ControlError, match="not a folder of this user"):
            control_client.default_sockets(shared / "run.mcap", os.environ)


def test_a_link_in_the_place_of_the_folder_of_sockets_is_not_followed(shared, monkeypatch):
    victim = shared / "victim"
    victim.mkdir()
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setattr(control_client.tempfile, "gettempdir", lambda: str(shared))
    (shared / f"undulog-{os.getuid()}").symlink_to(victim)
    with pytest.raises(ControlError, match="not a folder of this user"):
        control_client.default_sockets(shared / "run.mcap", os.environ)
    assert list(victim.iterdir()) == []


BIND = """
import socket, sys
inbox = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
inbox.bind(sys.argv[1])
inbox.setblocking(False)
__import__("os").chmod(sys.argv[1], 0o777)
print("ready", flush=True)
sys.stdin.readline()
try:
    print(len(inbox.recv(65536)), flush=True)
except BlockingIOError:
    print("nothing", flush=True)
"""


def test_a_live_feed_sends_nothing_to_another_users_socket(shared):
    path = shared / "run.live"
    with process(*as_other(BIND, path), stdin=-1) as other:
        assert other.stdout.readline() == "ready\n"
        feed = LiveFeed(path)
        feed.pump()
        assert not feed.connected
        out, _ = other.communicate("look\n", timeout=60)
        assert out == "nothing\n"
    path.unlink()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(path))
        feed = LiveFeed(path)
        feed.pump()
        assert feed.connected
        feed.close()


PLANT_LOG = """
import os, sys
os.umask(0)
os.mkdir(sys.argv[1])
for name in ("ballast", "recorder.lock", "000001.seg"):
    os.symlink(sys.argv[2], sys.argv[1] + "/" + name)
"""


def test_a_write_ahead_log_that_another_user_planted_is_refused(shared):
    victim = shared / "victim"
    victim.write_text("precious")
    run(*as_other(PLANT_LOG, shared / "run.mcap.wal", victim), code=0)
    with pytest.raises(LogWriteError, match="is another user's"):
        DurableSink(shared / "run.mcap")
    assert victim.read_text() == "precious"


@pytest.mark.parametrize("name", ["ballast", "recorder.lock", "000001.seg", ""])
def test_no_link_in_a_write_ahead_log_is_followed(name, tmp_path):
    victim, folder = tmp_path / "victim", tmp_path / "run.mcap.wal"
    victim.write_text("precious")
    if name:
        folder.mkdir()
        (folder / name).symlink_to(victim)
    else:
        folder.symlink_to(tmp_path)
    if name in ("recorder.lock", ""):
        with pytest.raises(LogWriteError, match=r"(?i)symbolic link"):
            DurableSink(tmp_path / "run.mcap", force=True)
    else:  # it is replaced
        DurableSink(tmp_path / "run.mcap", force=True).close(())
    assert victim.read_text() == "precious"


@pytest.mark.parametrize("name", ["run.mcap", "run.mcap.part"])
def test_no_link_in_the_place_of_a_session_is_followed(name, tmp_path):
    victim = tmp_path / "victim"
    (tmp_path / name).symlink_to(victim)
    with pytest.raises(FileExistsError):
        DurableSink(tmp_path / "run.mcap")
    assert not victim.exists()
    DurableSink(tmp_path / "run.mcap", force=True).close(())
    assert not victim.exists()
    assert not (tmp_path / "run.mcap").is_symlink()


def test_the_log_of_the_folders_own_user_may_be_replaced_by_root(shared):
    folder = shared / "own"
    folder.mkdir()
    os.chown(folder, NOBODY, NOBODY)
    (folder / "run.mcap.wal").mkdir()
    os.chown(folder / "run.mcap.wal", NOBODY, NOBODY)
    with WriteAheadLog(folder / "run.mcap.wal") as log:
        log.release(0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "force",
    [(), ("--force",), *(pytest.param(f, marks=pytest.mark.nightly) for f in ((), ("--force",)))],
)
def test_of_recorders_that_are_given_one_output_at_once_one_records(force, tmp_path):
    output, names = tmp_path / "run.mcap", ("a", "b", "c")
    controls = [tmp_path / f"{name}.control" for name in names]
    recorders = [
        start(
            *(*UNDULOG, "record", f"unix:{tmp_path / name}.sock", *force, "--floor", "0"),
            *("--quiet", "--socket", control, "-o", output),
            cwd=ROOT,
        )
        for name, control in zip(names, controls, strict=True)
    ]
    wait_for(lambda: sum(recorder.poll() is not None for recorder in recorders) >= 2, "the others")
    wait_for(lambda: any(control.exists() for control in controls), "the one that records")
    for recorder in recorders:
        if recorder.poll() is None:
            recorder.send_signal(signal.SIGTERM)
    texts = sorted(recorder.communicate()[1] for recorder in recorders)
    refusals = "exists already", "another recorder is writing it"
    refused = [text for text in texts if any(words in text for words in refusals)]
    (recorded,) = [text for text in texts if text not in refused]
    assert "was never connected: " in recorded
    assert "Traceback" not in "".join(texts)
    assert len(messages_of(output)) > 0
    assert [path.name for path in tmp_path.glob("run*")] == ["run.mcap"]
