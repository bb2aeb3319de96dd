"""Local kicks on systems whose answers are known in closed form."""

import numpy as np
import pytest

from support.linear_chain import asymmetry, within
from undulog.analysis.estimators.intervals import NoisyMatrix
from undulog.analysis.experiment.kick_coupling import predict, valid_to
from undulog.analysis.experiment.kick_runs import (
    Kick,
    KickKind,
    deviation_of,
    kick_of,
    missing_kicks,
    sort_kicks,
)
from undulog.analysis.experiment.local_coupling import (
    ResponseMatrices,
    central_differences,
    lti_reading,
    nonlinearity,
    row_sums,
)
from undulog.capture.common.errors import UsageError

NAMES = ("head", "neck", "waist", "hip", "tail")
M = len(NAMES)


def planted(seed=3, m=M, reciprocal=False):
    """A response matrix with strong coupling, and the commands of a wave."""
    rng = np.random.default_rng(seed)
    H = 0.15 * (rng.normal(size=(m, m)) + 1j * rng.normal(size=(m, m)))
    if reciprocal:
        H = (H + H.T) / 2
    H += np.diag(0.9 * np.exp(-0.2j) * np.ones(m))
    return H, 0.4 * np.exp(-1j * np.pi / 3 * np.arange(m))


def logarithms(H, command):
    """d ln a / d ln c of a = H c, by hand."""
    return H * command[None, :] / (H @ command)[:, None]


def plan(m=M, size=0.05):
    return [
        Kick(j, kind, sign * size)
        for kind in (KickKind.PHASE, KickKind.AMPLITUDE)
        for j in range(m)
        for sign in (1, -1)
    ]


def kicked(command, kick):
    off = np.zeros(len(command), dtype=complex)
    off[kick.joint] = kick.size * (1j if kick.kind is KickKind.PHASE else 1.0)
    return command * np.exp(off)


def run_all(system, command, kicks, turns=None):
    """Changes of the responses of every kick; each run started at its own time."""
    commands = np.stack([kicked(command, kick) for kick in kicks])
    deviation = np.log(commands / command)
    if turns is not None:
        commands = commands * np.exp(1j * turns)[:, None]
        deviation = np.stack([deviation_of(kicked, command) for kicked in commands])
    ratio = np.stack([system(command) / command for command in commands])
    return deviation + np.log(ratio / (system(command) / command))


def noisy(rng, log, sigma):
    return log + sigma * (rng.normal(size=log.shape) + 1j * rng.normal(size=log.shape))


def measure(log, kicks, variance=0.0, dof=10.0):
    variances = np.broadcast_to(variance, (2, *log.shape))
    answers = ResponseMatrices(log, *variances, np.full(log.shape, dof))
    P, R = central_differences(kicks, answers, KickKind.PHASE)
    S, G = central_differences(kicks, answers, KickKind.AMPLITUDE)
    return P, R, G, S


@pytest.mark.parametrize("size", [0.05, 0.005])
def test_a_linear_system_has_all_four_in_closed_form(size):
    """ln a_i = ln(1 + L (e^x - 1)) + const, so even what a finite kick adds is known."""
    H, command = planted()
    L = logarithms(H, command)
    curved = size**2 / 6 * L * (1 - L) * (1 - 2 * L)
    P, R, G, S = measure(run_all(lambda c: H @ c, command, plan(size=size)), plan(size=size))
    small = 3 * size**4
    np.testing.assert_allclose(P.value, (L - curved).real, atol=small)
    np.testing.assert_allclose(R.value, -(L - curved).imag, atol=small)
    np.testing.assert_allclose(G.value, (L + curved).real, atol=small)
    np.testing.assert_allclose(S.value, (L + curved).imag, atol=small)


def test_rows_sum_as_time_shift_demands():
    H, command = planted()
    kicks = plan(size=1e-3)
    for system in (lambda c: H @ c, lambda c: H @ (c * (1 - 0.8 * np.abs(c) ** 2))):
        P, R, *_ = measure(run_all(system, command, kicks), kicks)
        np.testing.assert_allclose(row_sums(P).value, 1.0, atol=1e-6)
        np.testing.assert_allclose(row_sums(R).value, 0.0, atol=1e-6)


def test_when_each_run_started_does_not_matter():
    H, command = planted()
    turns = np.random.default_rng(0).uniform(-np.pi, np.pi, len(plan()))
    still, shifted = (run_all(lambda c: H @ c, command, plan(), t) for t in (None, turns))
    np.testing.assert_allclose(shifted, still, rtol=0.0, atol=1e-14)


