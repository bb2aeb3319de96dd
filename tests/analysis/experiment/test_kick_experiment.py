"""Sessions with kicks as one experiment: written to files, answered by a planted matrix."""

import json
import math
import re
from itertools import product

import kick_tables
import numpy as np
import pytest

from support import linear_chain
from support.analysed import experiment
from support.linear_chain import M, asymmetry, within
from undulog.analysis.present.text_experiment import render_experiment
from undulog.analysis.results.coupling import LocalCoupling

pytestmark = pytest.mark.nightly

H, BASE = kick_tables.chain(M)
TRUTH = H * BASE[None, :] / (H @ BASE)[:, None]
SIGMA = 0.002


def write_run(path, off, seed):
    """Six cycles at 50 Hz, started at any time, without physics."""
    command = BASE * np.exp(off + 1j * np.random.default_rng(seed).uniform(-np.pi, np.pi))
    return linear_chain.write_run(path, command, H @ command, seed, SIGMA)


def deviations():
    """The gait, each joint kicked four ways, and two patterns of all joints."""
    kicks = [sign * step * unit for step in (0.05j, 0.05) for unit in np.eye(M) for sign in (1, -1)]
    return [np.zeros(M), *kicks, *(1j * np.random.default_rng(4).uniform(-0.15, 0.15, (2, M)))]


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kicks")
    return [write_run(folder / f"run{k:02d}.mcap", off, k) for k, off in enumerate(deviations())]


@pytest.fixture(scope="module")
def result(sessions):
    return experiment(sessions)


def test_the_matrices_are_those_planted(result):
    coupling = result.coupling
    assert isinstance(coupling, LocalCoupling)
    assert coupling.identifiable
    assert (coupling.base_runs, coupling.kicked_runs) == (1, 4 * M)
    inside = 0
    truths = (TRUTH.real, -TRUTH.imag, TRUTH.real, TRUTH.imag)
    for matrix, truth in zip((coupling.P, coupling.R, coupling.G, coupling.S), truths, strict=True):
        # A central difference of 0.05 keeps curvature of third order, 4e-4 here.
        off = np.abs(np.array(matrix.value) - truth)
        inside += np.sum(off <= np.array(matrix.ci95_half) + 5e-4)
        assert off.max() < 5 * np.max(matrix.standard_error) + 5e-4
    assert inside >= 0.9 * 4 * M * M
    # sigma sqrt(2/N)/|a| a run, two runs a difference, over 0.1.
    expected = SIGMA * math.sqrt(2 / 300) / np.abs(H @ BASE) * math.sqrt(2) / 0.1
    ratio = np.mean(coupling.P.standard_error, axis=1) / expected
    # Never below the noise within runs; above it by what nine combinations of runs tell.
    assert ratio.min() > 0.7
    assert ratio.max() < 2.0
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.25)
    assert coupling.checks_pass
    for rows, total in ((coupling.phase_rows, 1.0), (coupling.gain_rows, 0.0)):
        assert all(row.expected == total for row in rows)
        assert all(abs(row.total.value - total) < 5 * row.standard_error + 5e-4 for row in rows)


def test_a_linear_chain_is_found_linear(result):
    coupling = result.coupling
    assert coupling.nonlinearity.ci95[0] == 0.0 <= coupling.nonlinearity.value < 0.02
    assert coupling.lti.condition_number == pytest.approx(np.linalg.cond(H), rel=0.02)
    error = 4 * np.max(coupling.P.standard_error)  # of P; |a_i / c_j| is about 1
    np.testing.assert_allclose(np.array(coupling.lti.real), H.real, atol=error)
    np.testing.assert_allclose(np.array(coupling.lti.imag), H.imag, atol=error)
    X, lti = np.linalg.inv(H), coupling.lti
    for estimate, truth in ((lti.asymmetry, asymmetry(X)), (lti.within_1, within(X, 1))):
        assert estimate.ci95[0] <= truth <= estimate.ci95[1]


