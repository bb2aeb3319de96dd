"""Energies at the limits: windows beyond the samples, what is just steady, what lacks a factor."""

from types import SimpleNamespace

import numpy as np
import pytest

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.energy import measure as energy
from undulog.analysis.parts.energy.measure import Energies, Energy, add_up
from undulog.analysis.signals.windows import Span
from undulog.capture.log.messages.definitions import PowerTopic
from undulog.capture.log.read.sample_times import JointSignals, Signal

ORIGIN_NS = 10**18
SPAN = Span(ORIGIN_NS, 0.0, 1.0, 2)
T_NS = ORIGIN_NS + 10_000_000 * np.arange(101)
SESSION = SimpleNamespace(metadata={}, forget=bool, channels={})


def columns_of(**quantities):
    """Columns of some quantities, values by joint; the others were not recorded."""
    names = sorted({name for rows in quantities.values() for name in rows})
    of_all = {quantity: {} for quantity in ("effort", "velocity", "current", "voltage")}
    of_all |= {
        quantity: {
            name: Signal(name, quantity, T_NS, np.broadcast_to(np.asarray(values, float), 101))
            for name, values in rows.items()
        }
        for quantity, rows in quantities.items()
    }
    none = {topic: {} for topic in PowerTopic}
    return SimpleNamespace(names=tuple(names), powers=none, topics={"voltage": "/v"}, **of_all)


# -- windows ---------------------------------------------------------------------------------------


def counted(t_s, powers, edges):
    """Energies and covered times between edges, each sample a box of a median interval."""
    half = float(np.median(np.diff(t_s))) / 2
    ends = np.minimum(edges[1:, None], t_s + half)
    overlap = np.maximum(ends - np.maximum(edges[:-1, None], t_s - half), 0.0)
    return overlap @ powers, overlap.sum(axis=1)


@pytest.mark.parametrize(
    ("start_s", "stop_s", "cycles"),
    [(-0.7, 1.3, 4), (0.2, 3.7, 5), (0.0, 2.0, 2), (-2.0, -0.1, 2), (1.1, 1.2, 1)],
)
def test_means_of_intervals_add_up_to_boxes_also_beyond_the_samples(start_s, stop_s, cycles):
    t_s = np.delete(np.arange(100), [20, 21, 50]) * 0.02 + 0.01
    powers = np.random.default_rng(1).normal(0.3, 1.0, t_s.size)
    net, plus = Series("q", t_s, powers), Series("q", t_s, np.maximum(powers, 0.0))
    sums = add_up(net, plus, start_s, stop_s, cycles)
    edges = np.linspace(start_s, stop_s, cycles + 1)
    energies, times = counted(t_s, powers, edges)
    if not times.any():
        assert sums is None
        return
    np.testing.assert_allclose(sums.net_j, energies, atol=1e-12)
    np.testing.assert_allclose(sums.plus_j, counted(t_s, plus.values, edges)[0], atol=1e-12)
    share = times / np.diff(edges)
    np.testing.assert_allclose(sums.covered, share, atol=1e-12)
    assert sums.coverage == pytest.approx(share.mean(), abs=1e-12)


def test_intervals_that_come_close_to_each_other_cover_a_window_once():
    t_s = np.arange(40) * 0.05 + np.tile([0.025, 0.03], 20)  # 45 and 55 ms apart
    t_s[20:30] -= 0.001 * np.arange(10)
    ones = Series("q", t_s, np.ones(40))
    sums = add_up(ones, ones, 0.0, 2.0, 8)
    assert sums.covered.max() == 1.0
    assert sums.coverage <= 1.0


# -- joints ----------------------------------------------------------------------------------------


def test_a_joint_that_lacks_a_factor_has_no_energy_of_that_kind():
    columns = columns_of(
        effort={"a": 2.0, "b": 2.0},
        velocity={"a": 0.5, "c": 3.0},
        current={"b": 4.0, "c": 4.0},
        voltage={"a": 1.0, "c": 0.25},
    )
    energies = energy.joint_energies(SESSION, columns, (), SPAN, pytest.fail)
    kinds = {
        name: (of_joint.mechanical, of_joint.electrical) for name, of_joint in energies.items()
    }
    assert {name: [kind is not None for kind in both] for name, both in kinds.items()} == {
        "a": [True, False],
        "b": [False, False],
        "c": [False, True],
    }
    np.testing.assert_allclose(energies["a"].mechanical.net_j, 0.5)
    np.testing.assert_allclose(energies["c"].electrical.net_j, 0.5)
    sampled = [energies[name].sampled for name in "abc"]
    assert sampled == [{"mechanical"}, frozenset(), {"electrical"}]


