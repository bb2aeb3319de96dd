"""Saved results as a layer: whose they are, what they name, and where that is marked."""

import dataclasses

import numpy as np
import pytest

from undulog.analysis.common.estimate import Estimate, Provenance
from undulog.analysis.results.comparison import (
    Comparison,
    ModelledAnalysis,
    ModuleDeviation,
    NamedJoint,
    NullModelResult,
)
from undulog.analysis.results.coupling import Coupling
from undulog.analysis.results.experiment import (
    Experiment,
    FloorTilt,
    Headings,
    OrderedPair,
    Reversal,
    Run,
)
from undulog.capture.common.errors import DataError
from undulog.capture.robot.kinematics import link_poses
from undulog.replay.numbers import saved

PINK = 0xFF5FBEFF
NO_COUPLING = Coupling(identifiable=False, why="one gait")
MADE = Provenance("", {}, {}, {})


@pytest.fixture
def session(session_file, opened):
    return opened(session_file)


def names_and_reasons(layer):
    return [(named_joint.joint, named_joint.why) for named_joint in layer.named]


@pytest.fixture
def comparison(analysis):
    """A comparison of the session with another one that names two joints, one beyond margins."""
    other = dataclasses.replace(analysis.session, id="another")
    named = (NamedJoint("joint05", 2.1, 0.0004), NamedJoint("joint07", 0.6, 0.01))
    sides = {"a": (other,), "b": (analysis.session,), "partial": None, "named": named}
    empty = ("changed", "differences", "equivalence", "phase_rad", "waveforms", "warnings")
    answer = ("B differs from A", "different", "sessions")
    return Comparison(*answer, **sides, **dict.fromkeys(empty, ()), provenance=MADE)


@pytest.fixture
def experiment(analysis):
    """An experiment of the session and its reverse, that names the joint it finds weak."""
    pair = OrderedPair("joint03", "joint23", "lag", Estimate(-0.01), Estimate(0.03), 0.002)
    nothing = Estimate()
    test = {"statistic": 9.0, "p": 0.002, "p_floor": 0.001}
    counts = {"forward_runs": 6, "reverse_runs": 6, "labellings": 924, "labellings_tried": 924}
    bounds = {"gain_bound": 0.1, "lag_bound_rad": 0.1}
    bounds |= {"equivalence_gain_p": 1.0, "equivalence_lag_p": 1.0, "noise_variance": 0.0}
    shares = ("module_variance", "boundary_variance", "module_share", "boundary_share")
    tilt = FloorTilt(Headings.BALANCED, 2, nothing, None, nothing, excluded=True)
    parts = test | counts | bounds | dict.fromkeys(shares, nothing)
    reversal = Reversal(**parts, joints=(), pairs=(pair,), tilt=tilt)
    reverse = dataclasses.replace(
        analysis, session=dataclasses.replace(analysis.session, id="reverse")
    )
    runs = (
        Run("reverse", "reverse.mcap", "tail-to-head", "reverse"),
        Run("made-for-tests", "made.mcap", "head-to-tail", "forward"),
    )
    sides = {"answer": "joint03 is weak", "sessions": (reverse, analysis), "runs": runs}
    differences = {"heterogeneity": {}, "reversal": reversal, "coupling": NO_COUPLING}
    return Experiment(**sides, **differences, warnings=(), provenance=MADE)


def test_the_numbers_shown_are_the_saved_ones(session, analysis, tmp_path):
    layer = saved(session, [analysis.save(tmp_path / "made.json")])
    assert (layer.analysis, layer.named) == (analysis, ())
    assert layer.notes == ("gain, lag and energy are those of made.json",)


def test_an_experiment_gives_the_sessions_own_numbers_and_its_weak_module(
    session, analysis, experiment, tmp_path
):
    layer = saved(session, [experiment.save(tmp_path / "both.json")])
    assert layer.analysis == analysis
    why = "more lag than its mirror joint joint23, p = 0.002 (both.json)"
    assert names_and_reasons(layer) == [("joint03", why)]


@pytest.fixture
def results(analysis, comparison, tmp_path):
    """Files of the session's analysis and of the comparison."""
    return [analysis.save(tmp_path / "made.json"), comparison.save(tmp_path / "two.json")]


