"""What follows from samples, against sums by hand; the survey of a session against its samples."""

import dataclasses

import numpy as np
import pytest

from support.frozen_records import mutable_dataclasses
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import DataError
from undulog.replay.samples import content, quantities, timeline
from undulog.replay.samples.timeline import STRETCH_NS, stretch_length_ns
from undulog.replay.samples.tracks import Track, drawn_topics, read_columns, wanted_fields

START, NS = 1_735_689_600_000_000_000, 1_000_000_000
T = 10 * np.arange(4, dtype=np.int64)


def track(name, values, t_ns=T):
    return Track(name, np.asarray(t_ns, dtype=np.int64), np.asarray(values, dtype=float))


def rows(tracks):
    return {line.name: (line.t_ns.tolist(), line.values.tolist()) for line in tracks}


# -- what follows from samples ------------------------------------------------------------------


def test_an_error_is_against_the_command_that_holds():
    measured = [track("a", [1.0, 2.0, 3.0, 4.0]), track("b", [0.0] * 4)]
    commanded = [track("x", [9.0] * 4), track("a", [10.0, 20.0, 30.0, 40.0], T + 5)]
    errors = quantities.tracking_errors(measured, commanded)
    assert [line.name for line in errors] == ["a"]
    np.testing.assert_array_equal(errors[0].values, [np.nan, 2.0 - 10.0, 3.0 - 20.0, 4.0 - 30.0])
    np.testing.assert_array_equal(errors[0].t_ns, T)


def test_powers_are_products_at_the_times_of_effort_and_of_current():
    columns = {
        ("/joint_states", "effort"): (track("a", [1, 2, 3, 4]), track("b", [5] * 4)),
        ("/joint_states", "velocity"): (track("a", [0, 10, 20, 30], T - 5),),
        ("/joint_current", "position"): (track("b", [1, -1, 1, -1]),),
        ("/joint_voltage", "position"): (track("b", [6, 7, 8, 9]),),
    }
    (power,) = quantities.mechanical_power(columns)
    np.testing.assert_array_equal(power.values, [5.0, 30.0, 75.0, np.nan])
    assert rows(quantities.electrical_power(columns)) == {"b": (T.tolist(), [6, -7, 8, -9])}
    assert quantities.mechanical_power({}) == quantities.electrical_power({}) == ()


def test_a_total_is_at_the_first_ones_times_and_unknown_where_one_is():
    whole = quantities.total([track("a", [1, 2, 3, 4]), track("b", [10, 20, 30, 40], T - 5)])
    assert whole.name == "total"
    np.testing.assert_array_equal(whole.t_ns, T)
    np.testing.assert_array_equal(whole.values, [16.0, 27.0, 38.0, np.nan])
    assert quantities.total([]) is None


@pytest.mark.parametrize(
    ("power", "limit"),
    [
        (np.linspace(-1.0, 0.5, 1501), 0.99),  # the 99th percentile of the magnitude
        (np.r_[np.full(1000, -0.123), 50.0, np.nan], 0.13),  # rounded up to two digits
        (np.full(3, 1234.0), 1300.0),
        (np.zeros(4), 1.0),
        (np.r_[np.zeros(999), 5.0], 1.0),  # nearly all of it
        (np.full(2, np.nan), 1.0),
    ],
)
def test_the_colour_is_full_at_nearly_the_largest_power(power, limit):
    assert quantities.power_limit(power) == pytest.approx(limit)


