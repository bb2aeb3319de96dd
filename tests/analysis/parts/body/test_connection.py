"""The fitted connection against that of a viscous swimmer in closed form, and what is refused."""

import dataclasses

import numpy as np
import pytest

from support.viscous_swimmer import Swimmer, perturbed_gaits
from undulog.analysis import load
from undulog.analysis.experiment.body_connection import (
    GaitSession,
    body_connection,
    connection_detail,
)
from undulog.analysis.parts.body.connection import MOST_CONDITION, distances, fit_connection
from undulog.analysis.parts.body.travel import wave_at
from undulog.capture.common.errors import DataError

pytestmark = pytest.mark.nightly

PHASES = 2 * np.pi * np.arange(24) / 24
SWIMMER = Swimmer()


def cycles(count=16, size=0.1, seed=0, joints=6):
    return [SWIMMER.cycle(shape) for shape in perturbed_gaits(joints, count, size, seed)]


@pytest.fixture(scope="module")
def base_cycles():
    return cycles()


def truth(base):
    angles = base.mean[:, None] + base.modes @ wave_at(base.cycle, PHASES)
    return np.stack([SWIMMER.connection(angle) @ base.modes for angle in angles.T])


@pytest.mark.parametrize("seed", [0, 1])
def test_the_connection_is_that_of_force_and_moment_balance(base_cycles, seed):
    model = fit_connection(base_cycles if seed == 0 else cycles(12, 0.12, seed))
    assert model.identified
    value, half = model.matrices(PHASES)
    expected = truth(model.base)
    assert np.mean(np.abs(value - expected) <= half) > 0.9
    size = np.sqrt(np.mean(expected**2, axis=0)).max(axis=1)
    assert np.all(np.sqrt(np.mean((value - expected) ** 2, axis=0)).max(axis=1) < 0.4 * size)
    assert np.all(np.sqrt(np.mean((value - expected) ** 2, axis=0))[0] < 0.1 * size[0])


def test_errors_fall_with_the_size_of_the_perturbations():
    def error(size):
        model = fit_connection(cycles(16, size))
        return np.linalg.norm(model.matrices(PHASES)[0] - truth(model.base))

    assert error(0.05) < 0.4 * error(0.2)


def test_a_held_out_gait_is_predicted_within_its_interval(base_cycles):
    model = fit_connection(base_cycles)
    held = cycles(16, size=0.07, seed=5)[1:]
    inside = [cycle for cycle in held if model.outside(cycle.shape) is None]
    assert len(inside) > 8
    hits = []
    for cycle in inside:
        value, half = model.predict(cycle.shape)
        hits.append(np.abs(value - cycle.steps[0]) <= half)
        assert abs(value[0] - cycle.steps[0, 0]) < 0.02 * cycle.steps[0, 0]
    assert np.mean(hits) > 0.9


def test_speed_and_phase_of_a_gait_do_not_matter(base_cycles):
    shift = np.exp(1j * 0.7 * np.arange(base_cycles[0].shape.shape[1]))
    moved = [SWIMMER.cycle(cycle.shape * shift, omega=5.0) for cycle in base_cycles[1:4]]
    fit, other = (
        fit_connection(base_cycles),
        fit_connection([base_cycles[0], *moved, *base_cycles[4:]]),
    )
    shape = base_cycles[5].shape
    np.testing.assert_allclose(fit.predict(shape)[0], other.predict(shape * shift)[0], rtol=1e-6)


def test_a_prediction_at_another_speed_has_no_interval_or_is_refused(base_cycles):
    def at(k, frequency):
        return GaitSession(f"{k}", dataclasses.replace(base_cycles[k], omega=2 * np.pi * frequency))

    speeds = {3: 0.52, 5: 1.0, 7: 0.72}
    sessions = [at(k, speeds.get(k, 0.5)) for k in range(len(base_cycles))]
    connection, why = body_connection(sessions)
    assert why == {5: "has another speed: its frequency is 2 times the median of the sessions"}
    assert connection.gaits == 15
    bare = [
        prediction.path
        for prediction in connection.predicted
        if prediction.why is None and prediction.forward_m.ci95 is None
    ]
    assert set(bare) <= {"5", "7"}
    assert "7" in bare
    sentence = f"No interval for {len(bare)} of the predictions: the gait's frequency is more"
    assert any(line.startswith(sentence) for line in connection_detail(connection))
    connection, why = body_connection([*sessions[:5], at(5, 4.0), *sessions[6:]])
    assert list(why) == [5]
    assert "inertia is not in the model" in connection.predicted[5].why