@pytest.mark.nightly
def test_intervals_cover_what_was_planted():
    """Noise of known variance, each error estimated with 8 degrees of freedom as a fit gives it."""
    H, command = planted(m=3)
    kicks = plan(m=3)
    log = run_all(lambda c: H @ c, command, kicks)
    clean = measure(log, kicks)
    truth = np.stack([matrix.value for matrix in clean])
    sums = [row_sums(matrix).value for matrix in clean[:2]]
    rng = np.random.default_rng(7)
    sigma, dof, count = 1e-3, 8, 3000
    inside, rows = np.zeros(truth.shape), np.zeros((2, 3))
    for _ in range(count):
        log_noisy = noisy(rng, log, sigma)
        estimated = sigma**2 * rng.chisquare(dof, (2, *log.shape)) / dof
        P, R, G, S = measure(log_noisy, kicks, estimated, float(dof))
        for k, matrix in enumerate((P, R, G, S)):
            inside[k] += np.abs(matrix.value - truth[k]) <= matrix.half
        for k, matrix in enumerate((P, R)):
            total = row_sums(matrix)
            rows[k] += np.abs(total.value - sums[k]) <= 2.0 * total.error  # 95.4 % of a Gaussian
    for covered in (inside / count, rows / count):
        assert 0.93 < covered.min() <= covered.max() < 0.97


def test_the_nonlinearity_of_a_cubic_servo_in_closed_form():
    """a = H n(c) c with n = 1 - b |c|^2: G and S are those of a linear chain times g."""
    H, command = planted()
    b = 0.8
    size = abs(command[0]) ** 2
    g = (1 - 3 * b * size) / (1 - b * size)
    kicks = plan(size=1e-4)
    log = run_all(lambda c: H @ (c * (1 - b * np.abs(c) ** 2)), command, kicks)
    P, R, G, S = measure(log, kicks)
    np.testing.assert_allclose(G.value, g * P.value, atol=1e-6)
    np.testing.assert_allclose(S.value, -g * R.value, atol=1e-6)
    index = nonlinearity(P, R, G, S)
    assert index.value == pytest.approx(1 - g, rel=1e-5)
    assert index.ci95 == pytest.approx((1 - g, 1 - g), rel=1e-5)


@pytest.mark.parametrize(
    "b", [0.1, *(pytest.param(b, marks=pytest.mark.nightly) for b in (0.0, 0.8))]
)
def test_the_interval_of_the_nonlinearity_covers(b):
    H, command = planted()
    size = abs(command[0]) ** 2
    truth = 1 - (1 - 3 * b * size) / (1 - b * size)
    kicks = plan()
    log = run_all(lambda c: H @ (c * (1 - b * np.abs(c) ** 2)), command, kicks)
    rng = np.random.default_rng(5)
    sigma, covered, values = 2e-3, 0, []
    for _ in range(200):
        index = nonlinearity(*measure(noisy(rng, log, sigma), kicks, sigma**2, 40.0))
        covered += index.ci95[0] <= truth <= index.ci95[1]
        values.append(index.value)
    assert covered >= 0.95 * 200  # conservative by construction
    if b == 0.8:
        assert np.mean(values) == pytest.approx(truth, rel=0.02)


def shape(reading):
    return reading.asymmetry, reading.within_1, reading.within_2, reading.within_3


def planted_shape(H):
    X = np.linalg.inv(H)
    return [asymmetry(X), *(within(X, width) for width in (1, 2, 3))]


@pytest.mark.parametrize("reciprocal", [True, False])
def test_the_linear_reading_gives_back_what_was_planted(reciprocal):
    H, command = planted(reciprocal=reciprocal)
    kicks = plan(size=1e-4)
    P, R, *_ = measure(run_all(lambda c: H @ c, command, kicks), kicks)
    reading = lti_reading(P, R, H @ command, command)
    np.testing.assert_allclose(reading.real, H.real, atol=1e-7)
    np.testing.assert_allclose(reading.imag, H.imag, atol=1e-7)
    assert reading.condition_number == pytest.approx(np.linalg.cond(H), rel=1e-6)
    assert [estimate.value for estimate in shape(reading)] == pytest.approx(
        planted_shape(H), abs=1e-6
    )
    # Also where the coupling isn't directed: an asymmetric P is no sign of that.
    assert np.linalg.norm(P.value - P.value.T) > 0.1


