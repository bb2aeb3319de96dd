"""Energies of a whole session against sums by hand: who has which, the ledger, the way.

Two joints, 100 samples/s, four cycles of 2 s after 1 s. The powers are polynomials of each cycle's
phase, so that the trapezoidal rule's sums are those of numpy; the robot slides on a straight way.
"""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from support.frozen_records import mutable_dataclasses
from support.twin_chains import chain
from support.written_sessions import EPOCH_NS
from undulog.analysis.estimators.series import clean
from undulog.analysis.parts.artefacts.result import Artefact
from undulog.analysis.parts.body.travel import GRAVITY
from undulog.analysis.parts.energy import measure as energy
from undulog.analysis.signals.columns import read_columns
from undulog.analysis.signals.windows import Span
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.log.messages.definitions import PowerTopic

NAMES = ("joint01", "joint02")
PERIOD_NS, CYCLES = 10_000_000, 4
T_S = np.arange(1001) / 100
SPAN = Span(EPOCH_NS, 1.0, 9.0, CYCLES)
FORWARD_M = np.array([0.11, 0.08, 0.10, 0.12])  # in each cycle
PHASE = ((T_S - 1.0) / 2) % 1.0
RISE = 1.0 + np.floor((T_S - 1.0) / 2)  # 1, 2, 3, 4 in the four cycles
EFFORT = np.stack([RISE * (PHASE - 0.25), 0.5 * (0.5 - PHASE)], axis=1)
VELOCITY = np.stack([np.full(T_S.size, 0.6), -0.4 + 0 * T_S], axis=1)
CURRENT = np.stack([0.5 + 0 * T_S, PHASE - 0.5], axis=1)
VOLTAGE = np.stack([4.0 - 8.0 * PHASE, 6.0 * PHASE], axis=1)
LEDGER = ("mechanical_net", "mechanical_plus", "mechanical_abs", "mechanical_residual")


def by_hand(power, part=lambda values: values):
    """Energy of each cycle [J]: a sample holds for the 10 ms from it on."""
    rows = part(power)[100:900].reshape(CYCLES, 200, -1)
    return rows.sum(axis=1).T / 100


MECHANICAL, ELECTRICAL = EFFORT * VELOCITY, CURRENT * VOLTAGE
POSITIVE = {"net": lambda x: x, "plus": lambda x: np.maximum(x, 0.0), "abs": np.abs}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "chain.toml"
    path.write_text(chain(2, assumed=()))
    return load_robot(path)


@pytest.fixture
def written(tmp_path, robot):
    """Write a session of some topics; returns it opened, its columns, and what was warned of."""
    opened = []

    def write(*, states=True, motor=True, powers=(), ledger=None, way=True, **facts):
        path = tmp_path / f"{len(opened)}.mcap"
        ways = np.concatenate([[0.0], np.cumsum(FORWARD_M)])
        x_m = np.interp(T_S, np.linspace(1.0, 9.0, CYCLES + 1), ways)
        with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=robot) as writer:
            if facts:
                writer.note("undulog", facts)
            full = {"velocity": states, "effort": states}
            joints = writer.joint_state("/joint_states", NAMES, unit="rad", **full)
            topics = {"/joint_current": ("A", CURRENT), "/joint_voltage": ("V", VOLTAGE)}
            topics = topics if motor else {}
            topics |= {topic: ("W", values) for topic, values in powers}
            named = {
                topic: (writer.joint_state(topic, NAMES[: values.shape[1]], unit=unit), values)
                for topic, (unit, values) in topics.items()
            }
            odometry = writer.odometry("/odom", frame="world", child="link01") if way else None
            booked = writer.joint_state("/energy_ledger", LEDGER, unit="J") if ledger else None
            for k in range(T_S.size):
                t_ns = EPOCH_NS + k * PERIOD_NS
                joints.write(t_ns, np.zeros(2), *([VELOCITY[k], EFFORT[k]] if states else []))
                for channel, values in named.values():
                    channel.write(t_ns, values[k])
                if odometry is not None:
                    place = np.array([0.6 * x_m[k], 0.8 * x_m[k], 0.03])
                    turn = np.array([0.0, 0.0, 0.0, 1.0])
                    odometry.write(t_ns, place, turn, np.zeros(3), np.zeros(3))
                if booked is not None:
                    booked.write(t_ns, np.array([T_S[k] * ledger[term] for term in LEDGER]))
            writer.set_verdict("good")
        opened.append(Session.open(path))
        warnings = []
        session = opened[-1]
        return (
            session,
            read_columns(session, "/joint_commands", "/joint_states", warnings.append),
            warnings,
        )

    yield write
    for log in opened:
        log.close()


def found_in(session, columns, artefacts=(), span=SPAN):
    warnings = []
    return energy.joint_energies(session, columns, artefacts, span, warnings.append), warnings