def test_what_oscillators_would_do_on_this_body(result):
    body = result.oscillators
    truth = np.linalg.eigvals(np.eye(M) - TRUTH.real)
    truth = truth[np.abs(truth) > 1e-9]
    assert len(body.modes) == M - 1
    # These rates lie close together: what holds of each is the level that noise allows.
    grid = np.array(body.pseudospectrum.real), np.array(body.pseudospectrum.imag)
    level = np.array(body.pseudospectrum.level)
    for rate in truth:
        k, q = np.argmin(np.abs(grid[0] - rate.real)), np.argmin(np.abs(grid[1] - rate.imag))
        off = abs(grid[0][k] - rate.real) + abs(grid[1][q] - rate.imag)
        assert level[k, q] <= body.pseudospectrum.noise + off
    assert body.slowest.value == min(mode.real.value for mode in body.modes)
    relative = np.array(body.entrainment.value) - (np.linalg.inv(TRUTH.real) - np.eye(M))
    half = np.array(body.entrainment.ci95_half) + 1e-3
    assert np.mean(np.abs(relative) <= half) >= 0.84  # 25 of 95 %: 3 standard deviations below
    assert body.entrainment.condition_number == pytest.approx(np.linalg.cond(TRUTH.real), rel=0.05)
    assert level.shape == (len(body.pseudospectrum.real), len(body.pseudospectrum.imag))
    assert "explicit coupling" in body.answer
    text = render_experiment(result)
    assert f"Oscillators that feel their servos: {body.answer}." in text.splitlines()
    assert json.dumps(result.to_dict()["oscillators"], allow_nan=False)


def test_held_out_runs_are_predicted(result):
    coupling = result.coupling
    assert [pattern.session for pattern in coupling.held_out] == ["run21.mcap", "run22.mcap"]
    for pattern in coupling.held_out:
        assert 2 * pattern.error < pattern.error_kept
        assert 0.05 < pattern.size <= 0.2
    assert coupling.valid_to == max(pattern.size for pattern in coupling.held_out)


def test_roles_warnings_and_text(result, sessions):
    assert [run.role for run in result.runs] == ["base"] + ["kick"] * 4 * M + ["held-out"] * 2
    assert all(run.why is None for run in result.runs)
    assert (result.warnings, result.reversal) == ((), None)
    text = render_experiment(result)
    for line in (
        r"\A23 sessions: coupling around this gait: j.*nonlinearity",
        r"Time shift: rows of P sum to 1.*pass",
        r"condition number.*linear time-invariant|linear time-invariant.*condition number",
        r"^Valid for deviations up to 0\.",
        "^Method: local kicks, 20 runs around 1 without a kick",
    ):
        assert re.search(line, text, re.MULTILINE), line


@pytest.mark.nightly
def test_the_json_object(sessions, report_of):
    coupling = report_of("analyse", *sessions)["coupling"]
    assert coupling["identifiable"] is True
    assert (coupling["record"], coupling["matrix"]) == (None, coupling["P"]["value"])
    assert coupling["condition_number"] == coupling["lti"]["condition_number"]
    for name, field in product("PRGS", ("value", "standard_error", "ci95_half")):
        assert np.shape(coupling[name][field]) == (M, M)


@pytest.mark.nightly
def test_the_order_of_the_files_does_not_matter(result, sessions):
    again = experiment(sessions[::-1]).coupling
    np.testing.assert_allclose(again.P.value, result.coupling.P.value, atol=1e-9)
    assert again.checks_pass


@pytest.mark.nightly
def test_phase_kicks_alone_give_p_and_r(sessions):
    result = experiment(sessions[: 1 + 2 * M])
    coupling = result.coupling
    assert coupling.identifiable
    assert (coupling.G, coupling.S, coupling.nonlinearity.value) == (None, None, None)
    assert any("G, S and the nonlinearity are null" in warning for warning in result.warnings)
    assert any("record held-out runs" in warning for warning in result.warnings)
    assert json.dumps(result.to_dict(), allow_nan=False)


def test_one_sided_kicks_are_not_identifiable(sessions):
    result = experiment([*sessions[:4], *sessions[5 : 1 + 2 * M]])
    coupling = result.coupling
    assert not coupling.identifiable
    assert coupling.matrix is None
    assert "kicked is j2 only up" in coupling.why
    assert "phase-kicks around this gait" in coupling.record
    assert result.answer.startswith("coupling not identifiable from these kicks: central")
    assert any("Coupling: not identifiable" in x for x in render_experiment(result).splitlines())


def test_runs_of_one_gait_stay_not_identifiable(sessions):
    coupling = experiment(sessions[:1]).coupling
    assert not coupling.identifiable
    assert not isinstance(coupling, LocalCoupling)
    assert "one gait gives 5 complex numbers for 25 unknown couplings" in coupling.why
