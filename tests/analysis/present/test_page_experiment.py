"""The page of an experiment: answer first, numbers those of the result, every one in reach."""

import dataclasses
import math
import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.common.formats import sentence
from undulog.analysis.parts.artefacts.result import Artefact
from undulog.analysis.present import page_tables as typeset
from undulog.analysis.present.experiment_view import profiles
from undulog.analysis.present.matrix import Entries, entries_of, matrix_picture
from undulog.analysis.present.page import render
from undulog.analysis.present.page_tables import experiment_trials, session_trials
from undulog.analysis.present.session_view import artefact_rows, times_text
from undulog.analysis.results.body_connection import BodyConnection, PredictedTravel

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def pages(both_ways, kicked, swept):
    return {"both_ways": render(both_ways), "kicked": render(kicked), "swept": render(swept)}


def rows(page, table):
    """Numbers in the cells of a table's body, row by row."""
    match = re.search(rf'<table class="{table}">.*?<tbody>(.*?)</tbody>', page, re.DOTALL)
    return [
        [[float(v) for v in re.findall(r'<data value="([^"]+)"', cell)] for cell in cells]
        for cells in (
            re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, re.DOTALL)
            for row in re.findall(r"<tr>(.*?)</tr>", match[1], re.DOTALL)
        )
    ]


@pytest.mark.parametrize("name", ["both_ways", "kicked", "swept"])
def test_the_answer_is_the_first_heading(pages, name, request):
    heading = re.search(r"<h1[^>]*>(.*?)</h1>", pages[name], re.DOTALL)[1]
    text = re.sub(r"<[^>]+>", "", heading)
    assert text.replace("\N{NO-BREAK SPACE}", " ").replace("⁻¹", "^-1") == sentence(
        request.getfixturevalue(name).answer
    )


def test_mirror_pairs_are_those_of_the_result(pages, both_ways):
    shown = rows(pages["both_ways"], "mirrors")
    assert len(shown) == 5
    for joint, row in zip(both_ways.reversal.joints, shown, strict=True):
        gain, lag = joint.log_gain_difference, joint.lag_difference_rad
        percent = [100 * math.expm1(v) for v in (gain.value, *gain.ci95)]
        degrees = [math.degrees(v) for v in (lag.value, *lag.ci95)]
        assert (row[2], row[3]) == (pytest.approx(percent), pytest.approx(degrees))
        assert row[4] == [joint.p]


def test_profiles_are_the_runs_and_mirrored(both_ways):
    seen = profiles(both_ways, both_ways.reversal)
    assert seen.gain.shape == seen.mirrored_lag_deg.shape == (6, 5)
    roles = [run.role for run in both_ways.runs]
    reverse = both_ways.sessions[roles.index("reverse")]
    gains = [joint.gain.value for joint in reverse.joints]
    np.testing.assert_array_equal(seen.mirrored_gain[0], gains[::-1])
    # What the figure shows is what was tested: d = ln of the ratio of geometric means.
    difference = np.log(seen.gain).mean(0) - np.log(seen.mirrored_gain).mean(0)
    tested = [joint.log_gain_difference.value for joint in both_ways.reversal.joints]
    np.testing.assert_allclose(difference, tested, atol=1e-9)


def test_matrices_and_row_sums_are_those_of_the_result(pages, kicked):
    coupling = kicked.coupling
    shown = rows(pages["kicked"], "coupling")
    assert [[cell[0] for cell in row[1:]] for row in shown] == list(map(list, coupling.P.value))
    sums = rows(pages["kicked"], "rows")
    assert [row[1][0] for row in sums] == [
        phase_row.total.value for phase_row in coupling.phase_rows
    ]
    held = rows(pages["kicked"], "heldout")
    assert [row[2][0] for row in held] == [100 * pattern.error for pattern in coupling.held_out]


def test_a_sweep_is_shown_tone_by_tone(pages, swept):
    (tone,) = swept.coupling.tones
    (row,) = rows(pages["swept"], "tones")
    assert row[0] == [tone.frequency_hz]
    shares = [tone.asymmetry, tone.within_1, tone.within_2, tone.within_3]
    assert [cells[0] for cells in row[1:5]] == [100 * share.value for share in shares]
    shown = rows(pages["swept"], "coupling")
    assert [[cell[0] for cell in cells[1:]] for cells in shown] == [list(r) for r in tone.H.real]
    assert "Identified by 5 runs of a lag-sweep: H = Y C⁻¹" in pages["swept"]
    assert "Is every run settled?" in pages["swept"]


def test_both_parts_of_a_complex_matrix_have_the_same_colours(swept):
    real, imag = entries_of(swept.coupling, ())
    beside = ~np.eye(5, dtype=bool)
    largest = max(np.abs(real.value[beside]).max(), np.abs(imag.value[beside]).max())
    assert real.limit == imag.limit == largest


def test_every_matrix_has_a_picture_and_a_table(pages):
    page = pages["kicked"]
    for symbol in "PRGS":
        assert re.search(rf'<title id="matrix-\d-title">{symbol}: ', page)
        assert f"<summary>{symbol} in numbers</summary>" in page
    # Not asked of kicks, and not claimed to be untested either.
    assert "the wave and its reverse" not in page