def angles(count=T_S.size):
    """Straight joints."""
    t_ns = EPOCH_NS + PERIOD_NS * np.arange(count)
    return {name: clean(name, t_ns, np.zeros(count), EPOCH_NS) for name in NAMES}


def test_each_joint_has_the_energies_of_its_own_samples_in_each_cycle(written):
    session, columns, _ = written()
    by_joint, warnings = found_in(session, columns)
    assert (list(by_joint), warnings) == (list(NAMES), [])
    terms = {"net": "net", "plus": "plus", "abs": "abs", "el": "net", "el_clipped": "plus"}
    for term, part in terms.items():
        power = ELECTRICAL if term.startswith("el") else MECHANICAL
        for name, expected in zip(NAMES, by_hand(power, POSITIVE[part]), strict=True):
            # A sample's weight is half before and half after it: the jumps between cycles count.
            np.testing.assert_allclose(
                by_joint[name].per_cycle(term), expected, atol=0.03, rtol=0.02
            )
    sums = energy.whole_robot(by_joint.values())
    for term, part in terms.items():
        whole = sum(of_joint.per_cycle(term).sum() for of_joint in by_joint.values())
        assert sums[term] == pytest.approx(whole)
        assert part
    clipped = sum(of_joint.electrical.abs_j.sum() for of_joint in by_joint.values())
    assert sums["el_abs"] == pytest.approx(clipped)
    assert all(of_joint.sampled == {"mechanical", "electrical"} for of_joint in by_joint.values())
    energies = energy.Energies(None, by_joint["joint01"].electrical)
    assert energies.per_cycle("net") is None
    assert energies.per_cycle("el") is by_joint["joint01"].electrical.net_j
    assert sorted(energy.whole_robot([energies])) == ["el", "el_abs", "el_clipped"]


def test_a_falsified_sensor_takes_its_own_kind_of_energy_of_its_own_joint(written):
    session, columns, _ = written()
    for quantity, kind, other in (
        ("velocity", "mechanical", "electrical"),
        ("effort", "mechanical", "electrical"),
        ("current", "electrical", "mechanical"),
        ("voltage", "electrical", "mechanical"),
    ):
        wrong = [Artefact("joint02", "/x", quantity, "wrong_unit", ())]
        by_joint, warnings = found_in(session, columns, wrong)
        assert warnings == [f"joint02: {kind} energies are null, since a sensor falsifies them"]
        assert getattr(by_joint["joint02"], kind) is None
        assert getattr(by_joint["joint02"], other) is not None
        assert by_joint["joint02"].sampled == {other}
        assert by_joint["joint01"].sampled == {"mechanical", "electrical"}
    kept, warnings = found_in(session, columns, [Artefact("joint02", "/x", "velocity", "gaps", ())])
    assert warnings == []
    assert kept["joint02"].mechanical is not None


def test_accumulated_powers_come_before_products_where_both_parts_are_there(written):
    mean = np.stack([2.0 + 0 * T_S, -1.0 + 0 * T_S], axis=1)
    positive = np.maximum(mean, 0.0) + 0.5
    topics = [(PowerTopic.MECHANICAL, mean), (PowerTopic.MECHANICAL_PLUS, positive[:, :1])]
    session, columns, _ = written(motor=False, powers=topics)
    by_joint, _ = found_in(session, columns)
    np.testing.assert_allclose(by_joint["joint01"].per_cycle("net"), 4.0)
    np.testing.assert_allclose(by_joint["joint01"].per_cycle("plus"), 5.0)
    np.testing.assert_allclose(by_joint["joint01"].per_cycle("abs"), 6.0)
    assert by_joint["joint01"].sampled == frozenset()
    # The second joint lacks the positive part: a product, from its torque and velocity.
    expected = by_hand(MECHANICAL)[1]
    np.testing.assert_allclose(by_joint["joint02"].per_cycle("net"), expected, atol=0.03)
    assert by_joint["joint02"].sampled == {"mechanical"}
    assert by_joint["joint01"].electrical is by_joint["joint02"].electrical is None


def test_gaps_are_told_by_name(written):
    session, columns, _ = written()
    wide = dataclasses.replace(SPAN, stop_s=11.0)  # the samples end at 10 s
    by_joint, warnings = found_in(session, columns, span=wide)
    assert by_joint["joint01"].mechanical.coverage == pytest.approx(0.9, abs=0.002)
    (text,) = warnings
    assert text.startswith("the power of joint01, joint02 has gaps")
    barely = dataclasses.replace(SPAN, stop_s=10.0 + 0.9 * energy.GAP_SHARE * 9.0)
    assert found_in(session, columns, span=barely)[1] == []


