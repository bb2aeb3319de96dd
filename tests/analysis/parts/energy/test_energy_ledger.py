"""Energies beside the twin's ledger: which term is of which, and by how much it may differ."""

from types import SimpleNamespace

import numpy as np
import pytest

from undulog.analysis.parts.energy import measure as energy
from undulog.analysis.parts.energy.measure import Energies, Energy
from undulog.analysis.signals.windows import Span
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.log.read.sample_times import JointSignals

SPAN = Span(10**18, 2.0, 6.0, 2)
COVERED = np.ones(2)
TERMS = {  # energy to what it is of the two joints below [J], and the ledger's name
    "net": (3.0, "mechanical_net"),
    "plus": (5.0, "mechanical_plus"),
    "abs": (7.0, "mechanical_abs"),
    "el": (30.0, "electrical_net"),
    "el_clipped": (40.0, "electrical_plus"),
}


def of(net, plus):
    return Energy(np.array(net), np.array(plus), 1.0, COVERED)


JOINTS = [
    Energies(of([1.0, 0.5], [1.5, 1.0]), of([10.0, 5.0], [12.0, 8.0])),
    Energies(of([1.0, 0.5], [1.5, 1.0]), of([10.0, 5.0], [12.0, 8.0])),
]


def with_ledger(rates, rows=None):
    """A session whose ledger grows by so much a second, read at times after the origin [s]."""
    names = tuple(rates)
    rows = {name: np.arange(0.0, 8.01, 0.5) for name in names} | (rows or {})

    def joints(topic):
        assert topic == "/energy_ledger"
        times = [np.asarray(rows[name], dtype=float) for name in names]
        t_ns = tuple(10**18 + np.round(t * 1e9).astype(np.int64) for t in times)
        values = tuple(5.0 + rates[name] * t for name, t in zip(names, times, strict=True))
        return JointSignals(topic, "position", "J", names, t_ns, values)

    return SimpleNamespace(channels={"/energy_ledger": None}, joints=joints)


def checked(booked, energies=JOINTS):
    """Compare with a ledger that books so much in the window [J]; returns closure and warnings."""
    warnings = []
    rates = {name: whole_j / 4.0 for name, whole_j in booked.items()}
    return energy.check_ledger(with_ledger(rates), energies, SPAN, warnings.append), warnings


def test_sums_are_over_joints_and_cycles():
    expected = {name: value for name, (value, _) in TERMS.items()} | {"el_abs": 50.0}
    assert energy.whole_robot(JOINTS) == pytest.approx(expected)
    half = energy.whole_robot([Energies(JOINTS[0].mechanical, None), JOINTS[1]])
    assert half["el"] == pytest.approx(15.0)
    assert half["net"] == pytest.approx(3.0)
    assert energy.whole_robot([Energies(None, None)]) == {}


@pytest.mark.parametrize("name", TERMS)
def test_each_term_is_compared_with_its_own(name):
    booked = {term: value for value, term in TERMS.values()}
    value, term = TERMS[name]
    closure, warnings = checked(booked | {term: value - 0.02, "mechanical_residual": 0.07})
    assert warnings == []
    whole = booked["mechanical_abs"] - 0.02 * (name == "abs")
    for other in TERMS:
        expected = 0.02 / whole if other == name else 0.0
        assert getattr(closure, other) == pytest.approx(expected, abs=1e-9)
    assert closure.mechanical_balance == pytest.approx(0.07 / whole)
    assert closure.electrical_balance is None


@pytest.mark.parametrize(
    ("name", "most"),
    # 5 % of the absolute energy of its kind, or of what is booked where that is more.
    [("net", 0.05 * 7.0), ("el", 0.05 * 50.0)],
)
def test_a_difference_of_more_than_a_twentieth_is_warned_of(name, most):
    booked = {term: value for value, term in TERMS.values()} | {"electrical_residual": 0.7}
    value, term = TERMS[name]
    for share, warned in ((0.99, False), (-0.99, False), (1.01, True), (-1.01, True)):
        closure, warnings = checked(booked | {term: value + share * most})
        kind = "mechanical" if name == "net" else "electrical"
        text = (
            f"{kind} energy is {value:.4g} J from the samples but {value + share * most:.4g} J in "
            "the twin's ledger (/energy_ledger): samples once a control cycle miss what happens "
            "within it"
        )
        assert warnings == [text] * warned
        assert getattr(closure, name) == pytest.approx(-share * most / 7.0)
        assert closure.electrical_balance == pytest.approx(0.1)
    for other in ("plus", "abs", "el_clipped"):  # they are not warned of
        assert checked(booked | {TERMS[other][1]: 2.0 * TERMS[other][0]})[1] == []


def test_what_is_booked_is_the_scale_where_it_is_more():
    booked = {term: value for value, term in TERMS.values()}
    few = [Energies(of([-0.95, 1.05], [0.0, 1.05]), None)]  # 0.1 J of 2 J
    booked["mechanical_net"] = -100.0
    _, warnings = checked(booked, few)
    assert len(warnings) == 1
    mine = [Energies(of([100.0, 100.0], [100.0, 100.0]), None)]
    booked["mechanical_net"] = 210.4  # 10.4 J of 210.4 J
    assert checked(booked, mine)[1] == []
    booked["mechanical_net"] = 210.6
    assert len(checked(booked, mine)[1]) == 1


def test_without_work_in_the_ledger_there_are_no_shares():
    closure, warnings = checked({"mechanical_net": 3.0})
    assert warnings == []
    assert (closure.net, closure.mechanical_balance) == (None, None)
    closure, _ = checked({"mechanical_net": 3.0, "mechanical_abs": 0.0})
    assert closure.net is None
    closure, _ = checked({"mechanical_net": 2.9, "mechanical_abs": 0.5})
    assert closure.net == pytest.approx(0.2)
    assert (closure.el, closure.plus) == (None, None)
    assert closure.abs == pytest.approx(6.5 / 0.5)


def test_a_term_is_the_difference_between_the_windows_ends():
    rates = {"a": 1.0, "b": 2.0, "c": 3.0, "d": 4.0, "e": 5.0, "f": 6.0}
    rows = {"b": [4.0], "c": [3.0, 5.0], "d": [6.0, 7.0], "e": [6.1, 7.0], "f": []}
    terms = energy.booked_energies(with_ledger(rates, rows), SPAN)
    assert terms == pytest.approx({"a": 4.0, "c": 6.0, "d": 0.0})  # held beyond its samples
    assert energy.booked_energies(SimpleNamespace(channels={}), SPAN) is None


@pytest.mark.parametrize("error", [DataError("no joints"), LogError("a.mcap", "cut short")])
def test_a_ledger_that_can_not_be_read_is_warned_of(error):
    def fails(topic):
        del topic
        raise error

    session, warnings = SimpleNamespace(channels={"/energy_ledger": None}, joints=fails), []
    assert energy.check_ledger(session, JOINTS, SPAN, warnings.append) is None
    assert warnings == [f"/energy_ledger can't be read: {error}"]


def test_energies_of_all_joints_take_all_joints():
    first, second = np.array([1.0, 2.0]), np.array([10.0, 20.0])
    np.testing.assert_array_equal(energy.in_all([first, second]), [11.0, 22.0])
    np.testing.assert_array_equal(energy.in_all([first]), first)
    assert energy.in_all([first, None]) is energy.in_all([None]) is energy.in_all([]) is None
