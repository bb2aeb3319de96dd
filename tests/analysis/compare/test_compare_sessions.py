"""Whole sessions of known truth, written by a foreign writer: open, compare, answer."""

import json
import re
from html import unescape

import numpy as np
import pytest

from undulog.analysis import Choices, Options, compare_sessions
from undulog.analysis.signals.columns import read_columns
from undulog.capture import Session, SessionWriter
from undulog.capture.common.errors import DataError

DEGREES = np.degrees(1.0)

SIGMA, EPOCH_NS = 0.003, 1_700_000_000_000_000_000


@pytest.fixture
def write(bag, wave, epoch_ns):
    """Writes a session: 5 joints, 8 s at 0.97 Hz; all sessions have the same true response."""

    def make(name, seed, *, late_s=0.0, frequency=0.97, joints=5, first=1, change=None, energy=1.0):
        truth = wave(np.random.default_rng(11), joints=joints, frequency=frequency, duration=8.0)
        truth.names = [f"joint{first + i:02d}" for i in range(joints)]
        if change is not None:
            change(truth)
        rng = np.random.default_rng(seed)
        log = bag(f"{name}.mcap")
        for t_ns in truth.ticks_ns:
            own_ns = t_ns + round(late_s * 1e9)
            t = (own_ns - epoch_ns) * 1e-9
            q = truth.response(np.full(joints, own_ns)) + rng.normal(0, SIGMA, joints)
            size = truth.omega * truth.gain * truth.amplitude
            rate = size * np.cos(truth.omega * t + truth.phase - truth.lag)
            torque = energy * rate / size + rng.normal(0, 0.05, joints)
            log.write_both(t_ns, truth.names, truth.command(own_ns), q, rate, torque)
        log.close()
        return log.path

    return make


def weaken(truth):
    truth.gain[2] *= 0.95
    truth.lag[2] += np.radians(3.0)


def compared(a, b, **choices):
    with Session.open(a) as first, Session.open(b) as second:
        return compare_sessions(first, second, Choices(**choices))


def by_key(comparison):
    return {
        (difference.quantity, difference.place): difference for difference in comparison.differences
    }


@pytest.mark.slow
def test_the_weakened_joint_is_named_with_its_true_difference(write):
    """B starts a third of a cycle later: phases of the gait are compared, not times."""
    result = compared(write("a", 1), write("b", 2, late_s=0.34, change=weaken))
    assert result.verdict == "different"
    assert result.answer.startswith("B differs from A: joint03 most, gain −5.")
    assert [joint.name for joint in result.named] == ["joint03"]
    differences = by_key(result)
    low, high = differences["gain", "joint03"].difference.ci95
    assert low < -0.05 < high
    low, high = differences["lag", "joint03"].difference.ci95
    assert low < np.radians(3.0) < high
    assert all(
        difference.p_holm > 0.05 for key, difference in differences.items() if key[1] != "joint03"
    )
    assert result.partial is None
    assert any("one session a side" in warning for warning in result.warnings)


@pytest.mark.nightly
def test_mean_cycles_differ_as_in_closed_form(write, wave):
    result = compared(write("a", 3), write("b", 4, late_s=0.2, change=weaken))
    before, after = (wave(np.random.default_rng(11), joints=5) for _ in range(2))
    weaken(after)
    phase = np.array(result.phase_rad)
    for k, waveform in enumerate(result.waveforms):
        # Phase 0 is the crest of joint01's command, a sine.
        turn = phase + np.pi / 2 + before.phase[k] - before.phase[0]
        a, b = (w.gain[k] * w.amplitude[k] * np.sin(turn - w.lag[k]) for w in (before, after))
        off = np.abs(np.array(waveform.difference_rad) - (b - a))
        assert np.mean(off <= np.array(waveform.half_rad)) > 0.9
        np.testing.assert_allclose(waveform.a_rad, a + 0.04, atol=5 * SIGMA / np.sqrt(7))
    assert max(result.waveforms, key=lambda waveform: waveform.rms_rad).name == "joint03"


