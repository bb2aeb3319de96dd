"""Which joints stand for the body, errors against closed forms, and the gait's rhythm and modes."""

import numpy as np

from undulog.capture.common.palette import joint_colors
from undulog.capture.robot.model import Plane
from undulog.replay.draw.lines import changes, head_middle_tail, joint_palette, rhythm_of
from undulog.replay.draw.stage import trail_segments
from undulog.replay.samples import quantities
from undulog.replay.samples.tracks import Track

T = np.arange(200, dtype=np.int64) * 10_000_000


def waves(robot, horizontal, vertical):
    size = {Plane.HORIZONTAL: horizontal, Plane.VERTICAL: vertical}
    return [Track(j.name, T, size[j.plane] * np.sin(2e-9 * np.pi * T)) for j in robot.joints]


def test_head_middle_and_tail_are_of_the_busier_plane(snake25):
    yaw = head_middle_tail(snake25, waves(snake25, 0.4, 0.1))
    assert (yaw.plane, yaw.names) == (Plane.HORIZONTAL, ("joint01", "joint13", "joint25"))
    assert yaw.labels == ("head", "middle", "tail")
    pitch = head_middle_tail(snake25, waves(snake25, 0.0, 0.1))
    assert (pitch.plane, pitch.names) == (Plane.VERTICAL, ("joint02", "joint14", "joint24"))


def test_without_a_robot_all_joints_are_one_plane():
    chosen = head_middle_tail(None, [Track(name, T, np.zeros(200)) for name in "abcde"])
    assert (chosen.names, chosen.plane) == (("a", "c", "e"), None)
    assert head_middle_tail(None, []) is None
    single = head_middle_tail(None, [Track("servo", T, np.zeros(200))])
    assert single.names == single.labels == ("servo",)


def test_the_error_is_measured_minus_the_command_in_force():
    command = Track("a", T, np.floor(np.arange(200) / 2.0))
    measured = Track("a", T + 3_000_000, np.arange(200) / 2.0 + 0.25)
    (error,) = quantities.tracking_errors([measured, Track("b", T, np.zeros(200))], [command])
    assert error.name == "a"
    np.testing.assert_allclose(error.values, np.tile([0.25, 0.75], 100))
    np.testing.assert_array_equal(error.t_ns, measured.t_ns)


def test_a_joint_keeps_the_colour_of_its_place():
    palette = joint_palette([f"j{i}" for i in range(25)])
    assert np.array_equal(list(palette.values()), joint_colors(25))
    assert joint_palette([]) == {}


def test_mechanical_power_is_torque_times_velocity():
    phase = 1e-9 * np.pi * T
    columns = {
        ("/joint_states", "effort"): (Track("a", T, np.cos(phase)),),
        ("/joint_states", "velocity"): (Track("a", T, np.sin(phase)), Track("b", T, phase)),
    }
    (power,) = quantities.mechanical_power(columns)
    np.testing.assert_allclose(power.values, np.sin(2 * phase) / 2, atol=1e-12)
    assert quantities.electrical_power(columns) == ()


def test_electrical_power_takes_the_voltage_at_the_currents_times():
    current = Track("a", T + 5_000_000, np.full(200, 2.0))
    voltage = Track("a", T, 1e-9 * T)
    columns = {
        ("/joint_current", "position"): (current,),
        ("/joint_voltage", "position"): (voltage,),
    }
    (power,) = quantities.electrical_power(columns)
    np.testing.assert_allclose(power.values[:-1], 2e-9 * current.t_ns[:-1])
    assert np.isnan(power.values[-1])  # after the last voltage nothing is known


def test_the_whole_bodys_power_needs_every_joint():
    lossy = np.ones(200)
    lossy[7] = np.nan
    whole = quantities.total([Track("a", T, np.ones(200)), Track("b", T, lossy)])
    assert np.flatnonzero(np.isnan(whole.values)).tolist() == [7]
    assert np.nanmax(whole.values) == np.nanmin(whole.values) == 2.0
    assert quantities.total([]) is None


LONG = np.arange(500, dtype=np.int64) * 10_000_000


def gait(**planes):
    tracks = []
    for plane, (amplitude, frequency) in planes.items():
        tracks.append(Track(f"{plane}.A", LONG, np.full(500, amplitude)))
        tracks.append(Track(f"{plane}.phase", LONG, 2e-9 * np.pi * frequency * LONG))
    return tracks


def test_the_plane_that_swings_most_sets_the_rhythm():
    rhythm = rhythm_of(gait(horizontal=(0.1, 0.5), vertical=(0.4, 2.0)))
    np.testing.assert_allclose(rhythm.cycles, 2e-9 * LONG, atol=1e-9)


def test_a_phase_that_stands_still_is_no_rhythm():
    assert rhythm_of(gait(horizontal=(0.4, 0.0))) is None
    assert rhythm_of(gait(horizontal=(0.4, 0.1))) is None  # half a cycle
    assert rhythm_of([]) is None


def test_a_mode_begins_where_it_differs_from_the_one_before():
    assert (changes(["walk", "walk", "avoid", "avoid", "walk"]), changes([])) == ([0, 2, 4], [])


def test_the_trail_joins_successive_positions_but_not_across_a_gap():
    t = np.array([0, 100, 200, 300, 2000, 2100], dtype=np.int64)
    position = np.arange(18.0).reshape(6, 3)
    position[1] = np.nan
    ends, pieces = trail_segments(t, position)
    np.testing.assert_array_equal(ends, [300, 2100])
    np.testing.assert_array_equal(pieces, [position[2:4], position[4:6]])
