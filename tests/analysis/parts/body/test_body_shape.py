"""Modes, serpenoids and the virtual chassis of motions that are known in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.viscous_swimmer import Swimmer
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.body.oscillation import fit_motion
from undulog.analysis.parts.body.shape import plane_shapes
from undulog.analysis.parts.body.travel import step_of_cycle, virtual_chassis
from undulog.analysis.response.fitting import fit_gait
from undulog.analysis.signals.windows import Span
from undulog.capture import load_robot

FREQUENCY = 0.8
SPAN = Span(0, 0.0, 10 / FREQUENCY, 10)


def shapes(angle_of, joints, *, noise=0.0, seed=0, robot=None, names=None):
    """Measure joints, each a function of its number and the phase, at 100 Hz over ten cycles."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, SPAN.stop_s, 0.01)
    names = names or [f"joint{k + 1:02d}" for k in range(joints)]
    phase = 2 * np.pi * FREQUENCY * t
    series = {
        name: Series(name, t, angle_of(k, phase) + noise * random.standard_normal(t.size))
        for k, name in enumerate(names)
    }
    gait = fit_gait({}, series, SPAN.stop_s, lambda _: None)
    return plane_shapes(robot, fit_motion(series, gait), SPAN, set(series))


@settings(max_examples=15, deadline=None)
@given(
    amplitude=st.floats(0.05, 0.8),
    lag=st.floats(-1.5, 1.5).filter(lambda lag: abs(lag) > 0.1),
    start=st.floats(-3.0, 3.0),
    offset=st.floats(-0.5, 0.5),
)
def test_a_serpenoid_comes_back_exactly(amplitude, lag, start, offset):
    def angle(k, phase):
        return offset + amplitude * np.cos(phase - lag * k + start)

    (plane,) = shapes(angle, 9)
    curve = plane.serpenoid
    assert curve.amplitude_rad.value == pytest.approx(amplitude, rel=1e-7)
    assert curve.wave_number.value == pytest.approx(lag, abs=1e-7)
    assert curve.phase_rad.value == pytest.approx(start, abs=1e-6)
    assert curve.offset_rad.value == pytest.approx(offset, abs=1e-3)
    assert curve.waves.value == pytest.approx(8 * abs(lag) / (2 * np.pi), abs=1e-6)
    assert curve.speed.value == pytest.approx(2 * np.pi * FREQUENCY / abs(lag), rel=1e-6)
    assert curve.unexplained.value == pytest.approx(0.0, abs=1e-9)
    # A wave lies in the plane of its cosine and its sine.
    assert sum(mode.share.value for mode in plane.modes[:2]) == pytest.approx(1.0, abs=1e-9)


def test_the_residual_of_a_planted_mode_is_its_share():
    """A standing mode at twice the frequency: b^2 / (a^2 + b^2) of the mean square."""
    weights = np.array([1, -1, 1, -1, 1, -1, 1, -1.0])

    def angle(k, phase):
        return 0.4 * np.cos(phase - np.pi / 4 * k) + 0.1 * weights[k] * np.cos(2 * phase)

    (plane,) = shapes(angle, 8)
    share = 0.1**2 / (0.4**2 + 0.1**2)
    assert plane.serpenoid.unexplained.value == pytest.approx(share, rel=1e-6)
    assert plane.serpenoid.amplitude_rad.value == pytest.approx(0.4, rel=1e-6)
    # A whole wave over eight joints has modes of one size, and the planted one is orthogonal.
    assert [mode.share.value for mode in plane.modes] == pytest.approx(
        [(1 - share) / 2, (1 - share) / 2, share], rel=2e-3
    )
    np.testing.assert_allclose(np.abs(plane.modes[2].weights), 1 / 8**0.5, atol=1e-3)


def test_an_offset_of_some_joints_is_no_serpenoid():
    def angle(k, phase):
        return 0.4 * np.cos(phase - 0.7 * k) + (0.2 if k % 2 else -0.2)

    (plane,) = shapes(angle, 8)
    assert plane.serpenoid.unexplained.value == pytest.approx(0.04 / (0.04 + 0.08), rel=1e-6)
    assert plane.serpenoid.offset_rad.value == pytest.approx(0.0, abs=1e-3)


@pytest.mark.nightly
def test_intervals_cover_what_noise_does():
    hits = []
    for seed in range(40):
        (plane,) = shapes(lambda k, x: 0.3 * np.cos(x - 0.6 * k), 7, noise=0.02, seed=seed)
        curve = plane.serpenoid
        expected = ((curve.amplitude_rad, 0.3), (curve.wave_number, 0.6), (curve.phase_rad, 0.0))
        hits.append([estimate.ci95[0] <= value <= estimate.ci95[1] for estimate, value in expected])
    assert np.all(np.mean(hits, axis=0) >= 0.85)


def test_planes_of_fewer_than_four_or_still_joints_have_no_shape():
    assert shapes(lambda k, x: 0.3 * np.cos(x - 0.6 * k), 3) == ()
    robot = load_robot("snake25")

    def angle(k, phase):
        return (0.3 if k % 2 == 0 else 0.003) * np.cos(phase - 0.3 * k)

    (plane,) = shapes(angle, 25, robot=robot, names=robot.joint_names)
    assert (plane.plane, len(plane.joints)) == ("horizontal", 13)
    assert plane.serpenoid.wave_number.value == pytest.approx(0.6, abs=1e-7)
    length = 2 * robot.links[0].length
    assert plane.serpenoid.speed_m_s.value == pytest.approx(
        length * 2 * np.pi * FREQUENCY / 0.6, rel=1e-6
    )


@given(
    angles=st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=8),
    place=st.complex_numbers(max_magnitude=10.0),
    turn=st.floats(-3.0, 3.0),
)
def test_the_virtual_chassis_is_that_of_the_singular_value_decomposition(angles, place, turn):
    swimmer = Swimmer()
    centres, _ = swimmer.links(np.array(angles))
    expected, heading = swimmer.chassis(np.array(angles))
    moved = place + centres * np.exp(1j * turn)
    seen = virtual_chassis(np.stack([moved.real, moved.imag], axis=-1)[None])
    assert seen[0][0] == pytest.approx(place + expected * np.exp(1j * turn), abs=1e-9)
    assert np.exp(1j * seen[1][0]) == pytest.approx(np.exp(1j * (heading + turn)), abs=1e-7)
    off = moved - moved.mean()
    sizes = np.linalg.svd(np.stack([off.real, off.imag]), compute_uv=False) / off.size**0.5
    np.testing.assert_allclose(seen[2][0], sizes, atol=1e-7)


def test_a_constant_velocity_in_the_body_is_an_arc():
    velocity = np.tile([[0.3], [0.0], [0.2]], (1, 128))
    forward, left, turn = step_of_cycle(velocity)
    angle = 0.2 * 2 * np.pi
    assert turn == pytest.approx(angle)
    # The chord of an arc of radius 0.3 / 0.2.
    assert np.hypot(forward, left) == pytest.approx(2 * 1.5 * np.sin(angle / 2))
    assert abs(left) < 0.02 * forward
