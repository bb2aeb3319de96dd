"""Held against a model of identical modules: level, power and names where the truth is planted."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize

from undulog.analysis.experiment.null_model import null_test
from undulog.analysis.response.response import Response
from undulog.capture.common.errors import DataError
from undulog.capture.robot.null_model import NullModel, SharedParameter

JOINTS = 7
NOISE = 0.002
REACH = 0.3


def planted(curvature=0.0, spread=0.2):
    """A model in closed form: smooth boundary patterns of theta, local effects of the modules."""
    place = np.linspace(-1, 1, JOINTS)
    names = ("stall_torque", "proportional_gain", "mu_normal")
    slope = np.stack([0.3 + 0.2j - 0.1 * place**2, 0.1 - 0.3j * place**2, 0.05 * place + 0.04j])
    near = np.exp(-((np.arange(JOINTS)[:, None] - np.arange(JOINTS)) ** 2) / 0.8)
    bend = np.zeros((3, 3, JOINTS), dtype=complex)
    bend[0, 0] = curvature * (1 + 0.5j * place)
    bend[0, 2] = bend[2, 0] = -curvature * place
    return NullModel(
        robot="planted",
        frequency_hz=0.5,
        joints=tuple(f"joint{k + 1}" for k in range(JOINTS)),
        command=0.4 * np.exp(-1j * np.arange(JOINTS)),
        parameters=tuple(SharedParameter(name, "1", 1.0, REACH) for name in names),
        covariance=spread**2 * np.eye(3),
        response=0.05 * place**2 - 0.2j + 0.1j * place**2,
        slope=slope,
        curvature=bend,
        modules={"stall_torque": (0.08 + 0.12j) * near, "mass": (0.02 - 0.03j) * near},
        error=0.0,
        made_by="this test",
    )


def answered(rng, model, x, deviation=(), *, dof=24, noise=NOISE):
    """One session's responses; ``deviation`` is of kind, module and size."""
    y = model.response + np.einsum("k,km->m", x, model.slope)
    y = y + np.einsum("k,l,klm->m", x, x, model.curvature) / 2
    for kind, module, size in deviation:
        y = y + size * model.modules[kind][module]
    level = rng.chisquare(dof, JOINTS) / dof * noise**2
    y = y + rng.normal(0, noise, JOINTS) + 1j * rng.normal(0, noise, JOINTS)
    return Response(np.exp(y), level, level, np.full(JOINTS, float(dof)))


def verdict(response, model):
    return null_test(response, np.arange(JOINTS), model)


def test_it_is_generalised_least_squares():
    """Q1 and Lambda against SciPy's own minimiser of the same sum of squares."""
    model = planted(curvature=0.4)
    rng = np.random.default_rng(1)
    seen = answered(rng, model, np.array([0.1, -0.05, 0.2]), [("stall_torque", 2, -0.1)])
    y = np.log(seen.ratio)

    def q(unknown, module=None):
        x = unknown[:3]
        f = model.response + x @ model.slope + np.einsum("k,l,klm->m", x, x, model.curvature) / 2
        if module is not None:
            f = f + unknown[3] * model.modules["stall_torque"][module]
            f = f + unknown[4] * model.modules["mass"][module]
        r = y - f
        return np.sum((r.real**2 + r.imag**2) / seen.lag_variance) + np.sum(x**2) / 0.2**2

    judgement = verdict(seen, model)
    free = minimize(q, np.zeros(3), tol=1e-10)
    assert (judgement.fit, judgement.named) == (pytest.approx(free.fun, rel=1e-6), (2,))
    other = minimize(q, np.zeros(5), args=(2,), tol=1e-10)
    np.testing.assert_allclose(judgement.x, other.x[:3], atol=1e-4)
    np.testing.assert_allclose(
        judgement.deviation[2], other.x[3:], atol=0.01 * judgement.error[2].max()
    )
    # Lambda of a named module is that of the system linear at H2, Q1 isn't: a few per cent apart.
    assert judgement.gain[2] == pytest.approx(free.fun - other.fun, rel=0.1)


@pytest.mark.nightly
@pytest.mark.parametrize(("curvature", "dof"), [(0.0, 6), (0.4, 24)])
def test_a_shift_of_the_shared_parameters_is_absorbed(curvature, dof):
    """Identical modules, theta drawn from the prior: 5 % false alarms, family-wise."""
    model = planted(curvature, spread=0.1)
    rng = np.random.default_rng(2)
    alarms, misfits, held = 0, 0, 0
    for _ in range(200):
        judgement = verdict(answered(rng, model, 0.1 * rng.normal(size=3), dof=dof), model)
        alarms += bool(judgement.named)
        misfits += judgement.fit_p < 0.05
        held += (np.abs(judgement.deviation) <= judgement.critical * judgement.error).all()
    # 200 at 5 %: standard error 1.5 %.
    assert 0.02 < alarms / 200 < 0.085
    assert 0.02 < misfits / 200 < 0.085
    assert 0.915 < held / 200 < 0.98


@pytest.mark.parametrize(
    "module",
    [
        pytest.param(3, marks=pytest.mark.slow),
        *(pytest.param(k, marks=pytest.mark.nightly) for k in (0, 2, 6)),
    ],
)
def test_a_weak_module_is_found_and_named(module):
    """Also the middle one, to which a reversal is blind."""
    model = planted()
    rng = np.random.default_rng(3)
    right = held = 0
    for _ in range(20):
        x = 0.15 * rng.normal(size=3)
        judgement = verdict(answered(rng, model, x, [("stall_torque", module, np.log(0.8))]), model)
        right += judgement.named[:1] == (module,)
        off = np.abs(judgement.deviation[module] - [np.log(0.8), 0.0])
        held += (off <= judgement.critical * judgement.error[module]).all()
        assert judgement.fit_p < 0.05
    assert right == 20
    assert held >= 18


def test_two_modules_are_named_one_after_the_other():
    model = planted()
    rng = np.random.default_rng(4)
    changes = [("stall_torque", 1, np.log(0.7)), ("mass", 5, np.log(3.0))]
    seen = answered(rng, model, np.zeros(3), changes)
    judgement = verdict(seen, model)
    assert set(judgement.named[:2]) == {1, 5}
    assert judgement.rest_p > 0.05
    assert judgement.deviation[1, 0] == pytest.approx(np.log(0.7), abs=0.1)
    assert judgement.deviation[5, 1] == pytest.approx(np.log(3.0), abs=0.3)


def test_the_models_own_error_is_noise():
    """Nothing at the model's own parameters, all of it at the end of its reach."""
    model = dataclasses.replace(planted(), error=0.01)
    for x, named in ((np.zeros(3), (3,)), (np.array([0.0, 0.0, REACH]), ())):
        seen = answered(np.random.default_rng(5), model, x, [("mass", 3, 0.1)], noise=2e-4)
        assert verdict(seen, model).named == named


def test_joints_without_an_answer_are_left_out():
    model = planted()
    seen = answered(np.random.default_rng(6), model, np.zeros(3), [("stall_torque", 4, -0.3)])
    some = np.array([0, 1, 3, 4, 5, 6])
    assert null_test(seen.select(some), some, model).named[:1] == (4,)
    with pytest.raises(DataError, match="1 joints with gain and lag are too few"):
        null_test(seen.select([0]), np.array([0]), model)
