"""Command ``view`` as it is used: files, errors, and a server that only this machine reaches."""

import re
import signal
import sys
from pathlib import Path

import pytest

from support.processes import listening, served_page, wait_for


@pytest.mark.slow
def test_save_writes_a_recording_and_reports_it(
    session_file, tmp_path, snake25, command, report_of
):
    path = tmp_path / "made.rrd"
    path.write_bytes(b"mine")
    words = ("view", session_file, "--save", path)
    assert "--force" in command(*words, code=2).err
    assert path.read_bytes() == b"mine"
    assert command(*words, "--force").out.startswith(f"{path}: 3.0 s, ")
    assert path.stat().st_size > 100_000
    report = report_of(*words, "--force")
    assert (report["path"], report["bytes"]) == (str(path), path.stat().st_size)
    assert (report["joints"], report["body"]) == (list(snake25.joint_names), True)


@pytest.mark.slow
def test_a_session_without_a_gait_is_shown_all_the_same(write, tmp_path, command):
    session = write(tmp_path / "a.mcap", robot=False, gait=False, odometry=False)
    output = command("view", session, "--save", tmp_path / "a.rrd").out
    assert "no robot description" in output


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--save", "made.mcap"], ".rrd"),
        (["--save", "made.rrd", "--web"], "give one of them"),
        (["--json"], "--save"),
    ],
)
def test_wrong_usage_is_explained(session_file, command, arguments, complaint):
    assert complaint in command("view", session_file, *arguments, code=2).err


def test_without_a_display_the_way_out_is_named(session_file, command, monkeypatch):
    if not sys.platform.startswith("linux"):
        pytest.skip("only on Linux can a display be declared missing")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    err = command("view", session_file, code=2).err
    assert "--save" in err
    assert "--web" in err
    monkeypatch.setenv("DISPLAY", ":987")  # nobody there
    assert "the Rerun viewer failed" in command("view", session_file, code=1).err


def test_no_session_no_recording(tmp_path, command):
    (tmp_path / "x.mcap").write_bytes(b"not a log at all")
    words = ("view", tmp_path / "x.mcap", "--save", tmp_path / "x.rrd")
    assert "not an MCAP file" in command(*words, code=1).err
    assert not (tmp_path / "x.rrd").exists()


def test_the_viewer_is_reruns_own(rerun_command):
    assert re.search(r"\b0\.41\.", rerun_command("--version"))


@pytest.mark.nightly
def test_web_serves_this_machine_only_until_it_is_ended(session_file, tmp_path):
    if not Path("/proc/net/tcp").exists():
        pytest.skip("listening sockets are read from /proc/net/tcp")
    with served_page(session_file, tmp_path) as (process, address):
        page, data = (int(port) for port in re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", address))
        wait_for(lambda: listening(data), alive=(process,))  # the page may answer before it does
        assert listening(page, data) == {("0100007F", port) for port in (page, data)}
        process.send_signal(signal.SIGTERM)
        assert process.wait() == 0
        assert not listening(page)
        assert list(tmp_path.iterdir()) == []
