"""Command ``view`` as it is used: files, errors, and a server that only this machine reaches."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support.processes import listening, served_page, wait_for
from undulog.replay.viewer.viewer import viewer_binary


def test_save_writes_a_recording_and_reports_it(session_file, tmp_path, view, snake25):
    path = tmp_path / "made.rrd"
    path.write_bytes(b"mine")
    code, _, err = view(session_file, "--save", path)
    assert (code, path.read_bytes()) == (2, b"mine")
    assert "--force" in err
    code, out, _ = view(session_file, "--save", path, "--force")
    assert code == 0
    assert out.startswith(f"{path}: 3.0 s, ")
    assert path.stat().st_size > 100_000
    code, out, _ = view(session_file, "--save", path, "--force", "--json")
    told = json.loads(out)
    assert code == 0
    assert (told["path"], told["bytes"]) == (str(path), path.stat().st_size)
    assert told["joints"] == list(snake25.joint_names)
    assert told["body"] is True


def test_a_session_without_a_gait_is_shown_all_the_same(write, tmp_path, view):
    session = write(tmp_path / "a.mcap", robot=False, gait=False, odometry=False)
    code, out, _ = view(session, "--save", tmp_path / "a.rrd")
    assert code == 0
    assert "no robot description" in out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--save", "made.mcap"], ".rrd"),
        (["--save", "made.rrd", "--web"], "give one of them"),
        (["--json"], "--save"),
    ],
)
def test_wrong_usage_is_explained(session_file, view, arguments, complaint):
    code, _, err = view(session_file, *arguments)
    assert code == 2
    assert complaint in err


def test_without_a_display_the_way_out_is_named(session_file, view, monkeypatch):
    if not sys.platform.startswith("linux"):
        pytest.skip("only on Linux can a display be told to be missing")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    code, _, err = view(session_file)
    assert code == 2
    assert "--save" in err
    assert "--web" in err
    monkeypatch.setenv("DISPLAY", ":987")  # nobody there
    code, _, err = view(session_file)
    assert code == 1
    assert "the Rerun viewer failed" in err


def test_no_session_no_recording(tmp_path, view):
    (tmp_path / "x.mcap").write_bytes(b"not a log at all")
    code, _, err = view(tmp_path / "x.mcap", "--save", tmp_path / "x.rrd")
    assert code == 1
    assert "not an MCAP file" in err
    assert not (tmp_path / "x.rrd").exists()


def test_the_viewer_is_reruns_own():
    done = subprocess.run(
        [viewer_binary(), "--version"], check=True, capture_output=True, text=True
    )
    assert re.search(r"\b0\.41\.", done.stdout)


@pytest.mark.slow
def test_web_serves_this_machine_only_until_told_to_end(session_file, tmp_path):
    if not Path("/proc/net/tcp").exists():
        pytest.skip("listening sockets are told from /proc/net/tcp")
    with served_page(session_file, tmp_path) as (process, address):
        page, data = (int(port) for port in re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", address))
        wait_for(lambda: listening(data), alive=(process,))  # the page may answer before it does
        assert listening(page, data) == {("0100007F", port) for port in (page, data)}
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0
        assert not listening(page)
        assert list(tmp_path.iterdir()) == []
