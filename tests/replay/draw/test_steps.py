"""Steps, maps and bars against the analysis they show and against closed forms."""

import dataclasses
import math

import numpy as np
import pytest

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.parts.energy.result import EnergyResult, JointCycles, Transport
from undulog.analysis.parts.over_time.result import JointOverTime, ResponseOverTime
from undulog.analysis.session.cycle_maps import CycleMaps
from undulog.capture import Session
from undulog.capture.common.palette import joint_colors
from undulog.replay.draw.body import power_colors
from undulog.replay.draw.heat_maps import cell_colors, heat_maps
from undulog.replay.draw.steps import charts, cycle_tables, together
from undulog.replay.recording import write_recording
from undulog.replay.samples.content import ENERGY, GAIN, LAG, CycleTable

STARTS = (0.0, 1.0, 2.0)
STOPS = (1.0, 2.0, 3.0)
NO_COST = Transport(Estimate(), None, *[Estimate()] * 5, why="")


def over_time(name, gain, lag, starts=STARTS, stops=STOPS):
    """A joint's response in each cycle, without intervals."""
    nothing, zeros, ones = ((value,) * len(starts) for value in (None, 0, 1.0))
    return JointOverTime(name, starts, stops, zeros, ones, gain, nothing, lag, nothing)


@pytest.fixture
def by_cycle(analysis, snake25):
    """The fixture's analysis with cycles: gain 0.9 + 0.002 i, lag 0.1 + 0.01 i, second row null."""
    turned = np.pi - 0.1, 0.1 - np.pi
    joints = tuple(
        over_time(name, (0.9 + 0.002 * i, None, 0.95), (0.1 + 0.01 * i, None, turned[i == 3]))
        for i, name in enumerate(snake25.joint_names[::2])
    )
    rest = {"plus_j": (0.0, 0.0), "abs_j": (0.0, 0.0)}
    rest |= dict.fromkeys(("el_j", "el_clipped_j", "el_coverage"))
    nets = [(0.01 * i - 0.05, 0.02 * i) for i in range(25)]
    energy = tuple(
        JointCycles(name, net_j=net, coverage=(1.0, 0.5 if i == 4 else 1.0), **rest)
        for i, (name, net) in enumerate(zip(snake25.joint_names, nets, strict=True))
    )
    return dataclasses.replace(
        analysis,
        over_time=ResponseOverTime(((0.0, 3.0),), joints),
        energy=EnergyResult((0.0, 1.0), (1.0, 2.0), energy, None, NO_COST, None),
    )


@pytest.fixture(scope="module")
def written(session_file, tmp_path_factory, read_back):
    """Writes the session with an analysis; (what was reported, what is in the file)."""

    def write(analysis, **options):
        path = tmp_path_factory.mktemp("cycles") / "made.rrd"
        with Session.open(session_file) as session:
            recording = write_recording(session, path, analysis=analysis, **options)
        return recording, read_back(path)

    return write


def test_the_numbers_are_the_analysiss(by_cycle):
    gain, lag, energy = cycle_tables(by_cycle)
    assert (gain.quantity, lag.quantity, energy.quantity) == (GAIN, LAG, ENERGY)
    assert gain.names == tuple(f"joint{i:02d}" for i in range(1, 26, 2))
    np.testing.assert_allclose(gain.value[:, 0], 100 * (0.9 + 0.002 * np.arange(13) - 1))
    assert np.isnan(gain.value[:, 1]).all()
    np.testing.assert_allclose(lag.value[:, 0], np.degrees(0.1 + 0.01 * np.arange(13)))
    # -pi + 0.1 after 0.13 is pi + 0.1 if the mean direction lies on that side.
    assert abs(lag.value[3, 2] - lag.value[3, 0]) < 180 + 1e-9
    assert np.degrees(np.pi + 0.1) % 360 == pytest.approx(lag.value[3, 2] % 360)
    assert energy.value[3, 0] == pytest.approx(-0.02)
    assert np.isnan(energy.value[4, 1])  # half of its samples are missing


def test_a_step_spans_its_cycle_and_ends_with_it(by_cycle, written):
    result, recorded = written(by_cycle)
    entity = "/cycles/gain_minus_one_percent"
    keys = [quantity.key for quantity, _ in result.content.cycles]
    assert keys == ["gain_minus_one_percent", "lag_degrees", "energy_net_joule"]
    rows = np.array(recorded.column(entity, "Scalars:scalars"), dtype=float)
    np.testing.assert_allclose(recorded.times(entity) / 1e9, [0, 1, 2, 3])
    np.testing.assert_allclose(rows[0], 100 * (0.9 + 0.002 * np.arange(13) - 1), rtol=1e-6)
    assert np.isnan(rows[1]).all()
    assert np.isnan(rows[3]).all()
    # The session's gait runs at 0.5 Hz: a second is half a cycle.
    np.testing.assert_allclose(recorded.times(entity, "gait_cycle") / 1e9, [0, 0.5, 1.0], atol=1e-6)


