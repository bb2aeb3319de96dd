"""Sessions whose joints run at several frequencies: numbers, text, page and experiments."""

import json

import numpy as np
import pytest

from support.analysed import analysed, experiment
from support.joint_runs import EPOCH_NS, write_joints
from undulog.analysis.present.result_files import load

RATE = 50


def write(path, omegas, group, waves, modules, *, seconds=15.0, seed=0, sigma=0.002):
    """A chain of linear joints, each at the frequency of its group, that hold on to neighbours."""
    rng = np.random.default_rng(seed)
    count = len(group)
    names = [f"joint{k + 1:02d}" for k in range(count)]
    place = np.arange(count)
    body = 0.1 * np.exp(-np.abs(place[:, None] - place) + 0.5j) * (1 - np.eye(count))
    epoch_ns = EPOCH_NS + seed * 60_000_000_000
    t_s = np.arange(round(seconds * RATE))[:, None] / RATE
    command = waves * np.exp(1j * np.take(omegas, group) * t_s)
    answer = np.real(modules * (0.95 * np.exp(-0.2j) * command + command @ body))
    answer += sigma * rng.normal(size=answer.shape)
    return write_joints(path, names, np.real(command), [answer], rate_hz=RATE, epoch_ns=epoch_ns)


@pytest.fixture(scope="module")
def slither(tmp_path_factory):
    """16 joints, odd ones at 1.432 Hz, even ones at 0.954 Hz."""
    path = tmp_path_factory.mktemp("slither") / "slither.mcap"
    group = np.arange(16) % 2
    waves = 0.4 * np.exp(-0.8j * np.arange(16))
    return write(path, 2 * np.pi * np.array([1.432, 0.954]), group, waves, np.ones(16))


@pytest.mark.slow
def test_every_joint_is_compared_at_its_own_frequency(slither):
    result = analysed(slither)
    assert [len(group.joints) for group in result.gait.groups] == [8, 8]
    groups = {group.joints[0]: group for group in result.gait.groups}
    for joint, frequency in (("joint01", 1.432), ("joint02", 0.954)):
        group = groups[joint]
        assert group.frequency_hz.value == pytest.approx(frequency, rel=1e-9)
        (window,) = group.windows
        assert (window.cycles, group.wave) == (np.floor(15.0 * frequency), "head-to-tail")
        assert group.lag_per_joint_rad == {"chain": pytest.approx(-1.6)}
    assert result.gait.frequency_hz == result.gait.groups[0].frequency_hz
    for joint in result.joints:
        joint_group = result.gait.groups[joint.group]
        assert joint.name in joint_group.joints
        assert joint.frequency_hz == joint_group.frequency_hz.value
        # Its own command and, at its frequency, its group's other joints through the body.
        assert joint.gain.value == pytest.approx(0.95, abs=0.05)
        assert joint.lag_rad.value == pytest.approx(0.2, abs=0.05)
        assert joint.lag_rad.ci95[1] - joint.lag_rad.ci95[0] < np.radians(0.2)
    assert {"gain_cv_group0", "gain_cv_group1"} <= set(result.heterogeneity)
    assert "gain_cv" not in result.heterogeneity
    assert all(
        result.heterogeneity[f"{kind}_group{k}"].value is not None
        for kind in ("gain_cv", "lag_sd", "boundary_contrast_lag")
        for k in (0, 1)
    )


@pytest.mark.nightly
def test_text_json_page_and_file_carry_the_groups(slither, tmp_path, command):
    text = command("analyse", slither).out
    # 3 x 0.954 Hz - 1.432 Hz falls within 1.5/T of 1.432 Hz.
    assert all(part in text for part in ("1.432", "0.954", "(8 joints)", "falls on"))
    file = tmp_path / "result.json"
    command("analyse", slither, "-o", file)
    data = json.loads(file.read_text())
    first = data["gait"]["groups"][0]
    assert first["frequency_hz"] == data["gait"]["frequency_hz"]
    assert first["frequency_ci95"] == data["gait"]["frequency_ci95"]
    assert {joint["group"] for joint in data["joints"]} == {0, 1}
    assert load(file).gait == analysed(slither).gait
    page = tmp_path / "page.html"
    command("report", slither, "-o", page)
    assert all(part in page.read_text() for part in ("frequency [Hz]", "(8 joints)"))


def runs(folder, *, weak, apart=False):
    """A chain of 9: every other joint at 0.8 Hz, the rest at 0.5 Hz; six runs each way.

    The groups are their own mirror images. Joint 3 is weak; where ``apart``, only one group turns.
    """
    group = np.arange(9) % 2
    modules = np.ones(9, dtype=complex)
    modules[2] = weak
    omegas = 2 * np.pi * np.array([0.8, 0.5])
    paths = []
    for k in range(6):
        for way in (-1, 1):
            turns = np.where((group == 1) & apart, -1, way)
            waves = 0.4 * np.exp(0.7j * turns * np.arange(9)) * np.where(group == 1, 1j**k, 1)
            path = folder / f"{k}{'+' if way > 0 else '-'}.mcap"
            paths.append(write(path, omegas, group, waves, modules, seed=len(paths), sigma=0.003))
    return paths


@pytest.mark.nightly
def test_the_reversal_takes_all_groups_together(tmp_path):
    result = experiment(runs(tmp_path, weak=0.95 * np.exp(-0.03j)))
    assert result.reversal is not None
    assert result.reversal.p < 0.01
    assert [joint.name for joint in result.reversal.joints][:4] == [
        f"joint0{k}" for k in range(1, 5)
    ]
    assert min(result.reversal.joints, key=lambda joint: joint.p).name in ("joint03", "joint07")


@pytest.mark.nightly
def test_a_reversal_of_one_group_only_is_none(tmp_path):
    result = experiment(runs(tmp_path, weak=1.0, apart=True))
    assert result.reversal is None
    assert any("in some groups only" in text for text in result.warnings)


@pytest.mark.slow
def test_compared_at_their_own_frequencies(tmp_path, command):
    group = np.arange(8) // 4
    omegas = 2 * np.pi * np.array([0.8, 0.5])
    waves = 0.4 * np.exp(-0.8j * np.arange(8))
    weak = np.where(np.arange(8) == 6, 0.8, 1.0)
    a = write(tmp_path / "a.mcap", omegas, group, waves, np.ones(8), seed=1)
    b = write(tmp_path / "b.mcap", omegas, group, waves * np.where(group, 1j, 1), weak, seed=2)
    assert "joint07" in command("compare", a, b, "-o", tmp_path / "c.json").out
    slow = write(tmp_path / "slow.mcap", 0.99 * omegas, group, waves, weak, seed=3)
    assert "Hz" in command("compare", a, slow, code=1).err
