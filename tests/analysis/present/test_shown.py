"""Results in a notebook: text, tables, pictures, files and back, of every kind of result."""

import dataclasses
import json
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest

from undulog.analysis import Choices, Estimate, Experiment, compare_sessions, load
from undulog.analysis.parts.artefacts.result import Artefact
from undulog.analysis.parts.oscillators.result import ChainCoupling, OscillatorLink, Rate
from undulog.analysis.results.coupling import Route
from undulog.capture import Session
from undulog.capture.common.errors import DataError, InputFileError, OutputExistsError, UsageError

pytestmark = pytest.mark.nightly

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def comparison(both_ways_files):
    """The wave one way against the other way, which is another gait."""
    with Session.open(both_ways_files[0]) as a, Session.open(both_ways_files[1]) as b:
        return compare_sessions(a, b, Choices(any_gait=True))


@pytest.fixture(scope="module")
def sweep(swept):
    """A lag sweep of two tones, with torques."""
    tone = swept.coupling.tones[0]
    tone = dataclasses.replace(tone, route=Route.TORQUE, Z=tone.H, inverted_condition=1.3)
    share = Estimate(0.5, (0.4, 0.6))
    return dataclasses.replace(swept.coupling, tones=(tone, tone), sideband_energy=share)


@pytest.fixture(scope="module")
def results(request):
    """By name: what a fixture gives, or a part of it."""
    parts = {
        "reversal": ("both_ways", "reversal"),
        "local coupling": ("kicked", "coupling"),
        "coupling": ("snake", "coupling"),
    }
    by_name = {}
    for name in NAMES:
        fixture, part = parts.get(name, (name.replace(" ", "_"), None))
        whole = request.getfixturevalue(fixture)
        by_name[name] = whole if part is None else getattr(whole, part)
    return by_name


NAMES = ("snake", "still", "single", "hostile", "both ways", "kicked", "reversal")
NAMES += ("local coupling", "coupling", "sweep", "comparison")


@pytest.mark.parametrize("name", NAMES)
def test_what_was_saved_is_read_back_equal(results, name, tmp_path):
    result = results[name]
    path = result.save(tmp_path / "result.json")
    back = load(path)
    assert type(back) is type(result)
    assert back == result
    assert json.loads(path.read_text()) == json.loads(json.dumps(result.to_dict()))
    with pytest.raises(OutputExistsError):
        result.save(path)
    assert load(back.save(path, force=True)) == result


@pytest.mark.parametrize("name", NAMES)
def test_tables_survive_parquet(results, name, tmp_path):
    result = results[name]
    frames = result.frames()
    paths = result.to_parquet(tmp_path / "tables")
    assert [path.stem for path in paths] == list(frames)
    for path in paths:
        pd.testing.assert_frame_equal(pd.read_parquet(path), frames[path.stem])


@pytest.mark.parametrize("name", NAMES)
def test_a_result_prints_its_answer_first_and_on_one_line(results, name):
    result = results[name]
    first = str(result).splitlines()[0]
    assert repr(result) == f"<{type(result).__name__}: {first}>"
    assert not str(result).endswith("\n")
    html = result._repr_html_()
    assert "<script" not in html
    assert html.startswith("<p><strong>")
    ET.fromstring(f"<div>{html}</div>".replace("&nbsp;", " "))


def test_columns_carry_their_units_and_the_numbers_of_the_result(snake):
    frame = snake.frames()["joints"]
    assert {"gain", "gain_low", "gain_high", "lag_rad", "lag_low_rad", "lag_high_rad"} <= set(frame)
    assert {"energy_abs_j", "command_amplitude_rad"} <= set(frame)
    for joint, row in zip(snake.joints, frame.itertuples(), strict=True):
        assert row.name == joint.name
        if joint.lag_rad.value is None:
            assert np.isnan([row.lag_rad, row.lag_low_rad]).all()
        else:
            assert (row.lag_low_rad, row.lag_high_rad) == joint.lag_rad.ci95
    indices = snake.frames()["heterogeneity"].set_index("name")
    assert indices.loc["gain_cv", "low"] == snake.heterogeneity["gain_cv"].ci95[0]
    body = snake.frames()["body"]
    assert body.amplitude_m.max() == pytest.approx(0.055)
    assert set(body.model) == {"measured", "viscous"}


