"""Closest points against brute force: a segment sampled finely, and parting by trial."""

import math

import numpy as np
import pytest

from undulog.sim.scenario.obstacles import to_circles, to_rectangles

PLACES = np.linspace(-1.0, 1.0, 20001)


def random_segments(seed, count, length):
    random = np.random.default_rng(seed)
    middle = random.uniform(-1.5, 1.5, (2, count))
    angle = random.uniform(0, 2 * math.pi, count)
    half = random.uniform(0.0, length, count) * np.array([np.cos(angle), np.sin(angle)])
    return random, middle, half


def outside(point, size):
    """Distance of points (2, k) from a rectangle about the origin, 0 inside."""
    return np.hypot(*np.maximum(np.abs(point) - size[:, None], 0.0))


@pytest.mark.parametrize("seed", range(3))
def test_circles(seed):
    random, middle, half = random_segments(seed, 200, 1.0)
    centre, radius = random.uniform(-1, 1, (2, 200)), random.uniform(0.1, 0.5, 200)
    circles = to_circles(middle, half, centre, radius)
    for i in range(200):
        points = middle[:, i, None] + PLACES * half[:, i, None]
        brute = np.hypot(*(points - centre[:, i, None])).min() - radius[i]
        assert circles.distance[i] == pytest.approx(brute, abs=1e-4)
        assert circles.distance[i] <= brute + 1e-12
        touch = centre[:, i] + (radius[i] + circles.distance[i]) * circles.normal[:, i]
        np.testing.assert_allclose(touch, middle[:, i] + circles.s[i] * half[:, i], atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_rectangles_apart(seed):
    random, middle, half = random_segments(seed, 300, 1.0)
    size = random.uniform(0.1, 0.8, (2, 300))
    rectangles = to_rectangles(middle, half, size)
    apart = rectangles.distance > 0.0
    assert apart.sum() > 100
    np.testing.assert_allclose(np.hypot(*rectangles.normal), 1.0, rtol=1e-12)
    for i in range(300):
        brute = outside(middle[:, i, None] + PLACES * half[:, i, None], size[:, i]).min()
        assert max(rectangles.distance[i], 0.0) == pytest.approx(brute, abs=1e-4)
        if apart[i]:
            # The point on the rectangle that the normal leads back to is on its edge.
            foot = (
                middle[:, i]
                + rectangles.s[i] * half[:, i]
                - rectangles.distance[i] * rectangles.normal[:, i]
            )
            assert np.abs(np.abs(foot) - size[:, i]).min() < 1e-9
            assert (np.abs(foot) <= size[:, i] + 1e-9).all()


@pytest.mark.parametrize("seed", range(3))
def test_rectangles_overlapped_part_by_the_shortest_way_out(seed):
    random, middle, half = random_segments(seed, 300, 0.8)
    middle *= 0.4
    size = random.uniform(0.2, 0.8, (2, 300))
    rectangles = to_rectangles(middle, half, size)
    inside = np.flatnonzero(rectangles.distance < -0.03)  # brute force misses what is shallower
    assert len(inside) > 100
    for i in inside:
        depth, normal = -rectangles.distance[i], rectangles.normal[:, i]

        def apart(shift, i=i):
            points = (middle[:, i] + shift)[:, None] + PLACES[::20] * half[:, i, None]
            return outside(points, size[:, i]).min() > 0.0

        assert apart(1.001 * depth * normal)
        assert not apart(0.9 * depth * normal)
        # No shorter way leads out, in any direction.
        turns = np.linspace(0, 2 * math.pi, 37)
        assert not any(apart(0.9 * depth * np.array([math.cos(t), math.sin(t)])) for t in turns)


def test_depth_and_normal_go_on_smoothly_from_a_touch():
    size = np.array([[0.5], [0.3]])
    for middle, half, way, normal in (
        ((0.7, 0.1), (0.2, 0.05), (-1, 0), (1, 0)),  # an end into a face
        ((0.6, 0.4), (-0.3, 0.3), (-1, -1), (1 / math.sqrt(2),) * 2),  # a corner into a side
    ):
        step = 1e-6 * np.array(way) / np.hypot(*way)
        touch = to_rectangles(np.array([middle]).T, np.array([half]).T, size).distance[0]
        start = np.array(middle) - touch * np.array(normal)
        for k in (-2, -1, 1, 2):
            rectangles = to_rectangles((start + k * step)[:, None], np.array([half]).T, size)
            assert rectangles.distance[0] == pytest.approx(-k * 1e-6, abs=1e-9)
            np.testing.assert_allclose(rectangles.normal[:, 0], normal, atol=1e-6)


def test_a_segment_that_is_a_point_in_plan_view():
    size = np.array([[0.5, 0.5], [0.3, 0.3]])
    rectangles = to_rectangles(np.array([[0.8, 0.45], [0.0, 0.1]]), np.zeros((2, 2)), size)
    np.testing.assert_allclose(rectangles.distance, [0.3, -0.05])
    np.testing.assert_allclose(rectangles.normal, [[1, 1], [0, 0]])