def test_an_experiment_with_a_model_is_saved_and_loaded(base_cycles, both_ways, tmp_path):
    body, _ = body_connection(
        [GaitSession(f"{k}", cycle) for k, cycle in enumerate(base_cycles[:9])]
    )
    assert body.A
    whole = dataclasses.replace(both_ways, body_connection=body)
    assert load(whole.save(tmp_path / "experiment.json")) == whole


def test_outside_the_range_names_the_mode_and_how_far(base_cycles):
    model = fit_connection(base_cycles)
    far = model.base
    third = np.zeros_like(base_cycles[0].shape)
    third[:, 0] = 2 * far.largest[2] * far.modes[:, 2]
    why = model.outside(base_cycles[0].shape + third)
    assert why.startswith("shape mode 3 is perturbed by")
    assert "times the largest perturbation that the model is fitted to" in why
    fourth = np.linalg.qr(np.column_stack([far.modes, np.arange(6.0)]))[0][:, 3]
    strange = base_cycles[0].shape.copy()
    strange[:, 1] += 0.2 * fourth
    assert "are in none of the modes" in model.outside(strange)


def test_a_kind_of_perturbation_that_no_gait_shows_is_refused():
    """Gaits that differ in amplitude only say nothing about a wave that is partly standing."""
    wave = perturbed_gaits(6, 1, 0.0, 0)[0]
    alike = [SWIMMER.cycle(wave * (1 + 0.02 * k)) for k in range(-5, 6)]
    model = fit_connection(alike)
    assert not model.identified
    assert model.condition > MOST_CONDITION
    assert model.outside(wave * 1.05) is None
    standing = wave.copy()
    standing[:, 1] += 0.03 * wave[:, 1].conj()
    assert "in a way that no gait of the model shows" in model.outside(standing)


@pytest.mark.parametrize("count", [1, 7])
def test_too_few_gaits_are_refused(base_cycles, count):
    with pytest.raises(DataError, match=r"at least 8 gaits .* condition number is ") as caught:
        fit_connection(base_cycles[:count])
    assert ("inf" in str(caught.value)) is (count == 1)


def test_repeats_of_one_gait_are_refused(base_cycles):
    random = np.random.default_rng(1)
    noisy = [
        SWIMMER.cycle(
            base_cycles[0].shape * (1 + 1e-3 * random.standard_normal(base_cycles[0].shape.shape))
        )
        for _ in range(10)
    ]
    with pytest.raises(DataError, match="the 10 gaits are too much alike: the condition number"):
        fit_connection(noisy)


def test_a_reversed_wave_is_another_gait(base_cycles):
    reverse = SWIMMER.cycle(base_cycles[0].shape[::-1])
    off = distances([*base_cycles, reverse])
    assert off[-1] > 1
    assert np.all(off[:-1] < 0.3)
    connection, why = body_connection(
        [None, *(GaitSession(f"{k}", cycle) for k, cycle in enumerate(base_cycles))]
    )
    assert connection.fitted
    assert connection.gaits == len(base_cycles)
    assert why == {0: "has no planar gait with the head's pose and all joint angles"}
    both = [
        GaitSession(f"{k}", cycle)
        for k, cycle in enumerate([*base_cycles, reverse, base_cycles[3]])
    ]
    connection, why = body_connection(both)
    assert connection.gaits == len(base_cycles)
    assert "is another gait: its joint angles differ from the central one by 1" in why[16]
    assert why[17] == "is a copy of another session"
    assert connection.predicted[16].why.startswith("shape mode")
    lone = body_connection(both[:1])[0]
    assert not lone.fitted
    assert lone.condition_number is None
