"""Commands that depend on measured motion are named beside a frequency response."""

import numpy as np
import pytest

from support.analysed import analysed
from support.written_topics import EPOCH_NS, write_topics
from undulog.analysis.signals.stretch import Options

LOOP_GAIN, CONTROL = 0.8, 0.5


def write_loop(path, count, reference, noise, gait):
    """Write a loop u = C (r - y), y = G u + v; ``gait`` names what its controller logs."""
    command, position = np.zeros((2, count))
    for k in range(1, count):
        command[k] = CONTROL * (reference[k] - position[k - 1])
        position[k] = LOOP_GAIN * command[k] + noise[k]
    topics = {
        "/joint_commands": (["q"], "rad", command),
        "/joint_states": (["q"], "rad", position),
        "/gait": (gait, "1", np.full((count, len(gait)), 0.1)),
        "/reference": (["q"], "rad", reference),
    }
    return write_topics(path, EPOCH_NS + np.arange(count) * 10_000_000, topics)


@pytest.mark.parametrize("adaptive", [True, False])
def test_a_controller_in_the_log_is_named(tmp_path, adaptive):
    """With much noise the direct estimate of the loop is near -1 / C."""
    rng = np.random.default_rng(2)
    drawn = rng.normal(0, 0.02, 4000), rng.normal(0, 0.2, 4000)
    names = ["horizontal.A", *(["steer.offset", "haste.factor"] if adaptive else [])]
    result = analysed(write_loop(tmp_path / "loop.mcap", 4000, *drawn, names))
    assert result.frequency_response
    named = [text for text in result.warnings if "commands depend on measured motion" in text]
    if adaptive:
        assert result.closed_loop == (
            "an adaptive controller (steering, frequency by an obstacle behind it)"
        )
        assert result.to_dict()["closed_loop"] == result.closed_loop
        assert len(named) == 1
    else:
        assert result.closed_loop is None
        assert not named


def test_the_external_reference_gives_the_indirect_method(tmp_path, command):
    rng = np.random.default_rng(3)
    drawn = rng.normal(0, 0.2, 3000), rng.normal(0, 0.05, 3000)
    path = write_loop(tmp_path / "loop.mcap", 3000, *drawn, ["steer.offset"])
    result = analysed(path, Options(excitation_topic="/reference"))
    (response,) = result.frequency_response
    assert response.method == "indirect"
    low, high = np.array(response.gain_ci95).T
    assert np.mean((low <= LOOP_GAIN) & (high >= LOOP_GAIN)) > 0.85
    assert not [text for text in result.warnings if "biases a frequency response" in text]
    assert result.closed_loop == "an adaptive controller (steering)"
    text = command("analyse", path, "--excitation-topic", "/reference").out
    assert "broadband, indirect" in text
    assert "frequency response by the indirect method" in " ".join(text.split())
    assert "--excitation-topic /reference" in result.provenance.command
    error = command("analyse", path, "--excitation-topic", "/none", code=1).err
    assert "/none" in error