@pytest.mark.slow
def test_two_runs_of_one_truth_are_equivalent(write):
    result = compared(write("a", 5), write("b", 6, late_s=0.5))
    alike = "no difference found; gain and lag of all 5 joints are equivalent within 2 % and 1°"
    assert (result.verdict, result.answer, result.named) == ("same", alike, ())


@pytest.mark.slow
def test_a_session_is_the_same_as_itself(write):
    path = write("a", 7)
    result = compared(path, path)
    assert result.verdict == "same"
    assert all(
        difference.difference.value == 0 and difference.p == 1 for difference in result.differences
    )
    assert any("the same content" in warning for warning in result.warnings)


@pytest.mark.slow
def test_with_much_noise_the_question_stays_open(write):
    result = compared(write("a", 8), write("b", 9), session=Options(start_s=0.0, stop_s=3.3))
    assert result.verdict in ("same", "open")
    wide = max(
        difference.difference.ci95[1]
        for difference in result.differences
        if difference.quantity == "gain"
    )
    if result.verdict == "open":
        assert "could hide in the noise" in result.answer
        assert wide > 0.0


@pytest.mark.slow
def test_energy_alone_may_differ(write):
    result = compared(write("a", 10), write("b", 11, energy=1.2))
    assert result.verdict == "small"
    assert "are equivalent within 2 % and 1°; beyond doubt" in result.answer
    energies = [
        difference for difference in result.differences if difference.quantity == "energy_abs"
    ]
    ratios = [energy.difference.value / energy.a for energy in energies]
    # E_abs of noisy torque is not quite proportional to it.
    assert ratios == pytest.approx([0.2] * 5, abs=0.01)


@pytest.mark.nightly
def test_another_gait_is_refused_or_labelled(write):
    a, b = write("a", 12), write("b", 13, frequency=1.1)
    with pytest.raises(DataError, match=r"the gaits differ, .* b.mcap has 1.1 Hz, a.mcap 0.97 Hz"):
        compared(a, b)
    result = compared(a, b, any_gait=True)
    assert result.partial == "the gaits differ: b.mcap has 1.1 Hz, a.mcap 0.97 Hz"
    assert result.answer.endswith("(partial comparison)")


@pytest.mark.nightly
def test_another_amplitude_of_one_joint_is_another_gait(write):
    def louder(truth):
        truth.amplitude[3] *= 1.05

    with pytest.raises(DataError, match=r"at joint04 the command of b.mcap is 5.0 % in amplitude"):
        compared(write("a", 14), write("b", 15, change=louder))


@pytest.mark.nightly
def test_other_joints_are_left_out_or_refused(write):
    a = write("a", 16)
    result = compared(a, write("b", 17, joints=4))
    assert result.partial == "only 4 joints can be compared (joint05: no gain and lag in b.mcap)"
    with pytest.raises(DataError, match=r"a.mcap drives joint01, .*, c.mcap joint11"):
        compared(a, write("c", 18, first=11))


@pytest.mark.nightly
def test_the_page_ranks_what_differs_and_holds_every_number(write, tmp_path, command):
    page = tmp_path / "page.html"
    files = [str(write("a", 1)), str(write("b", 2, change=weaken))]
    assert command("compare", *files, "-o", page).out.rstrip().endswith(f"Result: {page}")
    html = page.read_text()
    result = compared(*files)
    heading = re.sub("<[^>]+>", "", re.search(r"<h1.*?</h1>", html, re.DOTALL)[0])
    assert unescape(heading).replace("\N{NO-BREAK SPACE}", " ") == f"{result.answer}."
    named = re.search(r'<table class="named">.*?</table>', html, re.DOTALL)[0]
    assert re.findall(r"</span>(joint\d+)</th>", named) == [joint.name for joint in result.named]
    assert result.named[0].name == "joint03"
    every = re.search(r'<table class="quantities">.*?</table>', html, re.DOTALL)[0]
    assert every.count("<tr") == 1 + len(result.differences)
    shown = {float(v) for v in re.findall(r'<data value="([^"]+)"', every)}
    for difference in result.differences:
        factor = {"gain": 100.0, "lag": DEGREES, "offset": DEGREES}.get(
            difference.quantity, 100.0 / difference.a
        )
        for value in (difference.difference.value, *difference.difference.ci95):
            assert any(np.isclose(value * factor, other) for other in shown)
    assert "://" not in html.replace(str(tmp_path), "")
    assert "Mean cycles by gait phase" in html


