"""Null model files: there and back, and read strictly."""

import json

import numpy as np
import pytest

from undulog.capture.common.errors import InputFileError, NullModelError
from undulog.capture.robot import null_model


def some_model():
    rng = np.random.default_rng(1)

    def y(*shape):
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    bend = y(2, 2, 3)
    return null_model.NullModel(
        robot="snake",
        frequency_hz=0.5,
        joints=("a", "b", "c"),
        command=0.4 * np.exp(1j * np.arange(3)),
        parameters=(
            null_model.SharedParameter("stall_torque", "N m", 0.25, 0.2),
            null_model.SharedParameter("mu_normal", "1", 0.5, 0.3),
        ),
        covariance=np.array([[0.04, 0.01], [0.01, 0.09]]),
        response=y(3),
        slope=y(2, 3),
        curvature=bend + bend.swapaxes(0, 1),
        modules={"stall_torque": y(3, 3)},
        error=0.001,
        made_by="this test",
    )


def test_there_and_back(tmp_path):
    model, path = some_model(), tmp_path / "model.json"
    null_model.write_null_model(path, model)
    again = null_model.read_null_model(path)
    for name in ("response", "slope", "curvature", "covariance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name))
    np.testing.assert_allclose(again.command, model.command, rtol=1e-15)
    np.testing.assert_array_equal(again.modules["stall_torque"], model.modules["stall_torque"])
    assert again.parameters == model.parameters
    assert (again.joints, again.robot, again.error) == (model.joints, model.robot, model.error)


def test_its_slope_is_that_of_its_value():
    model, x = some_model(), np.array([0.1, -0.2])
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        numeric = (model.at(x + step)[0] - model.at(x - step)[0]) / 2e-6
        np.testing.assert_allclose(model.at(x)[1][k], numeric, atol=1e-8)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"response": {"log_gain": [1, 2], "lag_rad": [0, 0, 0]}}, "response.log_gain.*3 finite"),
        ({"slope": {"log_gain": [[1, 2, 3]], "lag_rad": [[1, 2, 3]]}}, "slope.log_gain.*2 x 3"),
        ({"covariance": [[1, 2], [2, 1]]}, "covariance.*positive definite"),
        ({"modules": []}, "modules.*at least one kind"),
        ({"error": -1}, "error.*>= 0"),
        ({"eror": 0}, "eror: found an unknown key.*did you mean error"),
        ({"format": "undulog null model 9"}, "format.*undulog null model 1"),
    ],
)
def test_faults_are_named(tmp_path, change, fault):
    path = tmp_path / "model.json"
    null_model.write_null_model(path, some_model())
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(NullModelError, match=fault):
        null_model.read_null_model(path)


def test_what_is_no_json(tmp_path):
    path = tmp_path / "model.json"
    path.write_text("{")
    with pytest.raises(NullModelError, match="syntax"):
        null_model.read_null_model(path)
    with pytest.raises(InputFileError, match="no such file"):
        null_model.read_null_model(tmp_path / "none.json")