def test_a_steady_gait_without_a_logged_phase_shows_the_reports_maps(analysis):
    steady = CycleMaps(
        start_s=np.array([0.5, 1.5]),
        period_s=1.0,
        driven=("joint01", "joint03"),
        gain=np.array([[0.9, 0.8], [1.0, np.nan]]),
        lag_rad=np.array([[0.1, 0.2], [0.3, np.nan]]),
        powered=(),
        power_w=np.zeros((0, 2)),
    )
    gain, lag = cycle_tables(analysis, steady)
    np.testing.assert_allclose(gain.value, [[-10, -20], [0, np.nan]])
    np.testing.assert_allclose(lag.value, np.degrees(steady.lag_rad))
    np.testing.assert_allclose(gain.stop_s, [1.5, 2.5])


def test_planes_with_cycles_of_their_own_meet_in_one_map():
    slow = CycleTable(GAIN, ("a",), np.array([0.0, 2.0]), np.array([2.0, 4.0]), np.array([[1, 2]]))
    t, numbers = np.arange(5.0), np.array([[3.0, 4, 5, 6, 7]])
    both = together([slow, CycleTable(GAIN, ("b",), t, t + 1, numbers)])
    assert both.names == ("a", "b")
    np.testing.assert_array_equal(both.value, [[1, 1, 2, 2, np.nan], [3, 4, 5, 6, 7]])


def test_a_map_runs_head_to_tail_and_its_colours_end_at_the_window(by_cycle, snake25):
    tables = cycle_tables(by_cycle)
    gain, _, power = heat_maps(by_cycle, tables, snake25.joint_names)  # the window ends at 2 s
    assert gain.places == tuple(range(1, 26, 2))
    assert (gain.low, gain.high) == (pytest.approx(-10.0), pytest.approx(-7.6))
    assert gain.title == "Gain − 1 map, −10.00 to −7.60 %"
    colors = cell_colors(gain)
    assert colors.shape == (3, 13, 3)
    scale = joint_colors(256)[:, :3]
    assert (colors[0, 0] == scale[0]).all()
    assert (colors[0, -1] == scale[-1]).all()
    assert (colors[2] == scale[-1]).all()  # -5 % is beyond the window's
    assert (colors[1] == colors[1, 0]).all()  # nothing is known there
    assert not (scale == colors[1, 0]).all(axis=1).any()
    # 0.02 * 24 J in a second is the most that a joint gave.
    assert power.high == pytest.approx(480)
    expected = power_colors(np.array([20.0]), power.high)[0, :3]
    np.testing.assert_array_equal(cell_colors(power)[0, 7], expected)


def test_frame_and_white_bars_are_of_the_cycle_at_the_cursor(by_cycle, written):
    _, recorded = written(by_cycle)
    entity = "/maps/lag_degrees/now"
    np.testing.assert_allclose(recorded.times(entity) / 1e9, [0, 1, 2, 3])
    centers = recorded.column(entity, "Boxes2D:centers")
    assert [len(row) for row in centers] == [1, 1, 1, 0]
    # The map is 300 units high, its rows are the three cycles.
    np.testing.assert_allclose([row[0][1] for row in centers[:3]], [50, 150, 250])
    entity = "/segments/gain_minus_one_percent/current"
    bars = [row[0] for row in recorded.column(entity, "BarChart:values")]
    heights = [np.array(bar["buffer"], dtype=float) for bar in bars]
    np.testing.assert_allclose(heights[0], 100 * (0.9 + 0.002 * np.arange(13) - 1))
    assert [height.size for height in heights] == [13, 0, 13, 0]
    (left,) = recorded.column(entity, "BarChart:abscissa")[0]
    assert (np.floor(np.array(left["buffer"], dtype=float)) == np.arange(1, 26, 2)).all()


def test_energies_of_a_cycle_stand_beside_bars_of_a_mean_cycle(by_cycle, analysis):
    window = dataclasses.replace(analysis.gait.windows[0], cycles=4.0)
    four = dataclasses.replace(analysis, gait=dataclasses.replace(analysis.gait, windows=(window,)))
    assert charts(four)[2].bars[3].value == pytest.approx(0.01 / 4)


def test_without_cycles_there_are_no_views_of_them(analysis, written):
    result, recorded = written(analysis)
    assert (result.content.cycles, result.content.maps) == ((), ())
    assert not any(path.startswith(("/cycles", "/maps")) for path in recorded.entities)


def test_bars_show_gain_lag_and_energy_of_the_joints_that_have_them(analysis):
    gain, lag, energy = charts(analysis)
    assert [bar.place for bar in gain.bars] == list(range(1, 26, 2))
    assert [bar.joint for bar in lag.bars] == [f"joint{i:02d}" for i in range(1, 26, 2)]
    assert gain.bars[1].value == pytest.approx(100 * (0.95 + 0.008 - 1))
    assert gain.bars[0].value == pytest.approx(-5.0)
    assert gain.bars[0].far == pytest.approx(-6.0)  # the end beyond it, seen from the baseline
    assert lag.bars[1].value == pytest.approx(7.6)
    assert lag.bars[1].far == pytest.approx(7.6 + math.degrees(0.02))
    assert len(energy.bars) == 25
    assert (energy.bars[3].value, energy.bars[3].far) == (pytest.approx(0.01), None)


def test_what_no_joint_has_gets_no_chart(analysis):
    none = {"gain": Estimate(), "lag_rad": Estimate()}
    bare = [dataclasses.replace(joint, **none) for joint in analysis.joints]
    (energy,) = charts(dataclasses.replace(analysis, joints=tuple(bare)))
    assert energy.title == "Net energy [J]"