def test_artefacts_are_one_row_a_stretch_and_oscillators_one_row_a_link(snake, kicked):
    artefacts = (
        Artefact("joint01", "/joint_states", "position", "gaps", ((1.0, 1.5), (3.0, 3.2))),
        Artefact("joint02", "/joint_states", "effort", "wrong_sign", ()),
    )
    link = OscillatorLink("a", "b", Estimate(2.0, (1.9, 2.1)), Estimate(0.5, (0.4, 0.6)))
    rate = Rate("a", Estimate(3.1, (3.0, 3.2)), Estimate(), 1e-3)
    facts = ("vertical", True, "kicked", None, 40.0, 11, 60.0, 1)
    chain = ChainCoupling(*facts, links=(link,), oscillators=(rate,))
    frames = dataclasses.replace(snake, artefacts=artefacts, oscillators=(chain,)).frames()
    held = frames["artefacts"]
    assert held["joint"].tolist() == ["joint01", "joint01", "joint02"]
    np.testing.assert_array_equal(held["start_s"], [1.0, 3.0, np.nan])
    np.testing.assert_array_equal(held["stop_s"], [1.5, 3.2, np.nan])
    (row,) = frames["oscillators"].to_dict("records")
    assert (row["plane"], row["source"], row["target"]) == ("vertical", "a", "b")
    assert [row[f"K{end}_per_s"] for end in ("", "_low", "_high")] == [2.0, 1.9, 2.1]
    assert frames["oscillator_rates"]["omega_rad_s"].tolist() == [3.1]
    assert "oscillators" not in snake.frames()
    modes = kicked.frames()["modes"]
    assert modes["real"].tolist() == [mode.real.value for mode in kicked.oscillators.modes]


def test_a_coupling_is_one_row_a_pair(kicked):
    coupling = kicked.coupling
    frame = coupling.frames()["coupling"].set_index(["joint", "commanded"])
    assert frame.loc[("j2", "j4"), "P"] == coupling.P.value[1][3]
    assert frame.loc[("j2", "j4"), "S_rad"] == coupling.S.value[1][3]
    assert frame.loc[("j5", "j1"), "P_half"] == coupling.P.ci95_half[4][0]
    totals = [row.total.value for row in coupling.phase_rows]
    np.testing.assert_allclose(frame["P"].groupby("joint").sum(), totals)


@pytest.mark.parametrize(
    ("name", "pictures"),
    [
        ("hostile", ["segments"]),
        ("comparison", ["differences", "waveforms"]),
        *(
            pytest.param(*case, marks=pytest.mark.nightly)
            for case in (
                ("snake", ["segments", "body"]),
                ("single", ["segments"]),
                ("both ways", ["mirror"]),
                ("kicked", ["P", "R", "G", "S"]),
                ("reversal", ["mirror"]),
                ("local coupling", ["P"]),
            )
        ),
    ],
)
def test_pictures_are_whole_files_of_their_own(results, name, pictures, tmp_path):
    result = results[name]
    assert result.plot().caption == result.plot(pictures[0]).caption
    for what in pictures:
        picture = result.plot(what)
        assert ET.fromstring(picture.save(tmp_path / f"{what}.svg").read_text()).tag == f"{SVG}svg"
        text = picture.to_svg()
        assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
        assert "var(--ink)" not in text
        assert picture.caption[:20] in picture._repr_html_() or name == "hostile"
    with pytest.raises(UsageError, match=pictures[0]):
        result.plot("nonsense")


def test_two_figures_on_one_page_share_no_identifier(snake):
    first, second = (snake.plot()._repr_html_() for _ in range(2))
    ids = [{part.split('"')[0] for part in figure.split(' id="')[1:]} for figure in (first, second)]
    assert ids[0]
    assert ids[0].isdisjoint(ids[1])


def test_what_can_not_be_drawn_says_why(results, snake):
    with pytest.raises(UsageError, match="no matrix"):
        snake.coupling.plot()
    facts = {"answer": "one", "sessions": (snake,), "runs": (), "heterogeneity": {}}
    facts |= {"reversal": None, "coupling": snake.coupling, "warnings": ()}
    alone = Experiment(**facts, provenance=snake.provenance)
    with pytest.raises(UsageError, match="plot its sessions one by one"):
        alone.plot()


def test_the_comparison_shows_the_margins_and_the_differences(comparison):
    assert list(comparison.frames()["differences"].place.unique()) != []
    assert comparison.partial is not None
    assert comparison.frames()["waveforms"].groupby("name").size().eq(72).all()


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("{", DataError, "not JSON"),
        ("{}", DataError, "holds no result"),
        ('{"identifiable": 1, "why": 2, "matrix": 3}', DataError, "damaged Coupling"),
        (None, InputFileError, "no such file"),
    ],
)
def test_files_without_a_result_are_refused(text, error, message, tmp_path):
    path = tmp_path / "x.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(error, match=message):
        load(path)


def test_names_that_end_otherwise_are_refused(snake, tmp_path):
    with pytest.raises(UsageError, match=r"end its name in \.json"):
        snake.save(tmp_path / "x.csv")
    with pytest.raises(UsageError, match=r"end the name in \.svg"):
        snake.plot().save(tmp_path / "x.png")
