"""Odd random-phase multisines: their lines, phases and limits, read back from the files."""

import numpy as np
import pytest

from support.joint_runs import turns, write_joints
from undulog.analysis.plan.designs import GROUP, odd_lines, random_phase_runs
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import UsageError

ROBOT = load_robot("snake25")
DRIVEN = ("joint01", "joint03", "joint05")
PERIOD_S = 4.0
BAND = ("--band", 0.25, 5.0, "--period", PERIOD_S, "--realisations", 2, "--amplitude", 0.03)


@pytest.fixture(scope="module")
def like(tmp_path_factory):
    asked = np.tile(np.linspace(-0.1, 0.1, 25), (300, 1))
    places = [ROBOT.joint_names.index(name) for name in DRIVEN]
    asked[:, places] += np.real(0.2 * np.exp(-1j * np.arange(3)) * turns(0.8, 300))
    path = tmp_path_factory.mktemp("like") / "like.mcap"
    return write_joints(path, ROBOT.joint_names, asked, [asked], robot=ROBOT)


def period(path, which):
    """The commands of all joints in one period, shape (samples, joints), and the plan's record."""
    with Session.open(path) as session:
        signals = session.joints("/joint_commands")
        values = np.stack([signals.signal(name).values for name in ROBOT.joint_names], axis=1)
        plan = dict(session.metadata["undulog.plan"])
    length = round(PERIOD_S * 100)
    return values[which * length : (which + 1) * length], plan


@pytest.mark.parametrize("inputs", ["same", "orthogonal"])
def test_only_the_excited_lines_are_commanded(inputs, like, tmp_path, report_of):
    words = ("--like", like, "-o", tmp_path / "m", *BAND, "--inputs", inputs)
    plan = report_of("plan", "multisine", *words)
    lines = np.array(plan["lines"])
    assert (lines % 2 == 1).all()
    assert (lines.min() >= 1, lines.max() <= 20) == (True, True)
    assert len(plan["files"]) == (2 if inputs == "same" else 6)
    places = [ROBOT.joint_names.index(name) for name in DRIVEN]
    matrices = {}
    for k, file in enumerate(plan["files"]):
        first, record = period(file, 1)
        second, _ = period(file, 2)
        np.testing.assert_allclose(first, second, atol=1e-9)
        offset = np.linspace(-0.1, 0.1, 25)
        np.testing.assert_allclose(first.mean(axis=0), offset, atol=1e-4)
        assert [*map(int, record["lines"].split())] == lines.tolist()
        assert (record["run"], record["inputs"], record["kind"]) == (
            str(k),
            inputs,
            "odd-random-phase",
        )
        spectrum = np.fft.rfft(first[:, places] - first[:, places].mean(axis=0), axis=0) / 200
        rms = np.sqrt(np.sum(np.abs(spectrum) ** 2, axis=0) / 2)
        np.testing.assert_allclose(rms, 0.03, rtol=1e-6)
        np.testing.assert_allclose(np.abs(spectrum[lines]), np.abs(spectrum[lines[0], 0]))
        others = np.setdiff1d(np.arange(201), lines)
        assert np.abs(spectrum[others]).max() < 1e-9
        assert np.abs(first[:, places] - offset[places]).max() <= float(record["peak_rad"]) + 1e-4
        matrices.setdefault(record["realisation"], []).append(spectrum[lines])
    assert len(matrices) == 2
    chosen, other = (np.stack(matrix) for matrix in matrices.values())
    assert np.abs(chosen - other).max() > 0.01  # other phases
    if inputs == "orthogonal":
        for matrix in (chosen, other):
            assert np.linalg.cond(np.moveaxis(matrix, 1, 0)).max() == pytest.approx(1.0, abs=1e-6)


def test_one_odd_line_of_each_group_is_left_out_whatever_the_seed():
    drawn = {tuple(odd_lines((0.1, 4.0), 10.0, seed)) for seed in range(20)}
    assert len(drawn) > 10
    for lines in drawn:
        missing = np.setdiff1d(np.arange(1, 41, 2), lines)
        assert len(missing) == 20 // GROUP
        assert (np.diff(missing // (2 * GROUP)) == 1).all()


def test_the_peak_is_low_and_can_be_chosen():
    lines = odd_lines((0.1, 6.0), 10.0, 1)
    shared, runs = random_phase_runs(
        2, lines, 10.0, 0.2, of_peak=True, realisations=5, inputs="same", seed=3
    )
    assert shared.peak == pytest.approx(0.2)
    t = np.arange(4000) / 400
    highest = 0.0
    for run in runs:
        wave = sum(np.real(tone.amplitude[0] * np.exp(1j * tone.omega * t)) for tone in run.more)
        highest = max(highest, np.abs(wave).max())
        assert np.abs(wave).max() / wave.std() < 2.4  # of one random draw about 3
    assert highest == pytest.approx(0.2, rel=0.02)


def test_what_is_refused(like, tmp_path, command):
    words = ("plan", "multisine", "--like", like, "-o", tmp_path / "x")
    for more, why in (
        (("--band", 0.1, 0.5, "--period", 4), "take a longer --period"),
        (("--band", 5, 0.5), "not from a lower to a higher"),
        (("--band", 0.1, 40), "up to 12.5 Hz"),
        (("--band", 0.1, 4, "--period", 1.2345), "not a multiple"),
        (("--band", 0.05, 0.5, "--period", 40, "--amplitude", 0.9), "its limits are"),
        (("--band", 2, 12, "--amplitude", 0.15), "rad/s, its limit is"),
        (("--band", 0.1, 4, "--tones", 4), "leave out --tones"),
        (("--band", 0.1, 4, "--joint", "elbow"), "no commands of elbow"),
        (("--band", 0.1, 4, "--realisations", 0), "at least 1"),
        (("--realisations", 4), "only with --band"),
    ):
        assert why in command(*words, *map(str, more), code=2).err
    assert not (tmp_path / "x").exists()
    with pytest.raises(UsageError, match="excited lines, at most"):
        odd_lines((0.1, 10.0), 1000.0, 1)
