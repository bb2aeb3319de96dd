"""Commands that depend on measured motion are named beside a frequency response."""

import numpy as np
import pytest

from support.analysed import analysed
from support.written_sessions import EPOCH_NS
from undulog.analysis.signals.stretch import Options
from undulog.capture import SessionWriter


@pytest.mark.parametrize("adaptive", [True, False])
def test_a_controller_in_the_log_is_named(tmp_path, adaptive):
    """A loop u = C (r - y), y = G u + v with much noise: its direct estimate is near -1 / C."""
    rng = np.random.default_rng(2)
    t = np.arange(4000) * 0.01
    reference, noise = rng.normal(0, 0.02, t.size), rng.normal(0, 0.2, t.size)
    position, command = np.zeros(t.size), np.zeros(t.size)
    gain, control = 0.8, 0.5
    for k in range(1, t.size):
        command[k] = control * (reference[k] - position[k - 1])
        position[k] = gain * command[k] + noise[k]
    path = tmp_path / "loop.mcap"
    names = ["horizontal.A", *(["steer.offset", "haste.factor"] if adaptive else [])]
    with SessionWriter(path, session_id="loop", epoch_ns=EPOCH_NS) as writer:
        sent = writer.joint_state("/joint_commands", ["q"], unit="rad")
        measured = writer.joint_state("/joint_states", ["q"], unit="rad")
        gait = writer.joint_state("/gait", names, unit="1")
        given = writer.joint_state("/reference", ["q"], unit="rad")
        for k in range(t.size):
            stamp = EPOCH_NS + round(t[k] * 1e9)
            sent.write(stamp, [command[k]])
            measured.write(stamp, [position[k]])
            gait.write(stamp, [0.1] * len(names))
            given.write(stamp, [reference[k]])
    result = analysed(path)
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
    gain, control, count = 0.8, 0.5, 3000
    reference, noise = rng.normal(0, 0.2, count), rng.normal(0, 0.05, count)
    asked, measured = np.zeros(count), np.zeros(count)
    for k in range(1, count):
        asked[k] = control * (reference[k] - measured[k - 1])
        measured[k] = gain * asked[k] + noise[k]
    path = tmp_path / "loop.mcap"
    topics = {"/joint_commands": asked, "/joint_states": measured, "/reference": reference}
    with SessionWriter(path, session_id="loop", epoch_ns=EPOCH_NS) as writer:
        channels = {name: writer.joint_state(name, ["q"], unit="rad") for name in topics}
        gait = writer.joint_state("/gait", ["steer.offset"], unit="1")
        for k in range(count):
            for name, values in topics.items():
                channels[name].write(EPOCH_NS + k * 10_000_000, [values[k]])
            gait.write(EPOCH_NS + k * 10_000_000, [0.1])
    result = analysed(path, Options(excitation_topic="/reference"))
    (found,) = result.frequency_response
    assert found.method == "indirect"
    low, high = np.array(found.gain_ci95).T
    assert np.mean((low <= gain) & (gain <= high)) > 0.85
    assert not [text for text in result.warnings if "biases a frequency response" in text]
    assert result.closed_loop == "an adaptive controller (steering)"
    text = command("analyse", path, "--excitation-topic", "/reference").out
    assert "broadband, indirect" in text
    assert "frequency response by the indirect method" in " ".join(text.split())
    assert "--excitation-topic /reference" in result.provenance.command
    error = command("analyse", path, "--excitation-topic", "/none", code=1).err
    assert "/none" in error
