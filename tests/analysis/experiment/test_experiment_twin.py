"""Experiments on recorded twins, a short chain on the ground: six runs each way, and kicks."""

import json
import math

import pytest

import undulog
from support import twin_chains
from support.analysed import experiment
from undulog.sim import load_scenario
from undulog.sim.twin.recording import record

pytestmark = pytest.mark.slow


ROBOT = twin_chains.chain(7, stall_torque=0.25)
"""Four yaw joints in two mirror pairs."""

WEAK = {"servo_of": {"joint03": {"stall_torque": 0.2}}}


def wave(way="head-to-tail", noise=0.005, **tables):
    return twin_chains.wave(
        duration_s=8.0,
        settle_s=4.0,
        gait={"ramp_s": 1.0},
        horizontal={"wave": way},
        noise={"position": noise},
        **tables,
    )


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The experiment of six runs each way, with identical modules or with a weak one."""

    def make(**more):
        folder = tmp_path_factory.mktemp("twin")
        (folder / "chain.toml").write_text(ROBOT)
        paths = []
        for k, way in enumerate(("head-to-tail", "tail-to-head")):
            (folder / "wave.toml").write_text(wave(way, **more))
            scenario = load_scenario(folder / "wave.toml")
            for run in range(6):
                paths.append(folder / f"{way}-{run}.mcap")
                record(scenario.changed(seed=20 * k + run + 1), paths[-1])

        return experiment(paths)

    return make


def test_identical_modules_are_not_called_different(answered):
    result = answered()
    reversal = result.reversal
    assert (reversal.forward_runs, reversal.reverse_runs) == (6, 6)
    assert reversal.p > 0.05
    assert reversal.pairs == ()
    assert reversal.boundary_share.ci95[0] > 0.95
    assert ": the pattern is boundary (share" in result.answer
    # The pattern itself is there beyond doubt.
    assert result.heterogeneity["common_response"].p < 1e-9


def test_the_weak_servo_is_named(answered):
    result = answered(**WEAK)
    assert result.reversal.p == pytest.approx(2 / 924)
    assert "joint03 answers less than its mirror joint05 (p = 0.002)" in result.answer
    assert "joint03 weaker or joint05 stronger" in result.answer
    pair = result.reversal.pairs[0]
    assert (pair.name, pair.mirror) == ("joint03", "joint05")
    assert pair.lag_contrast_rad.ci95[0] > 0
    assert result.reversal.boundary_share.value > result.reversal.module_share.value


def planned(folder, plan, scenario):
    """Sessions of commands of a plan around a recorded gait."""
    (folder / "chain.toml").write_text(ROBOT)
    like = folder / "like.mcap"
    (folder / "like.toml").write_text(scenario)
    assert undulog.run(["sim", "run", str(folder / "like.toml"), "-o", str(like)]) == 0
    words = ["--like", str(like), "-o", str(folder / plan), "--settle", "4", "--measure", "4"]
    assert undulog.run(["plan", plan, *words]) == 0
    return sorted((folder / plan).glob("*.mcap"))


def driven(folder, commands, scenario):
    """Each of the sessions driven on a twin of its own."""
    world = folder / "world.toml"
    world.write_text(scenario)
    folder = folder / "driven"
    folder.mkdir(exist_ok=True)
    paths = [str(folder / file.name) for file in commands]
    for file, path in zip(commands, paths, strict=True):
        on = ["--on", f"twin:{world}", "-o", path, "--force"]
        assert undulog.run(["drive", str(file), *on]) == 0
    return paths


def analysed(capsys, *words):
    capsys.readouterr()
    assert undulog.run(["analyse", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_planned_reversal_cancels_a_tilted_floor(tmp_path, capsys):
    """From a recorded gait to the pair, by the commands, on a floor that falls by 1 degree."""
    commands = planned(tmp_path, "reversal", wave())
    answers = {}
    for name, more in (("sound", {}), ("weak", WEAK)):
        paths = driven(tmp_path, commands, wave(world={"slope": math.radians(1.0)}, **more))
        answers[name, "balanced"] = analysed(capsys, *paths)
        at_one_heading = [path for path in paths if path.endswith("-0.mcap")]
        answers[name, "one heading"] = analysed(capsys, *at_one_heading)
    sound, weak = (answers[name, "balanced"] for name in ("sound", "weak"))
    for one in (sound, weak):
        reversal = one["reversal"]
        assert (reversal["forward_runs"], reversal["reverse_runs"]) == (6, 6)
        assert reversal["labellings"] == 400
        assert (reversal["tilt"]["headings"], reversal["tilt"]["strata"]) == ("balanced", 2)
    assert sound["reversal"]["pairs"] == []
    assert sound["reversal"]["p"] > 0.05
    pair = weak["reversal"]["pairs"][0]
    assert (pair["name"], pair["mirror"]) == ("joint03", "joint05")
    assert "the modules differ: joint03 answers less than its mirror joint05" in weak["answer"]
    # With one heading the floor makes identical modules differ, and no module is named.
    alone = answers["sound", "one heading"]["reversal"]
    assert (alone["forward_runs"], alone["reverse_runs"]) == (3, 3)
    tilt = alone["tilt"]
    assert (tilt["headings"], tilt["excluded"]) == ("unbalanced", False)
    largest = max(abs(one["lag_difference_rad"]["value"]) for one in alone["joints"])
    assert largest > 5 * max(
        abs(one["lag_difference_rad"]["value"]) for one in sound["reversal"]["joints"]
    )


def test_kicks_in_contact_predict_what_was_held_out(tmp_path, capsys):
    """From a recorded gait to its coupling, by the commands: plan, drive, analyse."""
    scenario = wave(noise=0.0005)
    paths = driven(tmp_path, planned(tmp_path, "phase-kicks", scenario), scenario)
    coupling = analysed(capsys, *paths, "--start", "4")["coupling"]
    assert (coupling["base_runs"], coupling["kicked_runs"]) == (6, 16)
    # Time shift, whatever the ground does.
    for rows in ("phase_rows", "gain_rows"):
        for row in coupling[rows]:
            assert row["total"]["value"] == pytest.approx(row["expected"], abs=3e-3)
    # Servos that the ground slows down are no linear chain.
    assert coupling["nonlinearity"]["ci95"][0] > 0.02
    assert len(coupling["held_out"]) == 3
    for one in coupling["held_out"]:
        assert 2 * one["error"] < one["error_kept"]
    assert coupling["valid_to"] > 0.1
