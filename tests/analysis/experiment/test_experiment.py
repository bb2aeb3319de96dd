"""Several sessions as one experiment: which of them belong, and what is reported of them."""

import dataclasses
import json
import math
import re
import shlex

import numpy as np
import pytest

from support.analysed import experiment
from support.joint_runs import EPOCH_NS, turns, write_joints
from undulog.analysis.present.text_experiment import render_experiment
from undulog.analysis.session.runs import mirror_fault
from undulog.capture import load_robot
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Plane

ROBOT = load_robot("snake25")
YAW = ROBOT.joint_indices(Plane.HORIZONTAL)
M = len(YAW)
PLACE = np.arange(M) / (M - 1)
BOUNDARY = np.log(0.9 + 0.05 * PLACE) - 1j * (0.1 + 0.1 * np.sin(np.pi * PLACE) + 0.03 * PLACE)


def write_run(
    path,
    seed,
    *,
    wave="head-to-tail",
    module=0.0,
    amplitude=0.3,
    frequency=1.0,
    step=math.pi / 3,
    kick=None,
    sigma=0.003,
    start_s=0.0,
    robot=ROBOT,
):
    """Four cycles of a wave, answered as ``BOUNDARY`` + ``module`` say, without physics."""
    rng = np.random.default_rng(seed)
    ahead = -1 if wave == "head-to-tail" else 1
    command = amplitude * np.exp(1j * (ahead * step * np.arange(M) + rng.uniform(-np.pi, np.pi)))
    if kick is not None:
        command[kick[0]] *= kick[1]
    answer = command * np.exp((BOUNDARY if ahead < 0 else BOUNDARY[::-1]) + module)
    epoch_ns = EPOCH_NS + round(start_s * 1e9)
    turn = turns(frequency, round(4 / frequency * 50))
    asked, seen = np.zeros((len(turn), 25)), rng.normal(0.0, sigma, (len(turn), 25))
    asked[:, YAW] = np.real(command * turn)
    seen[:, YAW] += np.real(answer * turn)
    how = {"epoch_ns": epoch_ns, "session_id": f"run{seed}", "robot": robot}
    return write_joints(path, ROBOT.joint_names, asked, [seen], **how)


def write_ways(folder, runs=6, **how):
    """Runs of both ways in turn, as they should be recorded."""
    paths = []
    for number in range(2 * runs):
        wave = ("head-to-tail", "tail-to-head")[number % 2]
        path = folder / f"{wave}-{number // 2}.mcap"
        paths.append(write_run(path, 1000 + number, wave=wave, start_s=20.0 * number, **how))
    return paths


@pytest.fixture(scope="module")
def alike(tmp_path_factory):
    return write_ways(tmp_path_factory.mktemp("alike"))


@pytest.fixture(scope="module")
def weak(tmp_path_factory):
    module = np.zeros(M, dtype=complex)
    module[3] = math.log(0.96) - 0.02j
    return write_ways(tmp_path_factory.mktemp("weak"), module=module)


@pytest.mark.nightly
def test_identical_modules_with_a_boundary_pattern(alike):
    result = experiment(alike)
    reversal = result.reversal
    assert (reversal.forward_runs, reversal.reverse_runs) == (6, 6)
    assert reversal.p > 0.05
    assert reversal.pairs == ()
    # What identical modules differ by is 0; what the bound says lies above the noise.
    error = 0.003 * (2 / 200) ** 0.5 / 0.27 * (2 / 6) ** 0.5
    assert 2 * error < reversal.lag_bound_rad < 8 * error
    assert reversal.boundary_share.value > 0.99
    blind = "blind to what is alike at both joints of a pair or of the middle joint, joint13"
    assert result.answer.startswith("no module differs from its mirror by more than")
    assert re.search(r": the pattern is boundary \(share 9|\(share 100\.0 %", result.answer)
    assert result.answer.endswith(blind)
    assert result.heterogeneity["common_response"].p < 1e-6
    assert result.heterogeneity["mirror_response"].p == reversal.p
    assert result.heterogeneity["equivalence_mirror_lag"].p < 0.05
    assert result.warnings == ()