def test_a_link_shows_half_of_the_joints_at_its_ends():
    power = quantities.segment_power(np.array([[2.0, 4.0, 6.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(power, [[1, 3, 5, 3], [0.5, 0.5, 0, 0]])


def test_topics_become_paths_part_by_part():
    assert quantities.topic_entity("/signals", "/joint_current") == "/signals/joint_current"
    assert quantities.topic_entity("/signals", "//a b//c/") == r"/signals/a\ b/c"


def test_what_is_plotted_of_columns():
    lines = (track("a", [1, 2, 3, 4]),)
    columns = {
        ("/joint_states", "position"): lines,
        ("/joint_states", "effort"): lines,
        ("/joint_states", "velocity"): lines,
        ("/joint_commands", "position"): lines,
        ("/joint_current", "position"): lines,
        ("/joint_voltage", "position"): lines,
        ("/gait", "position"): lines,
        ("/warm", "position"): lines,
        ("/warm", "velocity"): lines,
        ("/warm", "effort"): lines,
        ("/none", "position"): (),
    }
    plotted = quantities.quantities(columns)
    assert set(plotted) == {
        "/joints/commanded", "/joints/measured", "/joints/error", "/power/mechanical",
        "/power/total/mechanical", "/power/total/electrical", "/signals/joint_current",
        "/signals/joint_voltage", "/signals/warm",
    }  # fmt: skip
    assert rows(plotted["/power/total/electrical"])["total"][1] == [1, 4, 9, 16]
    assert rows(plotted["/joints/error"])["a"][1] == [0, 0, 0, 0]
    assert quantities.quantities({("/joint_states", "effort"): lines}) == {}


# -- parts that are drawn together --------------------------------------------------------------


def test_lines_of_the_same_times_or_in_turn_are_one_part():
    lines = [track("a", T), track("b", T, T + 3), track("c", T), track("d", T[:1], [1])]
    assert quantities._parts(lines, turns=False) == [("a", "c"), ("b",), ("d",)]
    assert quantities._parts(lines, turns=True) == [("a", "b", "c"), ("d",)]


def test_parts_stay_together_only_where_they_always_are():
    refined = quantities.refined
    assert refined([], [("a", "b"), ("c",)]) == [("a", "b"), ("c",)]
    assert refined([("a", "b", "c")], [("a", "c"), ("b",)]) == [("a", "c"), ("b",)]
    assert refined([("a", "b")], [("a",)]) == [("a", "b")]  # b has no samples now
    assert refined([("a",)], [("a", "b"), ("c",)]) == [("a",), ("b",), ("c",)]
    chain = {"a": 0, "b": 1, "c": 2}
    parts = quantities._in_order([("x", "c"), ("b", "a"), ("y",)], chain)
    assert parts == (("a", "b"), ("c", "x"), ("y",))


# -- a session ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def snake():
    return load_robot("snake25")


@pytest.fixture
def opened(tmp_path):
    """Open a session of joint topics: (topic, names, times [s], values by time, fields)."""
    sessions = []

    def write(*topics, robot=None, gait=False):
        path = tmp_path / f"{len(sessions)}.mcap"
        with SessionWriter(path, session_id="s", epoch_ns=START, robot=robot) as writer:
            for topic, names, times_s, values, *fields in topics:
                full = dict.fromkeys(fields, True)
                channel = writer.joint_state(topic, names, unit="rad", **full)
                for at_s, value in zip(times_s, values, strict=True):
                    row = np.full(len(names), value, dtype=float)
                    channel.write(START + round(at_s * NS), row, *[row + 1.0] * len(fields))
            if gait:
                writer.joint_state("/gait", ["A"], unit="rad").write(START, np.zeros(1))
            writer.string("/gait/mode").write(START, "walk")
        sessions.append(Session.open(path))
        return sessions[-1]

    yield write
    for session in sessions:
        session.close()


def test_the_fields_that_come_are_found(opened):
    t = np.arange(50) / 10
    names = ("a", "b")
    session = opened(("/joint_states", names, t, t, "velocity"), ("/warm", names, t, t), gait=True)
    assert wanted_fields(session) == {
        "/joint_states": ["position", "velocity", "effort"], "/warm": ["position"],
        "/gait": ["position"],
    }  # fmt: skip
    survey = quantities.survey(session, 50.0)
    assert survey.topics == {"/joint_states": ["position", "velocity"], "/warm": ["position"]}
    assert survey.seen["/joint_states", "velocity"] == set(names)
    assert survey.power_limit_w is None
    assert survey.is_whole
    assert quantities.comes(session, "/joint_states", "velocity")
    assert not quantities.comes(session, "/joint_states", "effort")
    assert not quantities.comes(session, "/nothing", "position")


def test_a_survey_keeps_lines_in_chain_order_and_thins_the_times(opened, snake):
    t = np.arange(400) / 100
    names = ("joint03", "x", "joint01")
    fields = ("velocity", "effort")
    session = opened(("/joint_states", names, t, np.sin(t), *fields), robot=snake)
    survey = quantities.survey(session, 10.0)
    measured = survey.samples["/joints/measured"]
    assert [line.name for line in measured] == ["joint01", "joint03", "x"]
    np.testing.assert_allclose(measured[0].values, np.sin(t))
    assert survey.parts["/joints/measured"] == (("joint01", "joint03", "x"),)
    # Slots of 100 ms begin a quarter of one early, and keep their first sample.
    kept_ms = np.r_[0, 100 * np.arange(1, 41) - 20]
    np.testing.assert_array_equal(survey.drawing_ns, START + kept_ms * 1_000_000)
    # Three lines of 25 joints have a power: the head shows half of the first one's, (1 + sin)^2.
    assert survey.power_limit_w == 2.0
    assert survey.context_ns == 500_000_000  # 1.2 x 5 steps of 10 ms are less than the least
    slow = opened(("/joint_states", names, t[::40], t[::40], *fields), robot=snake)
    assert quantities.survey(slow, 10.0).context_ns == pytest.approx(6 * 400_000_000)
    rare = opened(("/joint_states", names, 12.0 * t[:20] * 100, t[:20], *fields), robot=snake)
    assert quantities.survey(rare, 10.0).context_ns == 60_000_000_000  # a minute at most


def test_the_power_of_all_links_sets_the_colour(opened, snake):
    t = np.arange(200) / 100
    session = opened(
        ("/joint_states", snake.joint_names, t, np.full(200, -1.5), "velocity", "effort"),
        robot=snake,
    )
    # Velocity and effort are -0.5: 0.25 W a joint, of which inner links show as much.
    assert quantities.survey(session, 10.0).power_limit_w == pytest.approx(0.25)


def test_of_many_samples_some_thousand_are_kept(opened):
    t = np.arange(8000) / 1000
    session = opened(("/joint_states", ("a",), t, np.arange(8000)))
    (line,) = quantities.survey(session, 50.0).samples["/joints/measured"]
    np.testing.assert_array_equal(line.values, np.arange(0, 8000, 3))  # 1 + 8000 // 4000
    some = opened(("/joint_states", ("a",), t[:3999], np.arange(3999)))
    (line,) = quantities.survey(some, 50.0).samples["/joints/measured"]
    assert line.values.size == 3999


def test_a_long_session_is_looked_into_here_and_there(opened):
    long_s = STRETCH_NS / NS * 8 * 3 + 1.0
    t = np.arange(0.0, long_s, 0.5)
    session = opened(("/joint_states", ("a",), t, t))
    looks = quantities._looks(session)
    start = session.start_ns
    assert looks[0] == (start, start + STRETCH_NS)
    assert [stop - low for low, stop in looks[1:]] == [2 * NS] * (len(looks) - 1)
    every = 4 * STRETCH_NS  # the last one begins 20 s before the end at the latest
    assert [low - start for low, _ in looks[1:]] == [every * k for k in range(1, 6)]
    brief = quantities.survey(session, 50.0, brief=True)
    assert not brief.is_whole
    seen_s = (brief.samples["/joints/measured"][0].t_ns - start) / NS
    inside = [at for at in t if any(low <= start + at * NS < stop for low, stop in looks)]
    np.testing.assert_allclose(seen_s, inside)
    assert quantities.survey(session, 50.0).is_whole
    short = opened(("/joint_states", ("a",), t[:79], t[:79]))  # 39 s
    assert quantities._looks(short) == []
    assert quantities.survey(short, 50.0, brief=True).is_whole


def test_stretches_are_as_long_as_they_have_to_be(opened):
    t = np.arange(0.0, 200.0, 0.5)
    session = opened(("/joint_states", ("a",), t, t))
    assert stretch_length_ns(session) == STRETCH_NS
    assert stretch_length_ns(session, 3 * STRETCH_NS) == 3 * STRETCH_NS
    spans = [
        stretch.span for stretch in timeline.stretches(session, {"/joint_states": ["position"]}, NS)
    ]
    starts = [session.start_ns + k * STRETCH_NS for k in range(1, 5)]
    assert [span.start_ns for span in spans[1:]] == starts == [span.stop_ns for span in spans[:-1]]
    assert [span.known_ns for span in spans] == [*(at + NS for at in starts), None]
    read = timeline.stretches(session, {"/joint_states": ["position"]}, NS)
    for k, stretch in enumerate(read):
        (line,) = stretch.columns["/joint_states", "position"]
        seen = t[(t >= 40 * k - (k > 0)) & (t < 40 * (k + 1) + (k < 4))]  # a second about it
        np.testing.assert_array_equal(line.t_ns - session.start_ns, np.round(seen * NS))
    assert spans[0].start_ns < 0
    assert spans[-1].stop_ns > 1 << 61
    brief = opened(("/joint_states", ("a",), t[:6], t[:6]))
    (whole,) = timeline.stretches(brief, {"/joint_states": ["position"]}, NS)
    assert whole.span == timeline.DrawnSpan()
    # A clock that jumps a year: a million stretches would be empty.
    year = opened(("/joint_states", ("a",), np.append(t, 3.2e7), np.append(t, 1.0)))
    length_ns = stretch_length_ns(year)
    assert length_ns / STRETCH_NS == 2 ** round(np.log2(length_ns / STRETCH_NS))
    count = round((year.end_ns - year.start_ns) / length_ns)
    assert 100 < count <= 200


def test_a_session_without_samples_of_a_field_gives_the_others(opened):
    t = np.arange(30) / 10
    session = opened(("/joint_states", ("a", "b"), t, t), ("/empty", ("a",), t, t * np.nan))
    columns = read_columns(session)
    assert set(columns) == {("/joint_states", "position")}
    window = read_columns(
        session, start_ns=session.start_ns + NS, stop_ns=session.start_ns + 2 * NS
    )
    assert window["/joint_states", "position"][0].values.tolist() == pytest.approx(t[10:20])


def test_too_many_topics_leave_out_strangers_and_too_many_joints_are_refused(opened, monkeypatch):
    t = np.arange(5) / 10
    strangers = [(f"/other{k}", ("a",), t, t) for k in range(3)]
    session = opened(
        *strangers, ("/joint_states", ("a", "b"), t, t), ("/joint_sample_offset", ("a",), t, t)
    )
    assert drawn_topics(session) == ([*(topic for topic, *_ in strangers), "/joint_states"], 0)
    monkeypatch.setattr("undulog.replay.samples.tracks.MOST_TOPICS", 2)
    assert drawn_topics(session) == (["/other0", "/joint_states"], 2)
    monkeypatch.setattr("undulog.replay.samples.tracks.MOST_JOINTS", 1)
    with pytest.raises(DataError, match="/joint_states has 2 joints; at most 1 are drawn"):
        read_columns(session)


# -- names and ranges ---------------------------------------------------------------------------


def test_places_of_three_joints_are_head_middle_tail():
    three = content.BodyPlaces(("a", "b", "c"), None)
    assert three.labelled == {"a": "head", "b": "middle", "c": "tail"}
    assert content.BodyPlaces(("a", "b"), None).labelled == {"a": "a", "b": "b"}
    assert content.line_title("a", "head") == "a head"
    assert content.line_title("joint01", "head") == "joint01 head"
    assert content.line_title("a", "a") == "a"


def test_a_map_names_its_range():
    none = np.zeros(0)
    table = content.CycleTable(content.LAG, ("a",), none, none, none)
    heat_map = content.HeatMap(table, (1,), -12.5, 12.5, signed=True)
    assert (heat_map.entity, heat_map.title) == ("/maps/lag_degrees", "Lag map, ±12.5°")
    table = dataclasses.replace(table, quantity=content.ENERGY)
    other = content.HeatMap(table, (1,), 0.25, 1.5, signed=False)
    assert other.title == "Net energy map, 0.25 to 1.50 J/cycle"


def test_content_begins_with_nothing():
    empty = content.Content(None)
    assert not any(vars(empty).values())
    assert {type(value) for value in vars(empty).values()} == {type(None), tuple, bool, int}
    assert content.Layer(None) == content.Layer(None, None, (), ())
    for red, green, blue, opacity in (content.GREY, content.NAMED):
        assert (min(red, green, blue) >= 0, opacity) == (True, 255)
    assert len(set(content.GREY[:3])) == 1


def test_titles_of_signals_are_short_and_others_keep_their_names():
    assert content.signal_title("/joint_temperature", "degC") == "Temperature [°C]"
    assert content.signal_title("/lab/force", "N") == "lab/force [N]"


def test_numbers_are_added_to_a_layer_without_them():
    named = (content.Named("a", "why"),)
    first, later = content.Layer(None, None, named, ("x",)), content.Layer(None, None, (), ("y",))
    assert first.with_numbers(later) == content.Layer(None, None, named, ("x", "y"))


def test_what_is_handed_on_can_not_be_changed():
    assert mutable_dataclasses("undulog.replay.samples") == set()