@pytest.mark.parametrize(
    ("volts", "source"),
    [(VOLTAGE, "motor"), (12.0 + 0 * VOLTAGE, "supply"), (12.0 + 1.1 * (PHASE > 0.5), "supply")],
)
def test_a_voltage_that_stays_is_the_supplys(volts, source, written):
    session, columns, _ = written()
    if volts.ndim == 1:
        volts = np.stack([volts, volts], axis=1)
    columns = dataclasses.replace(
        columns,
        voltage={
            name: dataclasses.replace(columns.voltage[name], values=volts[:, k])
            for k, name in enumerate(NAMES)
        },
    )
    assert energy.electrical_source(session, columns) == source
    half = dataclasses.replace(columns, voltage={"joint01": columns.voltage["joint01"]})
    assert energy.electrical_source(session, half) == source
    other = dataclasses.replace(half, current={"joint02": columns.current["joint02"]})
    assert energy.electrical_source(session, other) is None


def test_the_result_has_each_cycle_from_the_sessions_start(written):
    session, columns, _ = written(scenario="x.toml")
    by_joint, _ = found_in(session, columns)
    warnings = []
    cost = energy.transport(session, angles(), by_joint, SPAN, warnings.append)
    later = dataclasses.replace(SPAN, origin_ns=EPOCH_NS + 500_000_000)
    result = energy.energy_result(
        session, columns, by_joint, later, transport=cost, closure=None, warn=warnings.append
    )
    assert result.start_s == (1.5, 3.5, 5.5, 7.5)
    assert result.stop_s == (3.5, 5.5, 7.5, 9.5)
    assert result.electrical == "simulated"
    assert warnings == []
    assert [joint.name for joint in result.joints] == list(NAMES)
    first = result.joints[0]
    assert first.net_j == tuple(by_joint["joint01"].mechanical.net_j)
    assert first.el_clipped_j == tuple(by_joint["joint01"].electrical.plus_j)
    assert first.coverage == tuple(by_joint["joint01"].mechanical.covered)
    assert first.el_coverage == tuple(by_joint["joint01"].electrical.covered)
    assert result.unknown.startswith(
        "mechanical energies are products of sampled torque and velocity and electrical energies "
        "are products of sampled voltage and current: "
    )
    none = {name: energy.Energies(None, None) for name in NAMES}
    bare = energy.energy_result(
        session, columns, none, SPAN, transport=cost, closure=None, warn=warnings.append
    )
    assert (bare.unknown, bare.joints[0].net_j, bare.joints[0].coverage) == (None, None, None)
    assert bare.joints[0].el_coverage is None


def test_without_a_gait_the_window_is_one_cycle(written):
    session, columns, _ = written()
    cycles, _ = found_in(session, columns)
    still = dataclasses.replace(SPAN, cycles=0)
    by_joint, warnings = found_in(session, columns, span=still)
    for name in NAMES:
        for term in energy.TERMS:
            (whole,) = by_joint[name].per_cycle(term)
            assert whole == pytest.approx(cycles[name].per_cycle(term).sum())
    cost = energy.transport(session, angles(), cycles, SPAN, warnings.append)
    result = energy.energy_result(
        session, columns, by_joint, still, transport=cost, closure=None, warn=warnings.append
    )
    assert (result.start_s, result.stop_s, warnings) == ((1.0,), (9.0,), [])


def test_the_ledger_is_compared_over_the_same_window(written):
    session, columns, _ = written()
    by_joint, _ = found_in(session, columns)
    assert energy.check_ledger(session, by_joint.values(), SPAN, pytest.fail) is None
    sums = energy.whole_robot(by_joint.values())
    rates = {"mechanical_net": sums["net"] / 8.0, "mechanical_plus": (sums["plus"] - 0.4) / 8.0}
    rates |= {"mechanical_abs": sums["abs"] / 8.0, "mechanical_residual": 0.01}
    session, columns, _ = written(ledger=rates)
    assert energy.booked_energies(session, SPAN) == pytest.approx(
        {name: 8.0 * rate for name, rate in rates.items()}
    )
    warnings = []
    closure = energy.check_ledger(session, by_joint.values(), SPAN, warnings.append)
    assert warnings == []
    assert closure.mechanical_balance == pytest.approx(0.08 / sums["abs"])
    assert closure.plus == pytest.approx(0.4 / sums["abs"])
    assert (closure.net, closure.abs) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert (closure.electrical_balance, closure.el, closure.el_clipped) == (None, None, None)
    before = dataclasses.replace(SPAN, origin_ns=EPOCH_NS - 100 * 10**9)
    assert energy.booked_energies(session, before) == {}


