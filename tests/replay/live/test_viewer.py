"""Viewers of the live view: frozen, killed, in a browser, without a display."""

import re
import signal
import urllib.request
from pathlib import Path
from subprocess import DEVNULL

import pytest

from support.live_stage import WAIT_S
from support.processes import freeze, listening, process
from undulog.replay.viewer import free_ports, viewer_binary


@pytest.fixture
def server():
    """Rerun's own gRPC server without a window, on this machine only: (address, process)."""
    (port,) = free_ports(1)
    words = (viewer_binary(), "--serve-grpc", "--bind", "127.0.0.1", "--port", port)
    with process(*words, stdout=DEVNULL, stderr=DEVNULL) as running:
        yield f"rerun+http://127.0.0.1:{port}/proxy", running


@pytest.mark.slow
def test_frozen_and_killed_viewer_costs_the_feed_nothing(stage, server):
    address, process = server
    recorder, relay = stage.recorder(), stage.relay(None, "--connect", address)
    recorder.connect()
    recorder.send(0.0, 1.0)
    freeze(process.pid)
    assert recorder.send(1.0, 2.0) == 50
    process.kill()
    assert recorder.send(2.0) >= 49
    assert (recorder.feed.counts.dropped, relay.process.poll()) == (0, None)
    relay.process.send_signal(signal.SIGTERM)
    relay.process.communicate(timeout=WAIT_S)
    assert not stage.path.exists()


@pytest.mark.slow
def test_relay_of_a_frozen_viewer_can_be_ended(stage, server):
    address, process = server
    recorder, relay = stage.recorder(), stage.relay(None, "--connect", address)
    recorder.connect()
    recorder.send(0.0, 1.0)
    freeze(process.pid)
    recorder.send(1.0)
    relay.process.send_signal(signal.SIGTERM)
    out, err = relay.process.communicate(timeout=WAIT_S)
    assert relay.process.returncode == 1
    assert "messages shown, 0 dropped" in out
    # Whether it hangs in a send or in the last flush is a matter of when it froze.
    assert re.search("the viewer (did not take the last of it|takes no data)", err)


@pytest.mark.nightly
def test_web_serves_this_machine_only_and_leaves_nothing(stage):
    relay = stage.relay(None, "--web")
    page = relay.process.stdout.readline().strip()
    assert page.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(page, timeout=WAIT_S) as answer:
        assert answer.status == 200
    recorder = stage.recorder()
    recorder.connect()
    recorder.send(0.0, 1.0)
    (child,) = (
        Path(f"/proc/{relay.process.pid}/task/{relay.process.pid}/children").read_text().split()
    )
    ports = {int(text) for text in re.findall(r"(?:127.0.0.1:|127.0.0.1%3A)(\d+)", page)}
    assert (len(ports), listening(*ports)) == (2, {("0100007F", port) for port in ports})
    relay.process.send_signal(signal.SIGINT)
    relay.process.communicate(timeout=WAIT_S)
    assert relay.process.returncode == 0
    assert not Path(f"/proc/{child}").exists()
    assert not stage.path.exists()


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ([], "give a session to see, or --live"),
        (["a.mcap", "--live", "s"], "give a session to see, or --live"),
        (["a.mcap", "--connect", "x"], "give --live as well"),
        (["--live", "s", "--connect", "x", "--web"], "without --web"),
    ],
)
def test_wrong_usage_is_refused(arguments, why, command):
    assert why in command("view", *arguments, code=2).err


def test_window_without_a_display_is_refused_at_once(monkeypatch, tmp_path, command):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    assert "no display" in command("view", "--live", tmp_path / "s", code=2).err
