"""The systemd unit: valid, hardened, and what it promises is what the recorder does."""

import os
import re
import shutil
import signal
import socket
import subprocess
from collections import defaultdict
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from support.processes import process, run, undulog
from support.recorders import connected_sender
from undulog.capture.common.errors import UsageError
from undulog.capture.recorder.systemd import UNIT_NAME, hidden_folder, installed_program, unit_text

PATIENCE_S = 60.0
EXPOSURE = 2.0  # of 10, as `systemd-analyze security` counts; 2.5 would still be "OK"


@pytest.fixture
def systemd_analyze(display_tests_required):
    """Path of systemd-analyze; skips where there is none, fails where one is required."""
    if path := shutil.which("systemd-analyze"):
        return path
    refuse = pytest.fail if display_tests_required else pytest.skip
    return refuse("no systemd-analyze on the path")


@pytest.fixture
def unit(tmp_path):
    """The unit as installed here, for the settings snake.toml."""
    path = tmp_path / UNIT_NAME.replace("@", "@snake")
    path.write_text(unit_text(installed_program()))
    return path


def settings_of(text):
    """Key to all its values, without comments."""
    settings = defaultdict(list)
    for key, value in re.findall(r"^([^#=\n]+)=(.*)$", text, re.MULTILINE):
        settings[key].append(value)
    return settings


def test_systemd_finds_nothing_wrong(systemd_analyze, unit):
    assert unit.name not in run(systemd_analyze, "verify", "--man=no", unit, code=0).stderr


def judged(systemd_analyze, unit):
    """systemd's verdict on a unit's security."""
    threshold = f"--threshold={EXPOSURE * 10:.0f}"
    return run(systemd_analyze, "security", "--offline=true", "--no-pager", threshold, unit)


def test_systemd_finds_it_well_hardened(systemd_analyze, unit):
    done = judged(systemd_analyze, unit)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd-analyze can't judge a file")
    assert done.returncode == 0, done.stdout
    assert float(re.search(r"exposure level for \S+: ([0-9.]+)", done.stdout)[1]) <= EXPOSURE


def test_a_weaker_unit_would_not_pass(systemd_analyze, unit):
    """The threshold judges this very unit, not only its name."""
    weak = unit.read_text().replace("DynamicUser=yes", "User=root")
    weak = re.sub(r"(?m)^(CapabilityBoundingSet|SystemCallFilter|ProtectSystem)=.*$", "", weak)
    unit.write_text(weak)
    assert judged(systemd_analyze, unit).returncode != 0


def test_what_the_recorder_relies_on_is_there(unit):
    settings = settings_of(unit.read_text())
    assert (settings["Type"], settings["KillSignal"]) == (["notify"], ["SIGTERM"])
    assert settings["Restart"] == ["on-failure"]
    assert settings["AssertPathExists"] == ["/etc/undulog/%i.toml"]
    assert settings["RestartPreventExitStatus"] == ["2"]
    assert settings["RuntimeDirectory"] == settings["StateDirectory"] == ["undulog/%i"]
    assert {"AF_UNIX", "AF_CAN", "AF_INET"} <= set(settings["RestrictAddressFamilies"][0].split())
    assert {"char-ttyACM rw", "char-ttyUSB rw"} <= set(settings["DeviceAllow"])


def test_the_program_s_path_stands_in_the_unit():
    plain, odd = (unit_text(Path(f"/opt/{f}/undulog")) for f in ("undulog/bin", "a 50%/$HOME"))
    assert "ExecStart=/opt/undulog/bin/undulog record " in plain
    assert 'ExecStart="/opt/a 50%%/$HOME/undulog" record ' in odd
    for path in ("bin/undulog", "/opt/two\nlines/undulog", '/opt/a"b/undulog', "/opt/a*/undulog"):
        with pytest.raises(UsageError, match="an absolute path"):
            unit_text(Path(path))


@pytest.mark.parametrize("folder", ["/opt/with space", "/opt/50%", "/opt/a;b", "/opt/$x", "/opt/ü"])
def test_odd_paths_mean_to_systemd_what_they_spell(systemd_analyze, tmp_path, folder):
    """systemd looks for the program, and names the path that it understood."""
    unit = tmp_path / UNIT_NAME.replace("@", "@snake")
    unit.write_text(unit_text(Path(folder) / "undulog"))
    done = run(systemd_analyze, "verify", "--man=no", unit)
    assert f"Command {folder}/undulog is not executable" in done.stderr