@pytest.mark.parametrize(("share", "warned"), [(0.04, False), (0.06, True), (-0.06, True)])
def test_a_ledger_that_says_otherwise_is_told(share, warned, written):
    session, columns, _ = written()
    by_joint, _ = found_in(session, columns)
    sums = energy.whole_robot(by_joint.values())
    rates = dict.fromkeys(LEDGER, 0.0)
    rates["mechanical_net"] = (sums["net"] + share * sums["abs"]) / 8.0
    rates["mechanical_abs"] = sums["abs"] / 8.0
    session, columns, _ = written(ledger=rates)
    warnings = []
    closure = energy.check_ledger(session, by_joint.values(), SPAN, warnings.append)
    assert closure.net == pytest.approx(-share, abs=1e-6)
    assert [text.split(" is ")[0] for text in warnings] == ["mechanical energy"] * warned


def test_the_cost_of_transport_is_energy_over_weight_and_way(written, robot):
    session, columns, _ = written()
    by_joint, _ = found_in(session, columns)
    warnings = []
    cost = energy.transport(session, angles(), by_joint, SPAN, warnings.append)
    assert (warnings, cost.why) == ([], "")
    assert cost.mass_kg == pytest.approx(robot.total_mass)
    assert cost.distance_m.value == pytest.approx(FORWARD_M.sum(), rel=1e-6)
    low, high = stats.t.interval(0.95, CYCLES - 1, FORWARD_M.mean(), stats.sem(FORWARD_M))
    np.testing.assert_allclose(cost.distance_m.ci95, (CYCLES * low, CYCLES * high), rtol=1e-6)
    weight = robot.total_mass * GRAVITY
    for term in ("net", "plus", "abs", "el", "el_clipped"):
        above = sum(of_joint.per_cycle(term) for of_joint in by_joint.values())
        ratio = above.sum() / (weight * FORWARD_M.sum())
        assert getattr(cost, term).value == pytest.approx(ratio, rel=1e-6)
        rest = above - ratio * weight * FORWARD_M
        half = stats.t.ppf(0.975, 3) * np.sqrt(4 / 3 * np.sum(rest**2)) / (weight * FORWARD_M.sum())
        assert np.ptp(getattr(cost, term).ci95) == pytest.approx(2 * half, rel=1e-6)


def test_a_cost_that_lacks_something_says_what(written):
    session, columns, _ = written(motor=False)
    by_joint, _ = found_in(session, columns)
    warnings = []
    cost = energy.transport(session, angles(), by_joint, SPAN, warnings.append)
    assert cost.why == "no electrical energy of some joints"
    assert [str(text) for text in warnings] == [f"cost of transport is partly null: {cost.why}"]
    assert cost.net.value is not None
    assert cost.el.value is cost.el_clipped.value is None
    some = {**by_joint, "joint02": energy.Energies(None, None)}
    cost = energy.transport(session, angles(), some, SPAN, warnings.append)
    assert cost.why == "no mechanical energy of some joints; no electrical energy of some joints"
    assert cost.net.value is None
    still, columns, _ = written(way=False)
    cost = energy.transport(still, angles(), by_joint, SPAN, warnings.append)
    assert cost.distance_m.value is cost.net.value is None
    assert "no cost of transport" not in cost.why
    assert cost.why.startswith("it takes a robot description")


def test_a_robot_that_goes_nowhere_has_no_cost(written, robot, monkeypatch):
    session, columns, _ = written()
    by_joint, _ = found_in(session, columns)
    way = np.array([0.001, -0.0011, 0.001, 0.0])
    least = energy.LEAST_WAY * sum(link.length for link in robot.links) * CYCLES
    assert energy._goes_nowhere(way, energy._distance(way), robot) == [
        "the centre of mass moves by 0.9 mm in 4 cycles, which does not differ significantly from 0"
    ]
    for total, nowhere in ((0.9 * least, True), (1.1 * least, False)):
        even = np.full(CYCLES, total / CYCLES) + np.array([1e-6, -1e-6, 1e-6, -1e-6])
        assert bool(energy._goes_nowhere(even, energy._distance(even), robot)) is nowhere
    scattered = np.array([0.1, -0.05, 0.09, -0.06])  # far enough, but it may be chance
    assert energy._goes_nowhere(scattered, energy._distance(scattered), robot)
    monkeypatch.setattr(energy, "LEAST_WAY", 10.0)
    warnings = []
    cost = energy.transport(session, angles(), by_joint, SPAN, warnings.append)
    assert cost.why.startswith("the centre of mass moves by 410 mm in 4 cycles")
    assert cost.distance_m.value == pytest.approx(0.41)
    assert [str(text) for text in warnings] == [f"cost of transport is not applicable: {cost.why}"]


def test_what_is_handed_on_can_not_be_changed():
    assert mutable_dataclasses("undulog.analysis.parts.energy.measure") == set()