@pytest.mark.parametrize("reciprocal", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_the_intervals_of_the_linear_reading_cover(reciprocal):
    """Also where the truth is zero: a reciprocal chain has no asymmetry, noise has."""
    H, command = planted(reciprocal=reciprocal)
    truth = planted_shape(H)
    kicks = plan(size=0.01)
    log = run_all(lambda c: H @ c, command, kicks)
    rng = np.random.default_rng(9)
    sigma, covered = 1e-4, np.zeros(4)
    for _ in range(100):
        P, R, *_ = measure(noisy(rng, log, sigma), kicks, sigma**2, 40.0)
        shapes = shape(lti_reading(P, R, H @ command, command))
        covered += [
            estimate.ci95[0] <= t <= estimate.ci95[1]
            for estimate, t in zip(shapes, truth, strict=True)
        ]
    assert covered.min() >= 95  # conservative by construction


def test_a_singular_reading_is_not_inverted():
    flat = NoisyMatrix(np.full((3, 3), 1 / 3), np.full((3, 3), 1e-3), np.full((3, 3), 9.0))
    nothing = NoisyMatrix(np.zeros((3, 3)), np.full((3, 3), 1e-3), np.full((3, 3), 9.0))
    reading = lti_reading(flat, nothing, np.ones(3, complex), np.ones(3, complex))
    assert reading.asymmetry.value is None
    assert reading.condition_number is None or reading.condition_number > 1e10


def test_held_out_patterns_tell_how_far_it_holds():
    H, command = planted()
    kicks = plan()
    P, R, G, S = measure(run_all(lambda c: H @ c, command, kicks), kicks)
    response = H @ command
    rng = np.random.default_rng(2)
    predictions = []
    shape = rng.uniform(-1, 1, M)
    for size in (0.05, 0.15, 0.6):
        deviation = 1j * size * shape
        answered = np.log(H @ (command * np.exp(deviation)) / response)
        matrices = tuple(matrix.value for matrix in (P, R, G, S))
        predictions.append(predict(deviation, answered, np.zeros(M), response, matrices))
    errors = [prediction.error for prediction in predictions]
    assert errors[0] < errors[1] < errors[2]
    # What is left is of second order: nine times as much at three times the size.
    assert 7 < errors[1] / errors[0] < 11
    assert predictions[0].error_kept / predictions[0].error > 10
    assert (valid_to(predictions[:2]), valid_to([])) == (predictions[1].size, None)


def test_kicks_are_estimated_from_phasors():
    _, command = planted()
    rng = np.random.default_rng(1)
    kicks = plan()
    pattern = command * np.exp(0.15j * np.array([1, -1, 0.5, 0.2, -0.7]))
    runs = [command, command, *(kicked(command, kick) for kick in kicks), pattern]
    order = rng.permutation(len(runs))
    sorted_kicks = sort_kicks(
        np.stack([runs[k] * np.exp(1j * rng.uniform(-np.pi, np.pi)) for k in order])
    )
    assert {int(order[k]) for k in sorted_kicks.base} == {0, 1}
    assert [int(order[k]) for k in sorted_kicks.patterns] == [len(runs) - 1]
    for k, kick in sorted_kicks.kicks.items():
        truth = kicks[order[k] - 2]
        assert (kick.joint, kick.kind) == (truth.joint, truth.kind)
        assert kick.size == pytest.approx(truth.size, abs=1e-12)
    assert missing_kicks(list(sorted_kicks.kicks.values()), KickKind.PHASE, NAMES) == ()


def test_what_is_no_kick():
    _, command = planted()
    for off in (0.05 + 0.05j, 0.3j):
        assert kick_of(deviation_of(command * np.exp([0, off, 0, 0, 0]), command)) is None
    for few in ([command, command], [command[:2]] * 3):
        assert sort_kicks(np.stack(few)) is None


def test_one_sided_kicks_are_refused():
    H, command = planted()
    kicks = [kick for kick in plan() if kick.size > 0 or kick.joint != 2]
    assert missing_kicks(kicks, KickKind.PHASE, NAMES) == ("waist only up",)
    uneven = [Kick(0, KickKind.PHASE, 0.05), Kick(0, KickKind.PHASE, -0.03)]
    missing = missing_kicks(uneven, KickKind.PHASE, NAMES)
    assert missing[:2] == ("head by +0.050 and -0.030", "neck not at all")
    log = run_all(lambda c: H @ c, command, kicks)
    with pytest.raises(UsageError, match=r"joint 3 of 5: .* not kicked both up and down"):
        measure(log, kicks)
