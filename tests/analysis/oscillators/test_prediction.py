"""The predicted closed loop against closed forms and against oscillators that are integrated."""

import dataclasses
import json
import math

import kick_tables
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import undulog
from support import linear_chain
from support.kick_runs import kicked
from support.linear_chain import CHAIN, WAVE
from undulog.analysis.experiment.kick_coupling import kick_coupling
from undulog.analysis.experiment.kick_prediction import closed_loop
from undulog.analysis.oscillators.laplacian import of_deviations
from undulog.analysis.oscillators.predictions import path_laplacian
from undulog.analysis.results.coupling import BaseResponse, LocalCoupling, Matrix, rows_of
from undulog.capture.common.errors import DataError, UsageError

EPS = 0.3


def measured(random=None, scatter_deg=0.0, m=5):
    """A kick experiment on a linear chain, analysed."""
    H, c = kick_tables.chain(m)
    random = random or np.random.default_rng(1)
    noise = 1e-6 if scatter_deg == 0.0 else None
    scatter = math.radians(scatter_deg)
    experiment = kicked(random, H, c, kick_tables.plan(m), scatter, noise=noise)
    return H, c, kick_coupling(experiment, lambda _: None)


def exact(P, R, gain=1.0, lag=0.0):
    """A coupling that is known without error."""
    m = len(P)
    zero, nothing = rows_of(np.zeros((m, m))), (0.0,) * m
    base = BaseResponse(0.5, (gain,) * m, (lag,) * m, nothing, nothing)
    P, R = (Matrix(rows_of(value), zero, zero) for value in (P, R))
    return dataclasses.replace(measured(m=m)[2], P=P, R=R, base=base)


@pytest.mark.parametrize("m", [4, 7])
def test_a_path_relaxes_at_its_closed_form(m):
    K = 0.2
    predicted = closed_loop(exact(np.eye(m) - K * path_laplacian(m), np.zeros((m, m))), EPS)
    rates = 4 * EPS * K * np.sin(np.arange(1, m) * math.pi / (2 * m)) ** 2
    np.testing.assert_allclose([mode.rate.value for mode in predicted.modes], rates, atol=1e-9)
    for mode, rate in zip(predicted.modes, rates, strict=True):
        assert mode.rate.ci95 == pytest.approx((rate, rate))
    slowest = np.cos((np.arange(m) + 0.5) * math.pi / m)
    pattern = np.array(predicted.modes[0].pattern_abs)
    np.testing.assert_allclose(pattern, np.abs(slowest) / np.linalg.norm(slowest), atol=1e-9)
    assert f"of {m - 1} patterns of the phases {m - 1} relax" in predicted.answer


def test_gain_lag_and_age_enter_as_the_equation_has_them():
    random = np.random.default_rng(2)
    P = np.eye(4) - 0.1 * path_laplacian(4)
    R = random.normal(size=(4, 4))
    R -= R.mean(axis=1, keepdims=True)
    g, lag, age = 0.8, 0.3, 0.02
    predicted = closed_loop(exact(P, R, g, lag), EPS, age_s=age)
    turn = -lag - 2 * math.pi * 0.5 * age
    J = EPS * (g * math.cos(turn) * (P - np.eye(4)) + g * math.sin(turn) * R)
    np.testing.assert_allclose(predicted.J, J, atol=1e-12)
    np.testing.assert_allclose(predicted.bias, g * math.sin(turn))


def test_integrated_oscillators_do_what_is_predicted():
    """phi' = eps (mean of 2 (q/A) cos phi - b), q = Im(H A e^(j phi)): nothing linearised."""
    H, c, coupling = measured()
    A, phase = np.abs(c), np.angle(c)
    kick = {"j2": 0.03, "j4": -0.02}
    off = np.array([kick.get(name, 0.0) for name in coupling.joints])
    predicted = closed_loop(coupling, EPS, kick=kick, until_s=20.0)
    bias = np.array(predicted.bias)

    def rate(_, d):
        c_now = A * np.exp(1j * (phase + d))
        return EPS * (((H @ c_now) / c_now).imag - bias)

    done = solve_ivp(
        rate, (0.0, 20.0), off, t_eval=predicted.relaxation.times_s, rtol=1e-9, atol=1e-12
    )
    error = np.linalg.norm(np.array(predicted.relaxation.phase_rad) - done.y.T, axis=1)
    assert np.linalg.norm(done.y.T[-1] - off) > 0.3 * np.linalg.norm(off)
    assert error.max() < 0.03 * np.linalg.norm(off)  # second order in a kick of 0.03 rad


def rates_of(H, c):
    """J of a linear chain, in closed form."""
    L = H * c[None, :] / (H @ c)[:, None]
    felt = (H @ c) / c
    return EPS * (felt.real[:, None] * (L.real - np.eye(5)) - felt.imag[:, None] * L.imag)


