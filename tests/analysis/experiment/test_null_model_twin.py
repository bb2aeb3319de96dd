"""A null model from the twin to a named module, through the commands."""

import json

import pytest

import undulog
from support import twin_chains

WEAK = {"servo_of": {"joint05": {"stall_torque": 0.2}}}


def wave(lag, stall, **tables):
    return twin_chains.wave(
        duration_s=7.0,
        settle_s=4.0,
        gait={"ramp_s": 1.0},
        horizontal={"lag": lag},
        noise={"position": 0.002},
        servo={"stall_torque": stall},
        **tables,
    )


@pytest.mark.nightly
def test_from_the_twin_to_a_named_module(tmp_path, capsys, command):
    """The middle joint, to which a reversal is blind, from one direction alone."""
    (tmp_path / "chain.toml").write_text(twin_chains.chain(9))
    scenario, model = tmp_path / "wave.toml", tmp_path / "null.json"

    def analysed(text):
        scenario.write_text(text)
        session = tmp_path / "run.mcap"
        command("sim", "run", scenario, "-o", session, "--kernels", "numba", "--force")
        code = undulog.run(["analyse", str(session), "--null", str(model), "--json"])
        printed = capsys.readouterr()
        return json.loads(printed.out)["null_model"] if code == 0 else printed.err

    scenario.write_text(wave(1.0, 0.25))
    assert undulog.run(["sim", "null", str(scenario), "-o", str(model)]) == 0
    # Identical modules, all a little stronger than the model's.
    shifted = analysed(wave(1.0, 0.265))
    assert shifted["named"] == []
    assert "conditional on the model null.json" in shifted["condition"]
    fitted = {parameter["name"]: parameter["fitted"]["ci95"] for parameter in shifted["parameters"]}
    assert fitted["stall_torque"][0] < 0.265 < fitted["stall_torque"][1]
    weak = analysed(wave(1.0, 0.25, **WEAK))
    assert weak["named"][0] == "joint05"
    assert weak["p"] < 0.01
    low, high = weak["modules"][2]["relative"]["stall_torque"]["ci95"]
    assert low < -0.2 < high  # it has the truth, though it is wide: the model's own error is in it
    assert "can't be held to" in analysed(wave(0.8, 0.25))


@pytest.mark.nightly
def test_each_inner_joint_of_a_plane_of_six_is_named_at_half_its_torque(tmp_path, command):
    """Of so few joints the body's own profile is as large as what a weak one makes of it."""
    (tmp_path / "chain.toml").write_text(twin_chains.chain(11))
    scenario, model, session = (tmp_path / name for name in ("w.toml", "null.json", "run.mcap"))
    scenario.write_text(wave(1.0, 0.5))
    command("sim", "null", scenario, "-o", model)
    named = {}
    for joint in ("joint03", "joint05", "joint07", "joint09"):
        scenario.write_text(wave(1.0, 0.5, servo_of={joint: {"stall_torque": 0.25}}))
        command("sim", "run", scenario, "-o", session, "--kernels", "numba", "--force")
        report = json.loads(command("analyse", session, "--null", model, "--json").out)
        named[joint] = report["null_model"]["named"]
    assert named == {joint: [joint] for joint in named}
