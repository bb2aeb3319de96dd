"""The study of body couplings: its rows give its page, its measures are those of closed forms."""

import itertools

import numpy as np
import pytest
from study import chains, coupling, heterogeneity, prediction, statements
from study.conclusions import CONCLUSIONS, evaluate
from study.results import results_of
from study.rows import read_rows

from support.paths import DOCS, STUDIES
from undulog.analysis.oscillators.predictions import path_laplacian

LONG = STUDIES / "study/rows/long.parquet"


@pytest.mark.slow
@pytest.mark.built("study")
def test_the_rows_in_the_tree_give_the_page_and_all_conclusions():
    results = results_of(LONG)
    assert [conclusion for conclusion in evaluate(results) if not conclusion.holds] == []
    assert results.digest in (DOCS / "study.md").read_text()


def test_both_engines_give_the_same_couplings_and_predict_up_to_50_joints():
    rows = prediction.rows(STUDIES / "study/rows/prediction")
    chain = ["n", "law", "stall", "amplitude"]
    engines = [rows[(rows.kind == "P") & (rows.engine == engine)] for engine in prediction.ENGINES]
    pairs = engines[0].merge(engines[1], on=chain)
    assert {*zip(pairs.n, pairs.law, strict=True)} >= {
        *itertools.product(prediction.SIZES, prediction.LAWS)
    }
    for first, other in zip(pairs.P_x, pairs.P_y, strict=True):
        np.testing.assert_allclose(np.vstack(first), np.vstack(other), rtol=0, atol=1e-9)
    longest = prediction.summary(rows[(rows.kind == "kick") & (rows.n == 50)])
    assert {*zip(longest.engine, longest.law, strict=True)} == {
        *itertools.product(prediction.ENGINES, prediction.LAWS)
    }
    assert (longest.error <= 0.15).all()
    assert (longest["error/still"] <= 0.4).all()
    assert (longest.below == f"{prediction.PATTERNS}/{prediction.PATTERNS}").all()


@pytest.mark.parametrize(
    ("n", "stall", "gap", "homogeneous", "explicit"),
    [(5, 0.25, -0.034, -0.022, 0.28), (9, 0.25, -0.017, -0.031, 0.68)],
)
def test_kicks_as_rows_give_the_matrix_of_a_kick_experiment(n, stall, gap, homogeneous, explicit):
    """docs/explanation/oscillators.md has these, from sessions by ``analyse_experiment``."""
    rows = read_rows(LONG)
    rows = rows[rows["plan"] == f"kicks-{n}-{stall}"]
    row = coupling.measures(coupling.kicked(rows)).iloc[0]
    assert row["gap"] == pytest.approx(gap, abs=5e-4)
    assert row["homogeneous_gap"] == pytest.approx(homogeneous, abs=5e-4)
    assert row["explicit"] == pytest.approx(explicit, abs=5e-3)


def test_statements_rest_on_conclusions_that_exist():
    names = {conclusion.name for conclusion in CONCLUSIONS}
    assert {name for statement in statements.STATEMENTS for name in statement.conclusions} <= names


@pytest.mark.parametrize("n", [5, 12])
def test_a_path_synchronises_at_the_rate_of_its_closed_form(n):
    """1 - r falls as exp(-2 gap t) once the slowest pattern is left."""
    M = chains.coupling("path", np.eye(n))
    _, order = chains.times(M, draws=40)
    rate = -np.diff(np.log(1.0 - order))[-20:].mean() / chains.STEP / 2.0
    assert rate == pytest.approx(4.0 * np.sin(np.pi / (2 * n)) ** 2, rel=0.02)


def test_neighbours_alone_have_a_reach_of_one():
    P = np.eye(7) - 0.1 * path_laplacian(7)
    assert coupling.band_energy(P, 1) == 1.0
    assert coupling.reach_of(P) == 1
    assert coupling.amplification(P) == pytest.approx(1.0)


def test_a_planted_group_is_found_out_of_sample():
    """Where the outcome depends on one group, its model predicts it, and unrelated ones don't."""
    random = np.random.default_rng(1)
    x, other = random.normal(size=(2, 200))
    y = -1.3 * x + random.normal(0.0, 0.1, 200)
    good, bad = (
        heterogeneity.held_out([heterogeneity.quadratic(inputs)], y)[0] for inputs in (x, other)
    )
    assert good > 0.98
    assert bad < 0.05