@pytest.mark.slow
def test_a_weak_module_is_named(weak):
    result = experiment(weak)
    assert result.answer == (
        "the modules differ: joint07 answers less than its mirror joint19 (p = 0.002): "
        "joint07 weaker or joint19 stronger"
    )
    (pair,) = result.reversal.pairs
    assert (result.reversal.tilt.headings, result.reversal.tilt.excluded) == ("unknown", True)
    assert result.reversal.middle == "joint13"
    assert (pair.name, pair.mirror) == ("joint07", "joint19")
    for estimate, truth in (
        (pair.log_gain_contrast, math.log(0.96)),
        (pair.lag_contrast_rad, 0.02),
    ):
        low, high = estimate.ci95
        assert low < truth < high
        assert high - low < 0.01
    by_name = {joint.name: joint for joint in result.reversal.joints}
    assert by_name["joint07"].lag_difference_rad.value == pytest.approx(0.02, abs=0.002)
    assert by_name["joint19"].lag_difference_rad.value == pytest.approx(-0.02, abs=0.002)
    assert by_name["joint13"].mirror == "joint13"


@pytest.mark.slow
def test_of_two_runs_each_way_nothing_is_decided(weak):
    result = experiment(weak[:4])
    assert result.answer == (
        "not decided: with 2 + 2 runs no difference of a module can be shown, as p can't go below "
        "0.33; record at least 6 of each direction"
    )
    assert result.reversal.pairs == ()
    assert result.reversal.p >= result.reversal.p_floor


@pytest.mark.nightly
def test_one_direction_is_not_separable(alike):
    result = experiment(alike[::2])
    end = "; boundary or module is open: one direction only; record the reverse"
    assert result.answer.startswith("6 runs pooled: The segments do not move alike: ")
    assert result.answer.endswith(end)
    assert (result.reversal, result.pooled.runs) == (None, 6)
    truth = np.exp(BOUNDARY)
    for k, joint in enumerate(result.pooled.joints):
        assert joint.name == ROBOT.joint_names[YAW[k]]
        # All 26 hold together at twice the half width of one (Bonferroni, 5 degrees of freedom).
        for estimate, value in ((joint.gain, abs(truth[k])), (joint.lag_rad, -np.angle(truth[k]))):
            half = (estimate.ci95[1] - estimate.ci95[0]) / 2
            assert abs(estimate.value - value) < 2 * half < 0.01
    assert result.heterogeneity["module_share"].value is None
    assert result.heterogeneity["common_response"].p < 1e-6
    (warning,) = result.warnings
    assert "6 independent runs with the wave from head to tail and 0 from tail to head" in warning


@pytest.mark.nightly
def test_sessions_that_do_not_belong_are_named(alike, tmp_path):
    kick = (3, np.exp(0.05j))
    odd = {
        "has 1.2 Hz, head-to-tail-0.mcap 1 Hz": {"frequency": 1.2},
        "the amplitude is 4.0 % and the phase 0.0 degrees off": {"amplitude": 0.312},
        "has no travelling wave": {"step": 0.0},
        "is of no known robot, head-to-tail-0.mcap of snake25": {"robot": None},
        "at joint07 the amplitude is 0.0 % and the phase 2.9 degrees off": {"kick": kick},
    }
    others = [
        write_run(tmp_path / f"odd{k}.mcap", 100 + k, **how) for k, how in enumerate(odd.values())
    ]
    result = experiment([*alike, *others, alike[0]])
    assert [run.role for run in result.runs[:12]] == ["forward", "reverse"] * 6
    assert all(run.role is None for run in result.runs[12:])
    assert (result.reversal.forward_runs, result.reversal.reverse_runs) == (6, 6)
    for k, reason in enumerate(odd):
        assert reason in result.runs[12 + k].why
        assert any(w.startswith(f"odd{k}.mcap ") for w in result.warnings)
    assert "a copy is not a run of its own" in result.runs[-1].why


