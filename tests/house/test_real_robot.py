"""A real robot's CAN trace through the commands, as its owner would type them."""

import json

import pytest

from support.paths import TRACE


@pytest.mark.slow
def test_a_ramp_is_imported_exported_and_has_no_gait(tmp_path, command):
    if not TRACE.is_file():
        pytest.skip(f"the real recording {TRACE.name} is not beside this checkout")
    log, back = tmp_path / "arcsnake.mcap", tmp_path / "back.log"
    command("import", TRACE, "--robot", "arcsnake-joint", "-o", log)
    command("log", "export", log, "-o", back)
    assert back.read_bytes() == TRACE.read_bytes()
    result = json.loads(command("analyse", log, "--json").out)
    assert result["gait"]["frequency_hz"] is None
    (joint,) = result["joints"]
    assert [joint[key] for key in ("gain", "lag_rad", "lag_ci95")] == [None] * 3
    assert any("gait" in warning for warning in result["warnings"])
