"""Plans of sweeps: their designs against SciPy's own, and what is refused."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import undulog as front
from support.sweep_plans import write_plan
from undulog.capture.common.errors import PlanError
from undulog.replay.sweep.plan import Design, Parameter, SweepPlan, points_of, read_plan, runs_of
from undulog.replay.sweep.sweep import prepare

STRENGTH = Parameter("servo.stall_torque", low=0.1, high=10.0, log=True)
RANGE = 'scenario = "flat"\ndesign = "sobol"\npoints = 2\n[parameters.x]\n'
JOINTS = Parameter("robot.chain.joints", low=5, high=9, integer=True)


def planned(design, points, *parameters, seed=0):
    return SweepPlan("flat", design=design, points=points, parameters=parameters, design_seed=seed)


def test_a_grid_has_every_combination_once_and_each_seed(tmp_path):
    path = write_plan(tmp_path, (0.1, 0.2, 0.3), seeds=2, top="first_seed = 7")
    path.write_text(path.read_text() + '[parameters."noise.position"]\nvalues = [0.0, 0.01]\n')
    runs = list(runs_of(read_plan(path)))
    assert (len(runs), {seed for _, seed in runs}) == (12, {7, 8})
    pairs = {(changes["servo.stall_torque"], changes["noise.position"]) for changes, _ in runs}
    assert pairs == {(a, b) for a in (0.1, 0.2, 0.3) for b in (0.0, 0.01)}


@pytest.mark.parametrize("design", [Design.RANDOM, Design.SOBOL])
@given(few=st.integers(1, 40), more=st.integers(0, 40), seed=st.integers(0, 1000))
def test_a_longer_design_begins_with_the_shorter_one(design, few, more, seed):
    short = points_of(planned(design, few, STRENGTH, JOINTS, seed=seed))
    assert points_of(planned(design, few + more, STRENGTH, JOINTS, seed=seed))[:few] == short


@pytest.mark.parametrize("design", [Design.RANDOM, Design.SOBOL])
def test_points_are_even_in_the_logarithm_and_over_the_integers(design):
    points = points_of(planned(design, 1024, STRENGTH, JOINTS))
    strength = np.array([point["servo.stall_torque"] for point in points])
    shares = (np.log(strength) - math.log(0.1)) / math.log(100.0)
    assert stats.kstest(shares, "uniform").pvalue > 0.01
    counts = np.bincount([point["robot.chain.joints"] for point in points])[5:]
    assert len(counts) == 4
    assert stats.chisquare(counts).pvalue > 0.01


def test_a_sobol_design_covers_better_than_chance():
    def shares(design):
        points = points_of(planned(design, 256, STRENGTH, Parameter("x", low=0.0, high=1.0)))
        return np.array([[math.log10(p["servo.stall_torque"]) / 2 + 0.5, p["x"]] for p in points])

    even, chance = (
        stats.qmc.discrepancy(shares(design)) for design in (Design.SOBOL, Design.RANDOM)
    )
    assert even < chance / 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "syntax"),
        ('scenario = "flat"', "parameters"),
        ('scenario = "flat"\n[parameters.x]', "low"),
        ('scenario = "flat"\n[parameters.x]\nvalues = []', "at least one value"),
        ('scenario = "flat"\n[parameters.x]\nlow = 1\nhigh = 2', "random or sobol"),
        ('scenario = "flat"\npoints = 2\n[parameters.x]\nvalues = [1]', "none for grid"),
        ('scenario = "flat"\ndesign = "sobol"\n[parameters.x]\nlow = 1\nhigh = 2', "points"),
        (f"{RANGE}low = -1\nhigh = 2\nlog = true", "above 0"),
        ('scenario = "flat"\n[parameters.seed]\nvalues = [1]', "first_seed"),
        ('scenario = "flat"\nseeds = 2000000\n[parameters.x]\nvalues = [1]', "at most 1000000"),
        ('scenario = "flat"\nfoo = 1\n[parameters.x]\nvalues = [1]', "foo"),
        ('scenario = "flat"\nduration_s = 1\n[parameters.duration_s]\nvalues = [1]', "left out"),
    ],
)
def test_what_can_not_be_meant_is_refused_with_the_key(text, message, tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(PlanError, match=message):
        read_plan(path)


def test_the_plan_of_the_manual_is_one(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "how-to/sweeps.md").read_text()
    path = tmp_path / "strength.toml"
    path.write_text(page.split("```toml\n")[1].split("```")[0])
    sweep = prepare(read_plan(path), tmp_path, str(tmp_path / "strength"))
    assert (len(sweep.jobs), sweep.simulated_s) == (16, 16.0)


PARAMETER = 'scenario = "flat"\n[parameters."servo.stall_torque"]\n'
HOSTILE = {
    "a range of a billion points": (
        (
            'scenario = "flat"\ndesign = "random"\npoints = 1000000000\n'
            "[parameters.x]\nlow = 0\nhigh = 1\n"
        ),
        "at most 1000000 runs",
    ),
    "a grid of 10^12 runs": (
        'scenario = "flat"\n'
        + "".join(f"[parameters.x{k}]\nvalues = {list(range(1000))}\n" for k in range(4)),
        "1000000 runs",
    ),
    "10^12 seeds": (
        'scenario = "flat"\nseeds = 1000000000000\n[parameters.x]\nvalues = [1]\n',
        "1000000 runs",
    ),
    "NaN": (PARAMETER + "values = [0.1, nan, 0.2]\n", r"values\[1\]: found nan"),
    "infinity in a list": (PARAMETER + "values = [0.1, [inf], 0.2]\n", "finite number"),
    "a date": (PARAMETER + "values = [0.1, 1979-05-27, 0.2]\n", "finite number"),
    "a long text": (PARAMETER + f'values = [0.1, "{"x" * 1_000_000}", 0.2]\n', "1000 characters"),
    "a falling range": (
        ('scenario = "flat"\ndesign = "sobol"\npoints = 2\n[parameters.x]\nlow = 2\nhigh = 1\n'),
        "above low",
    ),
    "a range from NaN": (
        (
            'scenario = "flat"\ndesign = "sobol"\npoints = 2\n[parameters.x]\n'
            "low = nan\nhigh = inf\n"
        ),
        "finite number",
    ),
    "more parameters than dimensions": (
        'scenario = "flat"\ndesign = "sobol"\npoints = 2\n'
        + "".join(f"[parameters.x{k}]\nlow = 0\nhigh = 1\n" for k in range(22_000)),
        "at most 100 parameters",
    ),
    "many runs of long texts": (
        (
            'scenario = "flat"\nseeds = 1000000\n[parameters.x]\n'
            f'values = ["{"x" * 999}"]\n[parameters.y]\nvalues = ["{"x" * 999}"]\n'
        ),
        "characters as text",
    ),
    "a long name": (f'scenario = "{"x" * 100_000}"\n[parameters.x]\nvalues = [1]\n', "scenario"),
    "a name with NUL": ('scenario = "a\\u0000.toml"\n[parameters.x]\nvalues = [1]\n', "scenario"),
    "a hundred thousand unknown keys": (
        'scenario = "flat"\n' + "".join(f"k{k} = 1\n" for k in range(100_000)),
        "an unknown key",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_plans_that_no_computer_would_end_are_refused_by_a_sentence(name, tmp_path):
    text, why = HOSTILE[name]
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(PlanError, match=why) as refused:
        read_plan(tmp_path / "plan.toml")
    assert len(str(refused.value)) < 100_000


@pytest.mark.parametrize("name", ["x" * 300, "../" * 300 + "x", "x\\u0000y", "a/" * 400 + "b.toml"])
def test_names_of_robots_and_scenarios_that_no_file_has_are_refused(name, tmp_path, capsys):
    plan = write_plan(tmp_path)
    head = plan.read_text()
    for text in (
        head.replace('"wave.toml"', f'"{name}"'),
        head + f'[parameters.robot]\nvalues = ["{name}"]\n',
    ):
        plan.write_text(text)
        assert front.run(["sweep", str(plan), "-o", str(tmp_path / "rows"), "--dry-run"]) in (1, 2)
        shown = capsys.readouterr().err
        assert "Traceback" not in shown
        assert len(shown) < 10_000
    assert not (tmp_path / "rows").exists()
