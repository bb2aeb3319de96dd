"""Sessions whose commands are no gait: who follows otherwise, in every output."""

import re

import numpy as np
import pytest

from support.analysed import analysed
from support.written_topics import EPOCH_NS, write_topics
from undulog.analysis import load

NAMES = [f"j{k}" for k in range(6)]
DEGREE = np.pi / 180


def write(path, *, gain=0.97, lag_s=0.08, offset=0.0, seed=0, joint=2):
    """Write a session of six joints that each have a multisine of their own; one may differ."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 40.0, 0.02)
    tones = 0.1 * np.array([1, 2, 3, 5, 7, 11])
    phases = rng.uniform(0, 2 * np.pi, (tones.size, 6))
    gains = 0.97 + 0.005 * rng.standard_normal(6)
    lags_s = 0.08 + 0.002 * rng.standard_normal(6)
    offsets = 0.1 * DEGREE * rng.standard_normal(6)
    gains[joint], lags_s[joint] = gain, lag_s
    offsets[joint] += offset

    def command(t_s):
        return sum(
            0.12 * np.sin(2 * np.pi * tone * t_s + phase)
            for tone, phase in zip(tones, phases, strict=True)
        )

    asked = command(t[:, None])
    given = (
        gains * command(t[:, None] - lags_s) + offsets + 0.003 * rng.standard_normal(asked.shape)
    )
    topics = {"/joint_commands": (NAMES, "rad", asked), "/joint_states": (NAMES, "rad", given)}
    return write_topics(path, EPOCH_NS + np.rint(t * 1e9).astype(np.int64), topics)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gain": 0.75}, "gain 2"),
        ({"lag_s": 0.18}, "lag "),
        ({"offset": 2.5 * DEGREE}, "its mean "),
    ],
)
def test_the_joint_that_differs_is_named(tmp_path, change, words):
    answer = analysed(write(tmp_path / "a.mcap", **change)).answer
    assert answer.sentence.startswith("j2 "), answer.sentence
    assert words in answer.sentence
    assert {difference.joint for difference in (*answer.stand_out, *answer.apart)} == {"j2"}
    assert not answer.not_following


@pytest.mark.parametrize("seed", range(4))
def test_joints_that_follow_alike_are_not_named(tmp_path, seed):
    answer = analysed(write(tmp_path / "a.mcap", seed=seed)).answer
    assert not answer.stand_out
    assert answer.sentence.startswith("No gait: the commands are of the kind")
    assert "lag 7" in answer.sentence or "lag 8" in answer.sentence


def test_every_output_has_gain_lag_and_offset(tmp_path, command):
    path = write(tmp_path / "a.mcap", gain=0.8)
    result = analysed(path)
    (weak,) = [joint for joint in result.tracking if joint.joint == "j2"]
    assert weak.gain.ci95[0] <= 0.8 <= weak.gain.ci95[1]
    assert weak.lag_s.value == pytest.approx(0.08, abs=2e-3)
    assert weak.explained > 0.99
    assert load(result.save(tmp_path / "a.json")) == result
    record = next(row for row in result.to_dict()["tracking"] if row["joint"] == "j2")
    assert record["gain"] == weak.gain.value
    assert tuple(record["gain_ci95"]) == weak.gain.ci95
    frame = result.frames()["tracking"].set_index("joint")
    assert frame.loc["j2", "lag_s"] == weak.lag_s.value
    assert {"gain_low", "lag_high_s", "offset_low_rad"} <= set(frame)
    text = command("analyse", path).out
    assert "lag ms (95 %)" in text
    page = tmp_path / "a.html"
    command("report", path, "-o", page)
    shown = page.read_text()
    assert "How each joint follows" in shown
    figure = shown[shown.index('id="segments-figure-title"') :]
    figure = figure[: figure.index("</svg>")]
    assert "6 of 6 joints have a gain, 0.8" in figure  # with their intervals, in one figure
    assert "lag [ms]" in figure
    assert "no gain" not in figure
    for number, joint in enumerate(result.tracking):
        drawn = [float(text) for text in re.findall(rf"j{number}: gain ([0-9.]+)", figure)]
        assert drawn == [pytest.approx(joint.gain.value, abs=1e-3)]
        drawn = [float(text) for text in re.findall(rf"j{number}: lag ([0-9.]+)", figure)]
        assert drawn == [pytest.approx(1e3 * joint.lag_s.value, abs=0.1)]
