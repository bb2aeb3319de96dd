"""Experiments on recorded twins, a short chain on the ground: six runs each way, and kicks."""

import math

import pytest

import undulog
from support import twin_chains
from support.analysed import experiment
from undulog.sim import load_scenario, record

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


def test_a_planned_reversal_cancels_a_tilted_floor(tmp_path, capsys, report_of):
    """From a recorded gait to the pair, by the commands, on a floor that falls by 1 degree."""
    (tmp_path / "chain.toml").write_text(ROBOT)
    like, folder = tmp_path / "like.mcap", tmp_path / "plan"
    (tmp_path / "like.toml").write_text(wave())
    assert undulog.run(["sim", "run", str(tmp_path / "like.toml"), "-o", str(like)]) == 0
    words = ["--like", str(like), "-o", str(folder), "--settle", "4", "--measure", "4"]
    assert undulog.run(["plan", "reversal", *words]) == 0
    answers = {}
    for name, more in (("sound", {}), ("weak", WEAK)):
        world = tmp_path / f"{name}.toml"
        world.write_text(wave(world={"slope": math.radians(1.0)}, **more))
        driven = []
        for commands in sorted(folder.glob("*.mcap")):
            driven.append(str(tmp_path / f"{name}-{commands.name}"))
            on = ["--on", f"twin:{world}", "-o", driven[-1]]
            assert undulog.run(["drive", str(commands), *on]) == 0
        at_one_heading = [path for path in driven if path.endswith("-0.mcap")]
        for plan, paths in (("balanced", driven), ("one heading", at_one_heading)):
            capsys.readouterr()
            answers[name, plan] = report_of("analyse", *paths)
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
    assert max(abs(one["lag_difference_rad"]["value"]) for one in alone["joints"]) > 5 * max(
        abs(one["lag_difference_rad"]["value"]) for one in sound["reversal"]["joints"]
    )


def test_kicks_in_contact_predict_what_was_held_out(tmp_path, capsys, report_of):
    """From a recorded gait to its coupling, by the commands: plan, drive, analyse."""
    (tmp_path / "chain.toml").write_text(ROBOT)
    scenario = tmp_path / "wave.toml"
    scenario.write_text(wave(noise=0.0005))
    like, folder = tmp_path / "like.mcap", tmp_path / "kicks"
    assert undulog.run(["sim", "run", str(scenario), "-o", str(like)]) == 0
    words = ["--like", str(like), "-o", str(folder), "--settle", "4", "--measure", "4"]
    assert undulog.run(["plan", "phase-kicks", *words]) == 0
    driven = []
    for k, commands in enumerate(sorted(folder.glob("*.mcap"))):
        driven.append(str(tmp_path / f"{k:02d}.mcap"))
        on = ["--on", f"twin:{scenario}", "-o", driven[-1]]
        assert undulog.run(["drive", str(commands), *on]) == 0
    capsys.readouterr()
    coupling = report_of("analyse", *driven, "--start", "4")["coupling"]
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
