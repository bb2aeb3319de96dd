"""Least squares without negative unknowns: SciPy's active set, and the conditions of an optimum."""

import numpy as np
import pytest
from scipy.optimize import nnls

from undulog.analysis.estimators.nonnegative import nonnegative_least_squares


@pytest.mark.parametrize("columns", [1, 3, 26, 60])
def test_scipy_finds_the_same(columns: int) -> None:
    rng = np.random.default_rng(columns)
    matrices = rng.normal(size=(40, columns + 5, columns))
    matrices[::3] += rng.normal(size=(14, columns + 5, 1))  # nearly collinear columns
    measured = rng.normal(size=(40, columns + 5))
    transposed = matrices.transpose(0, 2, 1)
    x = nonnegative_least_squares(transposed @ matrices, (transposed @ measured[..., None])[..., 0])
    for matrix, y, solution in zip(matrices, measured, x, strict=True):
        assert solution == pytest.approx(nnls(matrix, y)[0], rel=1e-7, abs=1e-9)


def test_optimality_holds_where_all_or_nothing_is_zero() -> None:
    normal = np.array([[[2.0, 1.0], [1.0, 2.0]]] * 3)
    right = np.array([[-1.0, -1.0], [3.0, 3.0], [0.0, 0.0]])
    x = nonnegative_least_squares(normal, right)
    assert x == pytest.approx(np.array([[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]]))


def test_no_problem_and_no_unknown() -> None:
    assert nonnegative_least_squares(np.zeros((0, 3, 3)), np.zeros((0, 3))).shape == (0, 3)