def test_a_comparison_names_what_differs_by_more_than_its_margins(session, analysis, results):
    layer = saved(session, results)
    assert layer.analysis == analysis
    why = "answers differently in A and B, p < 0.001 (two.json)"
    assert names_and_reasons(layer) == [("joint05", why)]


def test_a_session_held_to_a_model_names_the_module_that_deviates(session, analysis, tmp_path):
    modules = (
        ModuleDeviation("joint07", named=False, gain=1.0, p=0.6, relative={}),
        ModuleDeviation("joint09", named=True, gain=40.0, p=0.0002, relative={}),
    )
    test = NullModelResult(
        answer="joint09 deviates",
        condition="conditional on the model",
        file="null.json",
        made_by="twin",
        parameters=(),
        fit=1.0,
        fit_p=0.5,
        p=0.0002,
        modules=modules,
        named=("joint09",),
        rest_p=0.4,
        draws=200,
    )
    values = {field.name: getattr(analysis, field.name) for field in dataclasses.fields(analysis)}
    modelled = ModelledAnalysis(**values, null_model=test)
    layer = saved(session, [modelled.save(tmp_path / "held.json")])
    assert layer.analysis == modelled
    why = "deviates from the others' model, p < 0.001 (held.json)"
    assert names_and_reasons(layer) == [("joint09", why)]


@pytest.mark.slow
def test_with_a_comparison_alone_the_session_is_analysed(session, comparison, tmp_path):
    layer = saved(session, [comparison.save(tmp_path / "two.json")])
    assert layer.analysis is not None
    assert layer.analysis.session.id == "made-for-tests"
    assert [named_joint.joint for named_joint in layer.named] == ["joint05"]


def test_results_that_do_not_fit_the_session_are_refused(session, analysis, experiment, tmp_path):
    other = dataclasses.replace(analysis.session, id="another")
    path = dataclasses.replace(analysis, session=other).save(tmp_path / "other.json")
    with pytest.raises(DataError, match=r"other\.json: a result of session another; the session"):
        saved(session, [path])
    paths = [analysis.save(tmp_path / "a.json"), experiment.save(tmp_path / "b.json")]
    with pytest.raises(DataError, match=r"b\.json: the second result with numbers"):
        saved(session, paths)
    path = NO_COUPLING.save(tmp_path / "coupling.json")
    with pytest.raises(DataError, match=r"a Coupling names no session"):
        saved(session, [path])


@pytest.fixture
def marked(session_file, results, tmp_path, read_back, command):
    """The session's recording with a comparison that names joint 5."""
    words = [word for path in results for word in ("--result", path)]
    command("view", session_file, *words, "--save", tmp_path / "a.rrd")
    return read_back(tmp_path / "a.rrd")


@pytest.mark.slow
def test_named_modules_are_marked_on_the_body(marked, recording, snake25, truth):
    assert not any("named" in path for path in recording[1].entities)  # without results
    assert marked.column("/world/snake/named", "Points3D:labels")[0] == ["joint05"]
    assert marked.static("/world/snake/named", "Points3D:colors") == [PINK]
    # Above the axis of joint 5, between links 5 and 6.
    at = np.array(marked.column("/world/snake/named", "Points3D:positions")[0][0])
    centre, rotation = link_poses(snake25, truth.head[0], np.eye(3), truth.position[0])
    axis = centre[4] - 0.5 * snake25.links[4].length * rotation[4, :, 0]
    np.testing.assert_allclose(at[:2], axis[:2], atol=1e-6)
    assert at[2] > axis[2]


def test_named_modules_are_marked_at_their_bars_and_in_words(marked):
    (left,) = marked.static("/segments/lag_degrees/named", "BarChart:abscissa")
    assert 4.4 < left["buffer"][0] < 4.6
    words = marked.static("/session", "TextDocument:text")[0]
    assert "**Named, pink in the pictures:** joint05 (answers differently" in words
    assert "- gain, lag and energy are those of made.json" in words


def test_results_and_tabs_are_of_one_session(session_file, tmp_path, command):
    missing, output = tmp_path / "nowhere.json", tmp_path / "a.rrd"
    for words in (["--result", missing], ["--tab", "cycles"]):
        err = command("view", session_file, session_file, *words, code=2).err
        assert f"{words[0]}: needs one session" in err
    words = ("view", session_file, "--result", missing, "--save", output)
    assert "nowhere.json" in command(*words, code=1).err
    assert not output.exists()