@pytest.mark.parametrize("kind", ["mechanical", "electrical"])
def test_gaps_are_those_of_either_kind_beyond_a_hundredth(monkeypatch, kind):
    columns = columns_of(effort={"a": 1.0, "b": 1.0, "c": 1.0}, velocity={})
    share = {"a": 0.99, "b": 0.9899, "c": 1.0}

    def of(name):
        part = Energy(np.ones(2), np.ones(2), share[name], np.ones(2))
        return Energies(**({"mechanical": None, "electrical": None} | {kind: part}))

    monkeypatch.setattr(energy, "in_threads", lambda _job, names, *_: [of(name) for name in names])
    warnings = []
    energy.joint_energies(SESSION, columns, (), SPAN, warnings.append)
    (text,) = warnings
    assert text.startswith("the power of b has gaps, which are not bridged: energies count only ")


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("low", "high", "source"),
    [(9.0, 11.0, "supply"), (8.875, 11.125, "motor"), (5.0, 5.0, "supply"), (0.0, 0.0, "supply")],
)
def test_a_supply_varies_by_a_fifth_of_its_mean_at_most(sign, low, high, source):
    volts = sign * np.tile([low, high, np.nan], 34)[:101]
    assert np.count_nonzero(np.isfinite(volts)) == 68
    columns = columns_of(current={"a": 1.0, "b": 1.0}, voltage={"a": volts, "b": np.nan})
    assert energy.electrical_source(SESSION, columns) == source


@pytest.mark.parametrize(
    ("kinds", "begins"),
    [
        (["mechanical"], "mechanical energies are products of sampled torque and velocity: what"),
        (["electrical"], "electrical energies are products of sampled voltage and current: what"),
    ],
)
def test_what_the_log_leaves_open_is_of_the_kinds_that_are_products(kinds, begins):
    by_joint = {"a": Energies(None, None, frozenset(kinds)), "b": Energies(None, None)}
    warnings = []
    columns = columns_of(current={"a": 1.0}, voltage={"a": 5.0})
    session = SimpleNamespace(metadata={}, start_ns=ORIGIN_NS - 250_000_000)
    result = energy.energy_result(
        session, columns, by_joint, SPAN, transport=None, closure=None, warn=warnings.append
    )
    assert result.unknown.startswith(begins)
    assert (result.start_s, result.stop_s) == ((0.25, 0.75), (0.75, 1.25))
    (text,) = warnings
    assert text.startswith("/v stays as it is while the joints work, so it is the supply's")


# -- comparisons -----------------------------------------------------------------------------------


def test_a_robot_at_rest_agrees_with_its_ledger():
    names = ("mechanical_net", "mechanical_abs", "electrical_net")
    t_ns = (T_NS,) * 3
    ledger = JointSignals("/energy_ledger", "position", "J", names, t_ns, (np.zeros(101),) * 3)
    session = SimpleNamespace(channels={"/energy_ledger": None}, joints=lambda _topic: ledger)
    nothing = Energy(np.zeros(2), np.zeros(2), 1.0, np.ones(2))
    closure = energy.check_ledger(session, [Energies(nothing, nothing)], SPAN, pytest.fail)
    assert (closure.net, closure.el, closure.mechanical_balance) == (None, None, None)


@pytest.mark.parametrize(
    ("ci95", "way_m", "nowhere"),
    [
        ((0.001, 0.02), 0.0025, False),  # a hundredth of a length of 1 m in each cycle
        ((0.0, 0.02), 0.0025, True),
        ((0.001, 0.02), 0.0024, True),
        (None, 0.0025, True),
    ],
)
def test_a_way_counts_from_a_hundredth_of_the_length_in_each_cycle(ci95, way_m, nowhere):
    robot = SimpleNamespace(links=[SimpleNamespace(length=0.125)] * 2)
    way = np.full(4, way_m)
    note = energy._goes_nowhere(way, Estimate(float(way.sum()), ci95), robot)
    assert bool(note) is nowhere


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_ratio_has_the_error_of_a_ratio_estimator(sign):
    """Cochran's var r = n / (n - 1) sum (a - r b)^2 / (sum b)^2, by hand; t is that of 2."""
    above, below = np.array([1.0, 2.0, 6.0]), sign * np.array([2.0, 3.0, 4.0])
    ratio = energy._ratio(above, below)
    scatter = 1.0**2 + 1.0**2 + 2.0**2  # residuals -1, -1, 2 of the ratio +-1
    half = 4.302652729911275 * (1.5 * scatter) ** 0.5 / 9.0
    assert ratio.value == pytest.approx(sign)
    np.testing.assert_allclose(ratio.ci95, (sign - half, sign + half))
