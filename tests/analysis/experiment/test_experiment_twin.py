"""Experiments on recorded twins, a short chain on the ground: six runs each way, and kicks."""

import math

import pytest

from support import twin_chains
from support.analysed import experiment
from undulog.sim import load_scenario, record
from undulog.sim.scenario.scenario import Kernels

pytestmark = pytest.mark.nightly


ROBOT = twin_chains.chain(7, stall_torque=0.25)
"""Four yaw joints in two mirror pairs."""

WEAK = {"servo_of": {"joint03": {"stall_torque": 0.2}}}


def wave(way="head-to-tail", noise=0.005, **tables):
    run = {"duration_s": 8.0, "settle_s": 4.0, "gait": {"ramp_s": 1.0}}
    tables |= {"horizontal": {"wave": way}, "noise": {"position": noise}}
    return twin_chains.wave(**run, **tables)


@pytest.fixture
def driven(tmp_path, command):
    """Drives the commands of a folder on the twin of a world; returns the sessions' paths."""

    def drive(folder, world):
        paths = [tmp_path / f"{world.stem}-{file.name}" for file in sorted(folder.glob("*.mcap"))]
        for path in paths:
            commands = folder / path.name.removeprefix(f"{world.stem}-")
            command("drive", commands, "--on", f"twin:{world}", "-o", path)
        return paths

    return drive


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
                record(scenario.changed(seed=20 * k + run + 1), paths[-1], kernels=Kernels.NUMBA)

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


def test_a_planned_reversal_cancels_a_tilted_floor(tmp_path, driven, command, report_of):
    """From a recorded gait to the pair, by the commands, on a floor that falls by 1 degree."""
    (tmp_path / "chain.toml").write_text(ROBOT)
    like, folder = tmp_path / "like.mcap", tmp_path / "plan"
    (tmp_path / "like.toml").write_text(wave())
    command("sim", "run", tmp_path / "like.toml", "-o", like, "--kernels", "numba")
    words = ("--like", like, "-o", folder, "--settle", "4", "--measure", "4")
    command("plan", "reversal", *words)
    answers = {}
    for name, more in (("sound", {}), ("weak", WEAK)):
        world = tmp_path / f"{name}.toml"
        world.write_text(wave(world={"slope": math.radians(1.0)}, **more))
        paths = driven(folder, world)
        at_one_heading = [path for path in paths if path.name.endswith("-0.mcap")]
        answers[name, "balanced"] = report_of("analyse", *paths)
        answers[name, "one heading"] = report_of("analyse", *at_one_heading)
    sound, weak = (answers[name, "balanced"] for name in ("sound", "weak"))
    for report in (sound, weak):
        reversal = report["reversal"]
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
    unbalanced, balanced = (
        max(abs(joint["lag_difference_rad"]["value"]) for joint in reversal["joints"])
        for reversal in (alone, sound["reversal"])
    )
    assert unbalanced > 5 * balanced


@pytest.mark.built("tables")
def test_kicks_in_contact_predict_what_was_held_out(tmp_path, driven, command, report_of):
    """From a recorded gait to its coupling, by the commands: plan, drive, analyse."""
    (tmp_path / "chain.toml").write_text(ROBOT)
    scenario = tmp_path / "wave.toml"
    scenario.write_text(wave(noise=0.0005))
    like, folder = tmp_path / "like.mcap", tmp_path / "kicks"
    command("sim", "run", scenario, "-o", like, "--kernels", "numba")
    words = ("--like", like, "-o", folder, "--settle", "4", "--measure", "4")
    command("plan", "phase-kicks", *words)
    paths = driven(folder, scenario)
    coupling = report_of("analyse", *paths, "--start", "4")["coupling"]
    assert (coupling["base_runs"], coupling["kicked_runs"]) == (6, 16)
    # Time shift, whatever the ground does.
    for rows in ("phase_rows", "gain_rows"):
        for row in coupling[rows]:
            assert row["total"]["value"] == pytest.approx(row["expected"], abs=3e-3)
    # Servos that the ground slows down are no linear chain.
    assert coupling["nonlinearity"]["ci95"][0] > 0.02
    assert len(coupling["held_out"]) == 3
    for pattern in coupling["held_out"]:
        assert 2 * pattern["error"] < pattern["error_kept"]
    assert coupling["valid_to"] > 0.1
