"""The line below the delays of a source's clock: points that are made, so that it is known."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from undulog.capture.recorder.source_clock import Envelope

HALF_NS = 500_000_000
STIFF = 1e-12  # of an expected rate that no points change


def envelope_of(points, **expected):
    """An envelope of some points, each the least delayed of its half second."""
    envelope = Envelope(**expected)
    for x, y in points:
        envelope.take(float(x), float(y))
        envelope.close_bucket()
    return envelope


def each_half_second(heights):
    return [(k * HALF_NS, height) for k, height in enumerate(heights)]


def test_an_envelope_without_points_has_what_is_expected():
    envelope = Envelope()
    assert (envelope.empty, envelope.settled) == (True, False)
    line = envelope.line
    assert (line.offset_ns, line.rate, line.uncertainty, line.spread_ns) == (0.0, 0.0, 1e-4, 0.0)
    envelope.close_bucket()
    assert envelope.empty
    envelope.take(0.0, 7.0)
    assert not envelope.empty
    assert not envelope_of([(0, 7)] * 3).settled
    assert envelope_of([(0, 7)] * 4).settled


def test_the_first_point_and_each_lower_one_move_the_line():
    envelope = Envelope(rate=0.01, sigma=STIFF)
    envelope.take(100.0, 5.0)
    assert envelope.line.offset_ns == pytest.approx(4.0)
    envelope.take(200.0, 6.5)
    assert envelope.line.offset_ns == pytest.approx(4.0)
    envelope.take(300.0, 5.0)
    assert envelope.line.offset_ns == pytest.approx(2.0)
    assert (envelope.line.rate, envelope.line.uncertainty) == (0.01, STIFF)


def test_the_point_of_half_a_second_is_the_lowest_above_the_line():
    envelope = Envelope(rate=0.01, sigma=STIFF)
    for x, y in ((0.0, 5.0), (100.0, 5.5), (200.0, 6.6)):
        envelope.take(x, y)
    envelope.close_bucket()
    envelope.take(300.0, 9.0)
    envelope.close_bucket()
    line = envelope.line  # through (100, 5.5); the other point is 1.5 above it
    assert (line.offset_ns, line.rate) == (pytest.approx(4.5), pytest.approx(0.01))
    assert line.spread_ns == pytest.approx(0.75)


def lower_edge(points):
    """Slope of the lower hull's edge at the mean x, by the Quickhull library."""
    hull = ConvexHull(points)
    mean, slopes = points[:, 0].mean(), []
    for simplex, (_, normal_y, _) in zip(hull.simplices, hull.equations, strict=True):
        (x0, y0), (x1, y1) = points[simplex]
        if normal_y < 0 and min(x0, x1) < mean <= max(x0, x1):
            slopes.append((y1 - y0) / (x1 - x0))
    (slope,) = slopes
    return slope


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("prior", [(0.0, 1e-4), (3e-5, 2e-5), (-1e-4, 1e-3)])
def test_the_rate_is_that_of_the_edge_weighted_with_the_expected_one(seed, prior):
    """Two normal densities: precisions add, means are weighted with them."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, 60))
    x = np.cumsum(rng.uniform(0.3, 0.7, count)) * 1e9
    points = np.column_stack([x, rng.uniform(-5e-5, 5e-5) * x + rng.exponential(4e5, count)])
    if seed == 0:
        points[:, 1] += 0.05 * x  # beyond any clock's
    line = envelope_of(points, rate=prior[0], sigma=prior[1]).line
    slope = min(lower_edge(points), 0.02)
    above = points[:, 1] - slope * x
    spread = (above - above.min()).sum() / (count - 2)
    unsure = spread * np.sqrt(12 / count) / np.ptp(x)
    precisions = np.array([prior[1] ** -2.0, unsure**-2.0])
    rate = np.average([prior[0], slope], weights=precisions)
    heights = points[:, 1] - rate * x
    assert line.rate == pytest.approx(rate, rel=1e-6, abs=1e-13)
    assert line.uncertainty == pytest.approx(precisions.sum() ** -0.5, rel=1e-3)
    assert line.offset_ns == pytest.approx(heights.min(), rel=1e-6, abs=1.0)
    assert line.spread_ns == pytest.approx((heights - heights.min()).mean(), rel=1e-6)


def test_of_points_at_one_time_the_lowest_counts():
    steep = envelope_of([(0, 0), (0, 9e6), (HALF_NS, 0), (HALF_NS, 5e6)], sigma=1.0)
    assert (steep.line.rate, steep.line.offset_ns) == (pytest.approx(0.0, abs=1e-9), 0.0)
    assert steep.line.spread_ns == pytest.approx(14e6 / 4)
    same = envelope_of([(5, 3.0)] * 6)
    assert (same.line.rate, same.line.offset_ns, same.line.uncertainty) == (0.0, 3.0, 1e-4)


def test_a_point_counts_for_120_half_seconds():
    low = [-1000.0, *[0.0] * 118]
    assert envelope_of(each_half_second([*low, 0.0]), sigma=STIFF).line.offset_ns == -1000.0
    assert envelope_of(each_half_second([*low, 0.0, 0.0]), sigma=STIFF).line.offset_ns == 0.0


# -- steps of the least delay ----------------------------------------------------------------------

LEAST_NS = 3_000_000  # the smallest step


@pytest.mark.parametrize("count", [9, 10])
@pytest.mark.parametrize("beyond", [0, 1])
def test_a_step_down_drops_what_was_before(count, beyond):
    envelope = envelope_of(each_half_second([0.0] * count))
    envelope.take(count * HALF_NS, -LEAST_NS - beyond)
    outdated = count == 10 and beyond == 1
    assert envelope.settled is not outdated
    assert envelope.line.offset_ns == -LEAST_NS - beyond
    if outdated:
        assert (envelope.line.rate, envelope.line.uncertainty) == (0.0, 1e-6)
        envelope.close_bucket()
        assert envelope.line.uncertainty == 1e-6


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_step_among_noise_is_ten_of_its_mean_heights(beyond):
    noisy = envelope_of(each_half_second([0.0, 2e6] * 10), sigma=STIFF)
    assert noisy.line.spread_ns == 1e6
    noisy.take(20 * HALF_NS, -10e6 - beyond)
    assert noisy.settled is not (beyond == 1)


def test_after_a_step_down_the_rate_is_expected_three_times_as_uncertain():
    heights = [0.0, 2e5] * 10
    envelope = envelope_of(each_half_second(heights))
    sigma = envelope.line.uncertainty
    assert 1e-6 < 3 * sigma < 1e-4
    envelope.take(20 * HALF_NS, -4e6)
    assert envelope.line.uncertainty == pytest.approx(3 * sigma)
    unsure = envelope_of(each_half_second([0.0, 2e6] * 10), sigma=1e-3)
    assert unsure.line.uncertainty > 1e-4 / 3
    unsure.take(20 * HALF_NS, -2e7)
    assert unsure.line.uncertainty == pytest.approx(1e-4)  # no more than of a plain quartz


@pytest.mark.parametrize(("before", "after", "step_ns"), [
    (10, 10, LEAST_NS), (10, 9, LEAST_NS + 1), (9, 10, LEAST_NS + 1), (10, 10, LEAST_NS + 1),
    (30, 10, LEAST_NS + 1),
])  # fmt: skip
def test_a_step_up_of_ten_points_in_a_row_drops_what_was_before(before, after, step_ns):
    heights = [0.0] * before + [float(step_ns)] * after
    line = envelope_of(each_half_second(heights), sigma=STIFF).line
    outdated = before >= 10 and after == 10 and step_ns > LEAST_NS
    assert line.offset_ns == pytest.approx(step_ns if outdated else 0.0, abs=1e-3)
    if outdated:
        assert line.spread_ns == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_step_up_among_noise_is_ten_mean_heights_of_the_points_before(beyond):
    heights = [0.0, 2e6] * 5 + [10e6 + beyond] * 10
    line = envelope_of(each_half_second(heights), sigma=STIFF).line
    assert line.offset_ns == pytest.approx(beyond * (10e6 + 1), abs=1e-2)
