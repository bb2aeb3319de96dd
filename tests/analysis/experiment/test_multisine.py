"""Sessions of a multisine experiment: servos with a static nonlinearity behind a known filter."""

import numpy as np
import pytest
from scipy import signal

from support.joint_runs import EPOCH_NS, turns, write_joints
from undulog.capture import Session

pytestmark = pytest.mark.nightly

RATE_HZ = 100
NAMES = ("a", "b")
PERIOD_S = 4.0
FILTER = signal.butter(2, 4.0, fs=RATE_HZ)
BAND = ("--band", 0.25, 8.0, "--period", PERIOD_S, "--amplitude", 0.2)


def response(command, square, cube):
    """The filter's response to a polynomial of the command, by its difference equation."""
    bent = command + square * command**2 + cube * command**3
    return signal.lfilter(*FILTER, bent, axis=0)


def planned_commands(plan):
    """The commands of a plan, shape (k, joints), and its record."""
    with Session.open(plan) as session:
        signals = session.joints("/joint_commands")
        asked = np.stack([signals.signal(name).values for name in NAMES], axis=1)
        return asked, dict(session.metadata["undulog.plan"])


def drive(plans, folder, *, square=0.0, cube=0.0, mix=None, record=None):
    """Drive planned sessions.

    Args:
        record: What the sessions carry instead of their plan's record; {}: nothing.
    """
    files = []
    rng = np.random.default_rng(8)
    for k, plan in enumerate(plans):
        asked, facts = planned_commands(plan)
        y = response(asked if mix is None else asked @ mix.T, square, cube)
        y += 0.001 * rng.normal(size=y.shape)
        path = folder / f"r{len(list(folder.glob('*.mcap'))):02d}.mcap"
        facts = facts if record is None else record
        when = {"rate_hz": RATE_HZ, "epoch_ns": EPOCH_NS + k * 60_000_000_000}
        if facts:
            when |= {"metadata": {"settle_s": facts["settle_s"]}}
            when |= {"begin": lambda writer, facts=facts: writer.note("undulog.plan", facts)}
        files.append(write_joints(path, NAMES, asked, [y], verdict="good", **when))
    return files


@pytest.fixture(scope="module")
def like(tmp_path_factory):
    asked = np.real(np.array([0.2, 0.2j]) * turns(0.8, 400))
    return write_joints(tmp_path_factory.mktemp("like") / "like.mcap", NAMES, asked, [asked])


@pytest.fixture
def planned(like, tmp_path, report_of):
    def plan(*words):
        folder = tmp_path / "plan"
        return report_of("plan", "multisine", "--like", like, "-o", folder, *BAND, *words)["files"]

    return plan


def inside(joint, exact):
    ends = np.array(joint["response"]["gain_ci95"])
    return (ends[:, 0] <= np.abs(exact)) & (np.abs(exact) <= ends[:, 1])


def exact_response(joint):
    hz = np.array(joint["response"]["frequency_hz"])
    return signal.freqz(*FILTER, worN=hz, fs=RATE_HZ)[1]


def test_a_linear_servo_has_no_distortion(planned, tmp_path, report_of, command):
    files = drive(planned("--realisations", 4), tmp_path)
    result = report_of("analyse", *files)
    best = result["best_linear"]
    assert (best["realisations"], best["periods"], best["inputs"]) == (4, 2, "same")
    assert [joint["response"]["joint"] for joint in best["joints"]] == [*NAMES]
    for joint in best["joints"]:
        assert inside(joint, exact_response(joint)).mean() >= 0.8  # of 12 lines
        np.testing.assert_allclose(
            joint["response"]["gain"], np.abs(exact_response(joint)), atol=0.005
        )
        assert joint["distortion"]["ci95"][0] == 0.0
        assert joint["distortion"]["value"] < 0.01
        assert joint["odd"]["value"] < 0.01
        assert joint["even"]["value"] < 0.01
        assert joint["response"]["shares_command"] == [
            name for name in NAMES if name != joint["response"]["joint"]
        ]
    assert "no nonlinear distortion is shown" in result["answer"]
    page = tmp_path / "page.html"
    command("report", *files, "-o", page)
    assert "frequency-response" in page.read_text()
    assert "Dashed: standard deviation" in page.read_text()


