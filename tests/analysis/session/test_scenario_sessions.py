"""Every shipped scenario through the analysis: no false artefact, and energies of the ledger."""

import dataclasses
import re

import energy_tables
import numpy as np
import pytest

from support.paths import DOCS
from undulog.sim import load_scenario, record, scenario_names
from undulog.sim.scenario.scenario import EngineKind, Kernels

STEADY = [
    *("caterpillar", "caterpillar-pi2", "combined", "delay-blocks", "flat", "horizontal"),
    *("oscillators", "oscillators-feedback", "oscillators-one-way", "rolling", "sidewinding"),
    *("snake13-horizontal-pi2", "snake13-horizontal-pi3", "snake13-phi0-pi2", "snake13-phi0-pi3"),
    *("snake13-planar-pi2", "snake13-planar-pi3", "snake13-vertical-pi2", "snake13-vertical-pi3"),
    *("twist", "vertical", "weak-servo-pi3", "weak-servo-pi3-reverse"),
]
ADAPTIVE = ["avoidance", "corridor", "side-sensor-amplitude"]
AMONG_OBSTACLES = ["target-following", "random-walk"]
LONGEST_S = 30.0
"""By then the random walk has met a wall; the docs' script runs all of every scenario."""

STEADY_S = 10.0
"""Steady gaits are over their start by then, the slowest of them for three cycles."""


def analysed(name, folder, longest_s=LONGEST_S):
    """Run a scenario, hold its energies against its ledger, and analyse it."""
    pytest.importorskip("pybullet")
    pytest.importorskip("numba")
    path = folder / f"{name}.mcap"
    scenario = load_scenario(name)
    if scenario.duration_s > longest_s:
        scenario = scenario.changed(duration_s=longest_s)
    record(scenario, path, kernels=Kernels.NUMBA)
    figures = energy_tables.figures(path)
    holds_the_bar(figures)
    return figures.analysis


def holds_the_bar(figures):
    assert set(figures.errors) == {"net", "plus", "abs", "el", "el_clipped"}
    assert max(abs(error) for error in figures.errors.values()) <= energy_tables.BAR, figures.errors


def test_all_shipped_scenarios_are_here():
    assert {*STEADY, *ADAPTIVE, *AMONG_OBSTACLES} == set(scenario_names())


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "engine", "kernels"),
    [
        ("snake13-planar-pi2", EngineKind.BULLET, Kernels.NUMPY),
        ("snake13-planar-pi2", EngineKind.BULLET, Kernels.NUMBA),
        ("flat", EngineKind.MUJOCO, Kernels.NUMPY),
    ],
)
def test_energies_are_those_of_the_ledger(name, engine, kernels, tmp_path):
    pytest.importorskip(engine.package)
    pytest.importorskip(kernels)
    short = dataclasses.replace(load_scenario(name).changed(duration_s=1.0), settle_s=0.25)
    path = tmp_path / "short.mcap"
    record(dataclasses.replace(short, engine=engine), path, kernels=kernels)
    holds_the_bar(energy_tables.figures(path))


def test_the_page_has_every_scenario_within_the_bar():
    page = (DOCS / "explanation/energy.md").read_text()
    rows = re.findall(r"^\| `([\w-]+)` \|(.*)\|$", page, re.MULTILINE)
    assert [name for name, _ in rows] == list(scenario_names())
    for _, cells in rows:
        assert float(cells.split("|")[len(energy_tables.TITLES)]) <= 100 * energy_tables.BAR


def sensor_flags(result):
    return [
        (artefact.joint, artefact.flag)
        for artefact in result.artefacts
        if artefact.about == "sensor"
    ]


@pytest.mark.built("tables")
@pytest.mark.nightly
@pytest.mark.parametrize("name", STEADY)
def test_a_steady_scenario_closes_its_balance_and_has_sound_sensors(name, tmp_path):
    result = analysed(name, tmp_path, STEADY_S)
    assert sensor_flags(result) == []
    closure = result.energy.closure
    assert abs(closure.mechanical_balance) <= 0.005
    assert abs(closure.electrical_balance) <= 0.005
    assert result.energy.unknown is None
    for joint, cycles in zip(result.joints, result.energy.joints, strict=True):
        assert sum(cycles.net_j) == pytest.approx(joint.energy_net_j)
        assert min(cycles.coverage) > 1 - 1.01 * 0.01 * result.gait.frequency_hz.value  # one sample
    assert result.energy.electrical == "simulated"


@pytest.mark.built("tables")
@pytest.mark.nightly
@pytest.mark.parametrize("name", AMONG_OBSTACLES)
def test_contact_makes_no_speed_that_a_sensor_is_blamed_for(name, tmp_path):
    result = analysed(name, tmp_path)
    assert sensor_flags(result) == []
    for kind in ("mechanical_balance", "electrical_balance"):
        assert abs(getattr(result.energy.closure, kind)) <= 0.005


@pytest.mark.built("tables")
@pytest.mark.nightly
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
        finite = ~np.isnan(
            gain
        )  # what could not be estimated in a cycle is null, and so is its lag
        assert finite.sum() >= gain.size - 1
        np.testing.assert_array_equal(np.isnan(lag), ~finite)
        gain, lag = gain[finite], lag[finite]
        assert ((gain > 0.7) & (gain < 1.3)).all()
        assert ((lag > 0.0) & (lag < 0.7)).all()
        intervals = [ends for ends in joint.gain_ci95 if ends is not None]
        assert all(low < value < high for value, (low, high) in zip(gain, intervals, strict=True))
    if name == "avoidance":  # it hastens, and the lag in rad grows with the frequency
        rates = np.array(driven[6].frequency_hz)
        lags = np.array(driven[6].lag_rad)
        assert rates.max() > 1.3 * rates.min()
        assert np.corrcoef(rates[1:], lags[1:])[0, 1] > 0.5
    result.to_dict()