@pytest.mark.parametrize(
    "draws", [pytest.param(8, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.nightly)]
)
def test_intervals_of_rates_hold_under_scatter(draws):
    J = rates_of(*kick_tables.chain(5)) / EPS
    truth = EPS * np.sort(np.linalg.eigvals(of_deviations(np.eye(5) + J)).real)
    random = np.random.default_rng(3)
    inside = []
    for _ in range(draws):
        ends = [mode.rate.ci95 for mode in closed_loop(measured(random, 0.1)[2], EPS).modes]
        # Of the sums: rates that lie close together change places.
        inside += [low <= t <= high for (low, high), t in zip(ends, truth, strict=True)]
    assert np.mean(inside) >= 0.91


@pytest.mark.nightly
def test_what_is_left_of_a_kick_has_an_interval():
    J = rates_of(*kick_tables.chain(5))
    off = 0.1 * (np.arange(5) == 2)
    random = np.random.default_rng(4)
    inside = []
    for _ in range(20):
        coupling = measured(random, 0.03)[2]
        relaxation = closed_loop(coupling, EPS, kick={"j3": 0.1}, until_s=15.0).relaxation
        truth = np.array([expm(J * t) @ off for t in relaxation.times_s])
        low, high = np.array(relaxation.low_rad), np.array(relaxation.high_rad)
        inside.append(np.mean(((low <= truth) & (truth <= high))[1:]))
        assert (high[-1] - low[-1]).max() < 0.05
    assert np.mean(inside) >= 0.91


@pytest.mark.nightly
def test_the_limits_are_stated():
    coupling = measured()[2]
    limited = dataclasses.replace(coupling, valid_to=0.1)
    for given, eps, kick, limit in (
        (coupling, EPS, None, "isn't known"),
        (limited, EPS, {"j1": 0.2}, "beyond 0.1 rad"),
        (limited, EPS, None, "holds for deviations up to 0.1 rad"),
        (limited, 20.0, None, "take a smaller eps"),
        (dataclasses.replace(limited, checks_pass=False), EPS, None, "the prediction is doubtful"),
    ):
        assert limit in closed_loop(given, eps, kick=kick).limits[0]


def test_what_can_not_be_predicted():
    coupling = measured()[2]
    with pytest.raises(UsageError, match="--eps 0"):
        closed_loop(coupling, 0.0)
    with pytest.raises(UsageError, match="--kick k: the joints are j1"):
        closed_loop(coupling, EPS, kick={"k": 0.1})
    with pytest.raises(DataError, match="analyse the sessions again"):
        closed_loop(dataclasses.replace(coupling, base=None), EPS)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The result file of a kick experiment, and one of its sessions."""
    folder = tmp_path_factory.mktemp("kicked")
    files = linear_chain.kicked(folder)
    assert undulog.run(["analyse", *map(str, files), "-o", str(folder / "kicks.json")]) == 0
    return folder / "kicks.json", files


@pytest.mark.nightly
def test_the_verb_takes_sessions_or_their_result(result, tmp_path, command, report_of):
    file, sessions = result
    by_result, direct = (
        report_of("predict", *inputs, "--eps", "0.3")["J"] for inputs in ([file], sessions)
    )
    np.testing.assert_allclose(by_result, direct, atol=1e-12)
    np.testing.assert_allclose(by_result, rates_of(CHAIN, WAVE), atol=0.02)
    output = tmp_path / "predicted.json"
    words = ("predict", file, "--eps", "0.3", "--kick", "j2=0.05", "-o", output)
    text = command(*words).out
    assert text.startswith("With feedback of 0.3 1/s and the body as the only coupling, of 4")
    assert "Of the kick" in text
    assert json.loads(output.read_text())["relaxation"]["times_s"][0] == 0.0
    assert "--force" in command(*words, code=2).err  # it is there
    command(*words, "--force")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("--eps -1", 2, "--eps -1"),
        ("--eps 0.3 --kick j2", 2, "expected JOINT=RAD"),
        ("--eps 0.3 --kick j9=0.1", 2, "the joints are j1"),
        ("--eps 0.3 -o a.csv", 2, "end its name in .json"),
        ("--eps 0.3 --age -1", 2, "--age is at least 0"),
    ],
)
def test_wrong_usage(result, words, code, message, command):
    assert message in command("predict", result[0], *words.split(), code=code).err


@pytest.mark.nightly
def test_sessions_without_kicks_fail_and_say_what_to_record(result, command):
    words = ("predict", result[1][0], "--eps", "0.3")
    assert "phase-kicks around this gait" in command(*words, code=1).err
    command("predict", code=2)


@pytest.mark.nightly
def test_a_result_of_kicks_reads_back(result):
    from undulog.analysis import load

    coupling = load(result[0]).coupling
    assert isinstance(coupling, LocalCoupling)
    assert coupling.base.frequency_hz == pytest.approx(1.0, rel=1e-3)
    assert coupling.scatter.dof > 5
