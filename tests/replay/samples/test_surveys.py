"""What a survey keeps of a session: which windows, how thin, and what is drawn together."""

from types import SimpleNamespace

import numpy as np
import pytest

from support.written_topics import EPOCH_NS, write_topics
from undulog.capture import Session
from undulog.replay.samples import quantities, timeline
from undulog.replay.samples.quantities import refined, survey

NS = 1_000_000_000


@pytest.fixture
def session(tmp_path):
    """Open a session of topics (names, unit, columns) at some times [s]."""
    opened = []

    def write(t_s, topics, **options):
        t_ns = EPOCH_NS + np.round(np.asarray(t_s) * NS).astype(np.int64)
        path = write_topics(tmp_path / f"{len(opened)}.mcap", t_ns, topics, **options)
        opened.append(Session.open(path))
        return opened[-1]

    yield write
    for log in opened:
        log.close()


def lines(surveyed, entity="/joints/measured"):
    """Line by name: its times from the start [s], and values."""
    return {
        track.name: ((track.t_ns - EPOCH_NS) / NS, track.values)
        for track in surveyed.samples.get(entity, ())
    }


# -- windows of a long session --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("length_ns", "later_s"),
    [
        (320 * NS - 1, None),
        (320 * NS, [80, 160, 240]),  # a window each other 40 s, the last before the last 20 s
        (340 * NS, [80, 160, 240]),
        (340 * NS + 1, [80, 160, 240, 320]),
        (640 * NS - 1, [80 * k for k in range(1, 8)]),
        (640 * NS, [120 * k for k in range(1, 6)]),
        (3600 * NS, [40 * 12 * k for k in range(1, 8)]),
    ],
)
def test_at_most_eight_windows_stand_for_a_session_of_320_seconds_or_more(length_ns, later_s):
    start = 12_345
    looks = quantities._looks(SimpleNamespace(start_ns=start, end_ns=start + length_ns))
    if later_s is None:
        assert looks == []
        return
    windows = [(0, 40), *((at, at + 2) for at in later_s)]
    assert looks == [(start + low * NS, start + high * NS) for low, high in windows]


def test_a_brief_survey_is_as_thin_as_what_it_reads(session, monkeypatch):
    t = np.arange(0.0, 330.0, 0.5)
    long = session(t, {"/joint_states": (["a"], "rad", t), "/slow": (["a"], "rad", -t)})
    monkeypatch.setattr(quantities, "_KEPT", 10)
    inside = np.flatnonzero((t < 40) | ((t >= 80) & (t % 80 < 2)))
    # Of 660 samples it reads 46 s of 329.5: about 92, nine times as many as are kept.
    surveyed = survey(long, 50.0, brief=True)
    parts = [inside[inside < 80], *(np.arange(160 * k, 160 * k + 4) for k in (1, 2, 3))]
    kept = np.concatenate([t[part][::10] for part in parts])
    np.testing.assert_allclose(lines(surveyed)["a"][0], kept)
    np.testing.assert_allclose(lines(surveyed, "/signals/slow")["a"][1], -kept)
    # All of it is thinned to as many of each stretch.
    whole = lines(survey(long, 50.0))["a"][0]
    stretches = [t[(t >= 40 * k) & (t < 40 * (k + 1) if k < 7 else t >= 280)] for k in range(8)]
    np.testing.assert_allclose(whole, np.concatenate([stretch[::67] for stretch in stretches]))


@pytest.mark.parametrize(("count", "apart"), [(39, 1), (40, 2), (79, 2), (80, 3), (120, 4)])
def test_samples_are_left_out_from_a_multiple_of_what_is_kept_on(
    session, monkeypatch, count, apart
):
    monkeypatch.setattr(quantities, "_KEPT", 40)
    t = np.arange(count) / 10
    surveyed = survey(session(t, {"/joint_states": (["a"], "rad", t)}), 50.0)
    np.testing.assert_array_equal(lines(surveyed)["a"][1], t[::apart])


# -- what is drawn together -----------------------------------------------------------------------


def in_turn(t):
    """Angles of two joints that come in every other message each."""
    values = np.stack([np.sin(t), np.cos(t)], axis=1)
    values[::2, 0] = values[1::2, 1] = np.nan
    return values


def test_joints_in_turn_are_one_part_where_a_robot_logs_when_it_sampled(session):
    t = np.arange(60) / 10
    names, values = ["a", "b"], in_turn(t)
    apart = session(t, {"/joint_states": (names, "rad", values)})
    assert survey(apart, 50.0).parts["/joints/measured"] == (("a",), ("b",))
    for offset in ("/joint_sample_offset", "/joint_command_offset"):
        zero = np.zeros((60, 2))
        both = session(t, {"/joint_states": (names, "rad", values), offset: (names, "s", zero)})
        assert survey(both, 50.0).parts["/joints/measured"] == (("a", "b"),)