def test_tests_answer_in_words(both_ways, kicked, snake):
    trials = {
        experiment_trial.question: experiment_trial
        for experiment_trial in experiment_trials(both_ways)
    }
    mirror = trials["Do the modules mirror, as identical ones do? (H1, reversal)"]
    assert (mirror.p, mirror.verdict) == (both_ways.reversal.p, "no, modules differ")
    verdicts = [experiment_trial.verdict for experiment_trial in experiment_trials(kicked)]
    assert verdicts[:2] == ["as any settled gait's do"] * 2
    assert verdicts[2] == "a deviation could not be shown"
    assert verdicts[3].startswith("yes, up to 0.")
    (contrast,) = session_trials(snake.heterogeneity)
    assert contrast.verdict == "yes, lag is larger in the middle"


def test_what_was_not_recorded_is_named(both_ways):
    page = render(dataclasses.replace(both_ways, reversal=None, warnings=("record the reverse",)))
    assert "Boundary or module: not tested." in page
    assert "Record the reverse." in page
    assert "Coupling: not identifiable from these sessions." in page


def test_a_page_that_grows_too_large_goes_without_every_run(both_ways, pages, monkeypatch):
    largest = len(pages["both_ways"].encode()) - 1
    monkeypatch.setattr("undulog.analysis.present.page.LARGEST_BYTES", largest)
    assert "Gain and lag of every run are left out" in render(both_ways)


@pytest.mark.parametrize("m", [3, 13, 25])
def test_signs_and_numbers_of_a_picture(m):
    names = tuple(f"<j{k}>" for k in range(m))
    value = np.diag(np.full(m, 0.9))
    value[0, 1], value[1, 0] = -0.25, 0.125
    entries = Entries("P", "meaning", names, names, value, np.full((m, m), 0.004))
    root = ET.fromstring(matrix_picture(entries, "x").svg)
    places = [g for g in root.iter("g") if g.get("class") == "row"]
    assert all(row.get("tabindex") == "0" for row in places)
    assert "<j1> \N{MINUS SIGN}0.2500 \N{PLUS-MINUS SIGN} 0.0040" in places[0].get("aria-label")
    cells = [rect for rect in places[0].iter("rect") if rect.get("style")]
    # The diagonal is beyond the colours, whose ends are the largest entry beside it.
    assert [c.get("style") for c in cells[:3]] == ["--v:100%", "--v:100%", "--v:0%"]
    assert [c.get("class") for c in cells[:2]] == ["plus own", "minus"]
    assert len(list(places[0].iter("line"))) == 1  # the stroke that says minus
    assert len(list(root.iter("title"))) == m * m + 1


@pytest.mark.parametrize(
    ("text", "set_as"),
    [
        ("no joint is driven.", "No joint is driven."),
        ("run.mcap commands another gait", "run.mcap commands another gait."),
        ("joint03 is 4 % off: X = H^-1", "joint03 is 4\N{NO-BREAK SPACE}% off: X = H⁻¹."),
        ("at 0.5 Hz in 3 runs", "At 0.5\N{NO-BREAK SPACE}Hz in 3 runs."),
        ("3 joints of 5", "3 joints of 5."),
    ],
)
def test_sentences_on_the_page(text, set_as):
    assert typeset.sentence(text) == set_as


def test_times_of_artefacts():
    assert times_text(()) == "throughout"
    assert times_text(((2.0, 3.5), (7.1, 7.1))) == "2.00 to 3.50 s, 7.10 s"
    many = tuple((float(k), k + 0.5) for k in range(6))
    assert times_text(many).endswith("3.00 to 3.50 s and 2 more, 3.00 s in all")


def test_artefacts_are_shown_with_their_times_once_for_all_joints(snake):
    where = ("/joint_states", "position")
    gaps = [Artefact(joint.name, *where, "gaps", ((9.0, 9.5),)) for joint in snake.joints]
    frozen = Artefact("joint07", *where, "frozen", ((10.0, 12.0),), "stuck")
    flagged = dataclasses.replace(snake, artefacts=(*gaps, frozen))
    first, second = artefact_rows(flagged)
    assert (first.joints, first.flag, first.times) == ("joint07", "frozen", "10.00 to 12.00 s")
    assert first.meaning.endswith("commanded to move; stuck")
    assert (second.joints, second.about) == ("all 25 joints", "the record, not mechanics")
    # Ten of sixteen seconds into the session, two long.
    assert 'd="M62.50 0h12.50v10h-12.50z"' in str(first.line)
    assert render(flagged).count("10.00 to 12.00 s") == 1


def test_the_travel_of_perturbed_gaits_is_drawn_and_every_number_is_in_the_table(both_ways):
    def travel(path, forward, why=None):
        near = [Estimate(v, (v - 0.001, v + 0.002)) for v in (forward, 0.002, 0.05)]
        measured = [Estimate(v) for v in (0.5, 0.001, 0.04)]
        predicted = [Estimate()] * 3 if why else near
        return PredictedTravel(path, 0.5, *predicted, *measured, why=why)

    body = BodyConnection(
        True,
        "8 gaits around one gait",
        8,
        12.0,
        predicted=(travel("a.mcap", 0.498), travel("b.mcap", 0.5, "it is far away")),
    )
    apart = dataclasses.replace(both_ways, reversal=None, body_connection=body)
    page = render(apart)
    assert "How do changes of shape move the body?" in page
    (first, second) = rows(page, "travels")
    assert first[1] == pytest.approx([498.0, 497.0, 500.0])
    assert first[2] == [500.0]
    assert second[1] == []
    tip = "a.mcap: forward predicted 498.0 mm [497.0, 500.0], measured 500.0 mm"
    assert page.count(tip) == 1
    assert "b.mcap: forward" not in page
    none = dataclasses.replace(body, predicted=body.predicted[1:])
    assert "travel-figure" not in render(dataclasses.replace(apart, body_connection=none))
