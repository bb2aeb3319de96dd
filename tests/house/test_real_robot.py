"""A real robot's CAN trace through the commands, as its owner would type them."""

import json

import pytest

import undulog
from support.paths import TRACE


def test_a_ramp_is_imported_exported_and_has_no_gait(tmp_path, capsys):
    if not TRACE.is_file():
        pytest.skip(f"the real recording {TRACE.name} is not beside this checkout")
    log, back = tmp_path / "arcsnake.mcap", tmp_path / "back.log"
    robot = ["--robot", "arcsnake-joint"]
    assert undulog.run(["import", str(TRACE), *robot, "-o", str(log)]) == 0
    assert undulog.run(["log", "export", str(log), "-o", str(back)]) == 0
    assert back.read_bytes() == TRACE.read_bytes()
    capsys.readouterr()
    assert undulog.run(["analyse", str(log), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["gait"]["frequency_hz"] is None
    (joint,) = result["joints"]
    assert joint["gain"] is None
    assert joint["lag_rad"] is None
    assert joint["lag_ci95"] is None
    assert any("gait" in warning for warning in result["warnings"])