@pytest.mark.slow
def test_a_page_is_not_replaced_unasked(write, tmp_path, command):
    page = tmp_path / "page.html"
    page.write_text("mine")
    command("compare", write("a", 1), write("b", 2), "-o", page, code=2)
    assert page.read_text() == "mine"


@pytest.mark.nightly
def test_groups_by_the_command_line(write, tmp_path, command, report_of):
    a = [write(f"a{k}", 20 + k, late_s=0.1 * k) for k in range(4)]
    b = [write(f"b{k}", 30 + k, late_s=0.3 * k, change=weaken) for k in range(4)]
    out = tmp_path / "result.json"
    message = command("compare", "--a", *a, "--b", *b, "-o", out).out
    assert message.startswith("B differs from A: joint03 most")
    assert "What was changed" in message
    assert message.rstrip().endswith(f"Result: {out}")
    assert json.loads(out.read_text())["design"] == "groups"
    result = report_of("compare", "--a", *a, "--b", *b, "--paired")
    assert (result["design"], result["named"][0]["name"]) == ("pairs", "joint03")
    assert " --paired" in result["provenance"]["command"]
    err = command("compare", "--a", a[0], a[0], "--b", *b, code=1).err
    assert "a copy is not a run of its own" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "compare needs sessions on both sides"),
        (["x.mcap"], "here are 1"),
        (["x.mcap", "y.mcap", "--a", "z.mcap"], "not both"),
        (["x.mcap", "y.mcap", "-o", "z.txt"], "in .html for a page, in .json for numbers"),
        (["x.mcap", "y.mcap", "--margin-gain", "2"], "--margin-gain lies between"),
    ],
)
def test_wrong_usage_exits_2(words, message, command):
    assert message in command("compare", *words, code=2).err


@pytest.fixture
def sparse(tmp_path):
    """Writes three joints at 1 Hz, sampled 4.8 times a cycle; the third has its own gain."""

    def make(name, gain, *, largest=0.0):
        path, names = tmp_path / f"{name}.mcap", ["a", "b", "c"]
        rng = np.random.default_rng(len(name))
        with SessionWriter(path, session_id=name, epoch_ns=EPOCH_NS) as writer:
            commands = writer.joint_state("/joint_commands", names, unit="rad")
            states = writer.joint_state("/joint_states", names, unit="rad")
            for k in range(300):
                t_ns = k * 210_000_000
                phase = 2 * np.pi * t_ns * 1e-9 + np.arange(3)
                command = 0.4 * np.sin(phase)
                if k in (100, 101):
                    command[0] += largest * (-1) ** k
                commands.write(EPOCH_NS + t_ns, command)
                answer = np.array([0.95, 0.95, gain]) * 0.4 * np.sin(phase - 0.2)
                states.write(EPOCH_NS + t_ns, answer + rng.normal(0, 1e-3, 3))
        return path

    return make


@pytest.mark.slow
def test_cycles_of_few_samples_are_compared_by_the_whole(sparse):
    result = compared(sparse("first", 0.95), sparse("other", 0.8))
    assert result.verdict == "different"
    assert result.answer.startswith("B differs from A: c most, gain −15.")  # 0.8 of 0.95


@pytest.mark.slow
def test_values_beyond_any_unit_are_left_out(sparse):
    with Session.open(sparse("huge", 0.95, largest=1.7e308)) as session:
        columns = read_columns(session, "/joint_commands", "/joint_states", print)
    assert columns.commanded() == ("a", "b", "c")
