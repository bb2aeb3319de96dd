"""Every shipped scenario through the analysis: no false artefact, and the power balance closes."""

import numpy as np
import pytest

from analysis.analyse import analyse_session
from capture import Session
from sim import load_scenario
from sim.physics.engine import Kernels
from sim.record import record

STEADY = [
    *("caterpillar", "caterpillar-pi2", "combined", "delay-blocks", "flat", "horizontal"),
    *("oscillators", "oscillators-feedback", "oscillators-one-way", "rolling", "sidewinding"),
    *("snake13-horizontal-pi2", "snake13-horizontal-pi3", "snake13-phi0-pi2", "snake13-phi0-pi3"),
    *("snake13-planar-pi2", "snake13-planar-pi3", "snake13-vertical-pi2", "snake13-vertical-pi3"),
    *("twist", "vertical", "weak-servo-pi3", "weak-servo-pi3-reverse"),
]
ADAPTIVE = ["avoidance", "corridor", "side-sensor-amplitude"]


def analysed(name, folder):
    pytest.importorskip("pybullet")
    pytest.importorskip("numba")
    path = folder / f"{name}.mcap"
    record(load_scenario(name), path, kernels=Kernels.NUMBA)
    with Session.open(path) as session:
        return analyse_session(session)


def sensor_flags(result):
    return [(one.joint, one.flag) for one in result.artefacts if one.about == "sensor"]


@pytest.mark.slow
@pytest.mark.parametrize("name", STEADY)
def test_a_steady_scenario_closes_its_balance_and_has_sound_sensors(name, tmp_path):
    result = analysed(name, tmp_path)
    assert sensor_flags(result) == []
    closure = result.energy.closure
    assert abs(closure.mechanical_balance) <= 0.005
    assert abs(closure.electrical_balance) <= 0.005
    # Samples once a control period miss ripple within it: in the lightest, stiffest chain more.
    assert abs(closure.net) <= (0.03 if name == "snake13-planar-pi2" else 0.005)
    for joint, cycles in zip(result.joints, result.energy.joints, strict=True):
        assert sum(cycles.net_j) == pytest.approx(joint.energy_net_j)
        assert min(cycles.coverage) > 1 - 1.01 * 0.01 * result.gait.frequency_hz.value  # one sample
    assert result.energy.electrical == "simulated"


@pytest.mark.slow
@pytest.mark.parametrize("name", ADAPTIVE)
def test_an_adaptive_scenario_gives_sense_over_time(name, tmp_path):
    result = analysed(name, tmp_path)
    assert sensor_flags(result) == []
    driven = result.over_time.joints
    assert len(driven) == 13
    for joint in driven:
        gain = np.array(joint.gain, dtype=float)
        lag = np.array(joint.lag_rad, dtype=float)
        assert gain.size >= 6
        told = ~np.isnan(gain)  # one that couldn't be told in a cycle is null, and so is its lag
        assert told.sum() >= gain.size - 1
        np.testing.assert_array_equal(np.isnan(lag), ~told)
        gain, lag = gain[told], lag[told]
        assert ((gain > 0.7) & (gain < 1.3)).all()
        assert ((lag > 0.0) & (lag < 0.7)).all()
        intervals = [ends for ends in joint.gain_ci95 if ends is not None]
        assert all(low < one < high for one, (low, high) in zip(gain, intervals, strict=True))
    if name == "avoidance":  # it hastens, and the lag in rad grows with the frequency
        rates = np.array(driven[6].frequency_hz)
        lags = np.array(driven[6].lag_rad)
        assert rates.max() > 1.3 * rates.min()
        assert np.corrcoef(rates[1:], lags[1:])[0, 1] > 0.5
    result.to_dict()