def test_a_program_that_the_unit_hides_is_reported(tmp_path):
    assert hidden_folder(Path("/home/ann/venv/bin/undulog")) == "/home"
    assert hidden_folder(Path("/opt/undulog/bin/undulog")) is None
    (tmp_path / "undulog").write_text("")
    assert hidden_folder(tmp_path / "undulog") == "/tmp" or "tmp" not in str(tmp_path)


# -- the recorder as such a service ---------------------------------------------------------------


def heard(manager, expected):
    """Lines that come to the manager until the wanted one."""
    lines = []
    manager.settimeout(PATIENCE_S)
    while expected not in lines:
        lines += manager.recv(65536).decode().splitlines()
    return lines


def start_command(unit, name):
    """What the unit would run, with its specifiers filled in."""
    return settings_of(unit.read_text())["ExecStart"][0].replace("%i", name).split()


def without_capabilities():
    """A command that drops what root may do, where that is possible."""
    drop = ["setpriv", "--no-new-privs", "--bounding-set=-all"]
    if os.getuid() or shutil.which("setpriv") is None:
        return []
    return [] if subprocess.run([*drop, "true"], check=False).returncode else drop


@pytest.fixture
def service(unit, tmp_path):
    """Starts what the unit says, as the service manager would, without any capability.

    Yields a function that takes the settings and gives the process and the manager's socket.
    """
    state, runtime = tmp_path / "state", tmp_path / "runtime"
    state.mkdir()
    runtime.mkdir()
    environ = {
        "PATH": os.environ["PATH"],
        "NOTIFY_SOCKET": str(tmp_path / "notify"),
        "WATCHDOG_USEC": "200000",
        "RUNTIME_DIRECTORY": str(runtime),
        "STATE_DIRECTORY": str(state),
    }
    with ExitStack() as started, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))

        def start(settings=f'sources = ["unix:{tmp_path}/frames.sock"]\noutput = "run.mcap"\n'):
            file = tmp_path / "snake.toml"
            file.write_text(f"[record]\n{settings}")
            command = [*without_capabilities(), *start_command(unit, "snake")]
            command[command.index("/etc/undulog/snake.toml")] = file
            return started.enter_context(process(*command, cwd=state, env=environ)), manager

        yield start


def control(runtime, *words):
    """Run a command of the control socket as the operator would."""
    return undulog("record", *words, env={**os.environ, "RUNTIME_DIRECTORY": str(runtime)})


@pytest.mark.slow
def test_a_service_says_ready_feeds_its_watchdog_and_ends_whole_on_sigterm(service, tmp_path):
    process, manager = service()
    heard(manager, "READY=1")
    for _ in range(3):
        heard(manager, "WATCHDOG=1")
    assert (tmp_path / "runtime" / "run.sock").is_socket()
    asked = control(tmp_path / "runtime", "status", "--json")
    assert asked.returncode == 0, asked.stderr
    assert '"state": "recording"' in asked.stdout
    with connected_sender(tmp_path / "frames.sock"):
        process.send_signal(signal.SIGTERM)
        heard(manager, "STOPPING=1")
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert output == "", "--quiet"
    assert (tmp_path / "state" / "run.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")
    assert not (tmp_path / "runtime" / "run.sock").exists()


@pytest.mark.slow
def test_a_loop_that_hangs_feeds_its_watchdog_no_more(service):
    process, manager = service()
    heard(manager, "READY=1")
    heard(manager, "WATCHDOG=1")
    process.send_signal(signal.SIGSTOP)
    manager.settimeout(2.0)
    with suppress(TimeoutError):  # behind what was sent before
        for _ in range(1000):
            manager.recv(65536)
        pytest.fail("its watchdog is fed")
    process.send_signal(signal.SIGCONT)
    heard(manager, "WATCHDOG=1")


@pytest.mark.slow
def test_a_service_whose_robot_never_came_ends_as_failed_unless_it_was_stopped_on_request(
    service, tmp_path
):
    process, manager = service()
    heard(manager, "READY=1")
    asked = control(tmp_path / "runtime", "stop", "--wait")
    assert (asked.returncode, asked.stderr) == (1, "")
    assert "source frames was never connected" in asked.stdout
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert "source frames was never connected" in errors
    assert process.returncode == 0, "systemd would start the recording again"
    (tmp_path / "state" / "run.mcap").unlink()
    process, manager = service()
    heard(manager, "READY=1")
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1


def test_wrong_settings_end_with_2_so_that_they_are_not_tried_again(service):
    process, _ = service("sauces = []\n")
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "record.sauces: found an unknown key" in errors