def test_a_picture_is_drawn_when_the_first_joint_was_measured(session):
    t = np.arange(60) / 10
    values = np.stack([np.where(np.arange(60) % 4 == 1, 1.0, np.nan), np.ones(60)], axis=1)
    surveyed = survey(session(t, {"/joint_states": (["seldom", "often"], "rad", values)}), 50.0)
    np.testing.assert_array_equal(
        surveyed.drawing_ns, EPOCH_NS + np.round(t[1::4] * NS).astype(int)
    )


def test_parts_of_two_surveys_are_the_classes_of_both():
    rng = np.random.default_rng(6)
    names = list("abcdefg")
    for _ in range(60):
        before, now = (
            {name: int(rng.integers(3)) for name in names if rng.random() < 0.8} for _ in range(2)
        )
        first, second = (
            [tuple(n for n in part if part[n] == k) for k in dict.fromkeys(part.values())]
            for part in (before, now)
        )
        parts = refined(first, second)
        assert sorted(name for part in parts for name in part) == sorted({*before, *now})
        where = {name: k for k, part in enumerate(parts) for name in part}
        for joint in names:
            for other in names:
                if {joint, other} <= before.keys() and {joint, other} <= now.keys():
                    same = before[joint] == before[other] and now[joint] == now[other]
                    assert (where[joint] == where[other]) == same
                elif joint in before and other not in before and other in now:
                    assert where[joint] != where[other]
        assert refined(parts, second) == parts


# -- power and colours ----------------------------------------------------------------------------


def test_power_colours_only_the_links_of_a_robot(session, snake25):
    robot, t = snake25, np.arange(10) * 0.3
    ones = np.ones((10, 25))
    effort = np.where(t < 1.5, 1.0, 7.0)[:, None] * ones
    topics = {"/joint_states": (robot.joint_names, "rad", ones, 2.0 * ones, effort)}
    plain, with_robot = (
        survey(session(t, topics), 50.0),
        survey(session(t, topics, robot=robot), 50.0),
    )
    assert {*lines(plain, "/power/mechanical")} == {*robot.joint_names}
    # A link within the body shows as much as a joint.
    assert (plain.power_limit_w, with_robot.power_limit_w) == (None, 14.0)


def test_the_times_of_a_thinned_picture_are_those_of_the_first_measured_joint(session):
    t = np.arange(1000) / 100
    names = ["a", "b"]
    surveyed = survey(
        session(
            t,
            {
                "/joint_commands": (names, "rad", np.zeros((1000, 2))),
                "/joint_states": (names, "rad", *np.ones((3, 1000, 2))),
                "/other": (names, "N", np.zeros((1000, 2))),
            },
        ),
        10.0,
    )
    slots = np.floor((t + 0.025 + 1e-9) / 0.1)
    first = np.flatnonzero(np.diff(slots, prepend=-1))
    np.testing.assert_array_equal(
        surveyed.drawing_ns, EPOCH_NS + np.round(t[first] * NS).astype(int)
    )
    assert surveyed.is_whole
    assert [*surveyed.seen] == [
        ("/joint_commands", "position"), *(("/joint_states", field) for field in
        ("position", "velocity", "effort")), ("/other", "position"),
    ]  # fmt: skip


# -- stretches ------------------------------------------------------------------------------------


def test_a_stretch_is_four_times_what_is_read_about_it_at_least(session):
    t = np.arange(0.0, 400.0, 2.0)
    long = session(t, {"/joint_states": (["a"], "rad", t)})
    fields = {"/joint_states": ["position"]}
    for context_s, length_s in ((10, 40), (10.5, 42), (25, 100)):
        parts = list(timeline.stretches(long, fields, round(context_s * NS)))
        assert len(parts) == round(398 / length_s)
        for k, part in enumerate(parts):
            last = k + 1 == len(parts)
            low = -np.inf if k == 0 else k * length_s - context_s
            high = np.inf if last else (k + 1) * length_s + context_s
            (line,) = part.columns["/joint_states", "position"]
            np.testing.assert_allclose(line.values, t[(t >= low) & (t < high)])
            stop_ns = EPOCH_NS + (k + 1) * length_s * NS
            assert part.span.known_ns == (None if last else stop_ns + round(context_s * NS))
            assert k == 0 or part.span.start_ns == stop_ns - length_s * NS
            assert last or part.span.stop_ns == stop_ns