@pytest.mark.nightly
def test_runs_that_are_too_few_or_not_in_turn(alike):
    result = experiment(alike[:6])
    few = "p can't go below 0.1 with 3 + 3 runs, so no difference"
    assert any(few in w for w in result.warnings)
    grouped = experiment([*alike[0:6:2], *alike[7::2]])
    assert any("let them alternate" in w for w in grouped.warnings)
    single = experiment(alike[:3])
    assert single.reversal is None
    assert single.answer == "both directions, but not separable from these sessions"
    with pytest.raises(UsageError, match="at least one session"):
        experiment([])


def test_a_robot_that_is_not_its_own_mirror_image():
    driven = [ROBOT.joint_names[k] for k in YAW]
    assert (mirror_fault(ROBOT, driven), mirror_fault(None, driven)) == (None, None)
    assert "not their own mirror image" in mirror_fault(ROBOT, driven[:-1])
    alternate = load_robot("snake13")  # 6 + 6 joints: a yaw joint at the head, a pitch joint behind
    assert "come in another order" in mirror_fault(alternate, alternate.joint_names[::2])
    links = list(ROBOT.links)
    links[2] = dataclasses.replace(links[2], mass=2 * links[2].mass)
    assert "mass or inertia" in mirror_fault(dataclasses.replace(ROBOT, links=tuple(links)), driven)


@pytest.mark.slow
def test_bags_without_a_robot_are_taken_as_a_chain(tmp_path):
    result = experiment(write_ways(tmp_path, runs=2, robot=None))
    assert (result.reversal.forward_runs, result.reversal.reverse_runs) == (2, 2)
    assert result.reversal.p_floor == pytest.approx(2 / 6)
    assert any(w.startswith("no robot description") for w in result.warnings)


def test_nothing_that_travels(tmp_path):
    result = experiment([write_run(tmp_path / f"{k}.mcap", k, step=0.0) for k in (1, 2)])
    assert result.answer.startswith("no gait with a travelling wave")
    assert (result.reversal, result.heterogeneity["common_response"].value) == (None, None)
    assert json.dumps(result.to_dict(), allow_nan=False)
    assert render_experiment(result).startswith("2 sessions: no gait with a travelling wave")


@pytest.mark.nightly
def test_the_json_object(weak, tmp_path, report_of):
    out = tmp_path / "experiment.json"
    words = ["analyse", *map(str, weak), "--start", "0.02"]
    printed = report_of(*words, "-o", out)
    assert json.loads(out.read_text()) == printed
    keys = "answer sessions runs heterogeneity reversal pooled coupling oscillators best_linear"
    keys += " body_connection"
    assert list(printed) == [*keys.split(), "warnings", "provenance"]
    assert [session["session"]["path"] for session in printed["sessions"]] == [
        str(path) for path in weak
    ]
    reversal = printed["reversal"]
    assert reversal["p"] == pytest.approx(2 / 924)
    assert (reversal["pairs"][0]["name"], len(reversal["joints"])) == ("joint07", M)
    assert (printed["coupling"]["identifiable"], printed["oscillators"]) == (False, None)
    assert shlex.split(printed["provenance"]["command"]) == ["undulog", *words]
    assert set(printed["provenance"]["inputs"]) == {str(path) for path in weak}
    for index in printed["heterogeneity"].values():
        assert {"value", "ci95", "p", "unit", "label"} == set(index)


@pytest.mark.nightly
def test_the_first_line_is_the_answer(weak, alike, command):
    lines = command("analyse", *weak).out.splitlines()
    assert lines[0].startswith(
        "12 sessions: the modules differ: joint07 answers less than its mirror joint19 (p = 0.002)"
    )
    assert any(line.startswith("A tilted floor is excluded: ") for line in lines)
    assert any("blind to what is alike at both joints of a mirror pair" in line for line in lines)
    method = next(line for line in lines if line.startswith("Method: reversal, 6 + 6 runs"))
    assert "all 924" in method
    assert all(line.startswith("Note: ") for line in lines[lines.index(method) + 1 :])
    text = render_experiment(experiment(alike[::2]), width=80)
    assert text.startswith("6 sessions: 6 runs pooled: The segments do not move alike: ")
    assert max(len(line) for line in text.splitlines()[1:]) <= 80