@pytest.mark.parametrize("order", ["odd", "even"])
def test_odd_and_even_order_are_separated(order, planned, tmp_path, report_of):
    bent = {"cube": 2.5} if order == "odd" else {"square": 1.0}
    files = drive(planned("--realisations", 4), tmp_path, **bent)
    joint, _ = report_of("analyse", *files)["best_linear"]["joints"]
    if order == "odd":
        assert joint["odd"]["value"] > 0.02
        assert joint["even"]["value"] < 0.01
        assert joint["distortion"]["ci95"][0] > 0.01
    else:
        assert joint["even"]["value"] > 0.05
        assert joint["odd"]["value"] < 0.01
        assert joint["distortion"]["value"] < 0.01  # a square makes no odd lines of odd lines


def test_sessions_without_a_plan_are_recognised_by_their_commands(planned, tmp_path, report_of):
    files = drive(planned("--realisations", 3, "--runs", 2), tmp_path, cube=2.5, record={})
    best = report_of("analyse", *files, "--start", 4)["best_linear"]
    assert (best["realisations"], best["periods"]) == (3, 2)
    assert best["joints"][0]["distortion"]["value"] > 0.02


def test_orthogonal_commands_give_the_response_to_each_other_joint(planned, tmp_path, report_of):
    mix = np.array([[1.0, 0.3], [-0.2, 0.8]])
    files = drive(planned("--realisations", 2, "--inputs", "orthogonal"), tmp_path, mix=mix)
    best = report_of("analyse", *files)["best_linear"]
    exact = exact_response(best["joints"][0])
    for k, joint in enumerate(best["joints"]):
        np.testing.assert_allclose(joint["response"]["gain"], mix[k, k] * np.abs(exact), atol=0.01)
    cross = {(response["joint"], response["command"]): response for response in best["cross"]}
    np.testing.assert_allclose(cross["a", "b"]["gain"], 0.3 * np.abs(exact), atol=0.01)
    turned = np.exp(-1j * np.array(cross["b", "a"]["lag_rad"])) * cross["b", "a"]["gain"]
    np.testing.assert_allclose(turned, -0.2 * exact, atol=0.01)
    left = report_of("analyse", *files[:3])
    assert left["best_linear"]["realisations"] == 1
    assert any("is left out: its 1 runs" in warning for warning in left["warnings"])


@pytest.mark.parametrize(
    ("words", "what"), [(("--periods", 1), "one period"), (("--runs", 2), "one realisation")]
)
def test_one_period_or_realisation_separates_nothing(words, what, planned, tmp_path, report_of):
    count = 1 if "--runs" in words else 3
    files = drive(planned("--realisations", count, *words), tmp_path, cube=2.5)
    result = report_of("analyse", *files)
    for joint in result["best_linear"]["joints"]:
        assert joint["distortion"] == {"value": None, "ci95": None}
        assert joint["distortion_sd"] is None
    assert "not separable from noise" in result["answer"]
    assert any(warning.startswith(what) for warning in result["warnings"])


def test_a_copy_and_a_wrong_record_are_named(planned, tmp_path, report_of, command):
    plans = planned("--realisations", 2)
    files = drive(plans, tmp_path)
    copied = tmp_path / "copy.mcap"
    copied.write_bytes(files[0].read_bytes())
    result = report_of("analyse", *files, copied)
    assert result["best_linear"]["realisations"] == 2
    assert [run["role"] for run in result["runs"]] == ["multisine", "multisine", None]
    record = planned_commands(plans[0])[1]
    for field, value in (("period_s", "nan"), ("lines", "1 3 x"), ("realisation", "1e99")):
        (bad,) = drive(plans[:1], tmp_path, record={**record, field: value})
        error = command("analyse", bad, files[1], code=1).err
        assert field in error
        assert repr(value) in error
