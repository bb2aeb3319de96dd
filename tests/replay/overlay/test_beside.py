"""Sessions side by side, read back with Rerun's own reader and held against closed forms."""

import math
import signal
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
import rerun.blueprint as rrb

import undulog
from support.golden_pictures import marked
from support.twin_chains import chain as chain_text
from support.written_topics import EPOCH_NS, GAIT, write_topics
from undulog.analysis.compare.compare import Choices, compare_sessions
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import LogWriteError
from undulog.capture.common.files import check_stop
from undulog.capture.common.palette import joint_colors
from undulog.capture.common.process import StopRequest
from undulog.replay.overlay.layout import build_blueprint
from undulog.replay.overlay.sessions import Align, align, convert, read_side, times_of
from undulog.replay.overlay.write import Converted, combine_sessions, write_overlay
from undulog.replay.samples.timeline import SESSION_TIME, LoggedRhythm

pytestmark = pytest.mark.nightly

NAMES = ("joint01", "joint02", "joint03", "joint04", "joint05")
LAG = 0.7


@dataclass(frozen=True)
class Wave:
    """A travelling wave that is known at every instant."""

    amplitude: float = 0.4
    frequency_hz: float = 1.0
    phase: float = 0.0
    delay: float = 0.1
    seconds: float = 6.0
    rate_hz: float = 100.0
    epoch_ns: int = EPOCH_NS
    turn: float = 0.0
    step: tuple[float, float] = (0.0, 0.0)

    @property
    def t(self):
        """Sampling times since the start [s]."""
        return np.arange(round(self.seconds * self.rate_hz)) / self.rate_hz

    def cycles(self, t):
        """Phase of the gait in cycles."""
        return self.frequency_hz * t + self.phase

    def angle(self, joint, cycles):
        """What a joint does at a phase [rad]."""
        return self.amplitude * np.sin(2 * np.pi * cycles - joint * LAG - self.delay)

    def head(self, t):
        """Where the head is in the world of this session [m], shape (n, 3)."""
        x, y = 0.2 * t, 0.03 * np.sin(2 * np.pi * self.frequency_hz * t)
        turned = (x + 1j * y) * np.exp(1j * self.turn) + complex(*self.step)
        return np.stack([turned.real, turned.imag, np.full_like(t, 0.025)], axis=-1)


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """Makes robots of some joints."""
    folder = tmp_path_factory.mktemp("robots")

    def make(joints, name="chain"):
        path = folder / f"{name}{joints}.toml"
        path.write_text(chain_text(joints, planes=["horizontal"]))
        return load_robot(path)

    return make


@pytest.fixture(scope="module")
def make(chain):
    """Writes a session of a wave."""

    def write(path, wave, *, robot=True, gait=True, names=NAMES, noise=1e-4, polled_s=0.0):
        rng = np.random.default_rng(sum(path.name.encode()))
        t, joints = wave.t, np.arange(len(names))
        cycles = wave.cycles(t)[:, None]
        polled = wave.cycles(t[:, None] + polled_s * joints)
        angle = wave.angle(joints, polled)
        speed = 2 * np.pi * wave.frequency_hz * wave.angle(joints, polled + 0.25)
        noisy = angle + noise * rng.standard_normal(angle.shape)
        wrapped = np.angle(np.exp(2j * np.pi * cycles))
        topics = {
            "/joint_commands": (names, "rad", 0.4 * np.sin(2 * np.pi * cycles - joints * LAG)),
            "/joint_sample_offset": (names, "s", np.tile(polled_s * joints, (t.size, 1))),
            "/joint_states": (names, "rad", noisy, speed, 0.1 * speed),
            "/gait": (GAIT, "rad", np.hstack([np.full_like(wrapped, 0.4), wrapped])),
        }
        if not polled_s:
            del topics["/joint_sample_offset"]
        if not gait:
            del topics["/gait"]
        return write_topics(
            path,
            wave.epoch_ns + np.round(t * 1e9).astype(np.int64),
            topics,
            head=wave.head(t),
            turn=np.array([0.0, 0.0, math.sin(wave.turn / 2), math.cos(wave.turn / 2)]),
            epoch_ns=wave.epoch_ns,
            robot=chain(len(names)) if robot else None,
            clock={"robot": "simulated"},
        )

    return write


@pytest.fixture
def overlaid(command, tmp_path, read_back):
    """Puts sessions side by side: standard output, and what is in the file."""

    def save(*words):
        path = tmp_path / "x.rrd"
        return command("view", *words, "--save", path).out, read_back(path)

    return save


def degrees(recording, entity):
    """Rows of an angle's entity [degrees]."""
    return np.array(recording.column(entity, "Angle:degrees"), dtype=float)


ROBOT = Wave()
PLACE = {"turn": math.radians(140.0), "step": (3.0, -2.0)}
TIMES = {"seconds": 8.0, "rate_hz": 90.0, "epoch_ns": EPOCH_NS + 86_400_000_000_000}
TWIN = Wave(amplitude=0.35, frequency_hz=0.8, phase=5.3, delay=0.25, **TIMES, **PLACE)


@pytest.fixture(scope="module")
def files(make, tmp_path_factory):
    """A robot and its twin, which walks at another frequency, place and heading."""
    folder = tmp_path_factory.mktemp("pair")
    return make(folder / "a.mcap", ROBOT, noise=0.0), make(folder / "b.mcap", TWIN, noise=0.0)


@pytest.fixture(scope="module")
def beside(files, read_back, tmp_path_factory):
    """Both recordings: aligned by time and by phase."""
    folder = tmp_path_factory.mktemp("beside")
    recordings = {}
    for how in ("time", "phase"):
        path = folder / f"{how}.rrd"
        words = ["view", *map(str, files), "--names", "robot,twin", "--align", how]
        assert undulog.run([*words, "--save", str(path)]) == 0
        recordings[how] = read_back(path)
    return recordings


@pytest.mark.nightly
def test_every_session_keeps_its_entities_under_its_own_name(
    files, beside, read_back, tmp_path, command
):
    for name, file in zip(("robot", "twin"), files, strict=True):
        command("view", file, "--save", tmp_path / f"{name}.rrd")
        alone = {e for e in read_back(tmp_path / f"{name}.rrd").entities if "__" not in e}
        assert {f"/{name}{entity}" for entity in alone} <= beside["time"].entities
    assert len(beside["time"].stores) == 1
    others = {e.split("/")[1] for e in beside["time"].entities} - {"", "__properties"}
    assert others == {"robot", "twin", "compared"}


@pytest.mark.nightly
def test_sessions_lie_at_their_own_time_and_at_their_own_phase(beside):
    for name, wave in (("robot", ROBOT), ("twin", TWIN)):
        entity = f"/{name}/joints/measured"
        for recording in beside.values():
            np.testing.assert_array_equal(recording.times(entity), np.round(wave.t * 1e9))
            cycles = wave.cycles(wave.t) - math.floor(wave.phase)
            np.testing.assert_allclose(
                recording.times(entity, "gait_cycle") * 1e-9, cycles, atol=2e-9
            )


def chord(wave, step_s):
    """How far a straight line between samples may be from the wave [degrees]."""
    fastest = wave.amplitude * (2 * np.pi * wave.frequency_hz) ** 2
    return np.rad2deg(fastest * step_s**2 / 8) + 2e-5  # and 32 bits


@pytest.mark.parametrize("how", ["time", "phase"])
def test_differences_are_those_of_the_waves(beside, how):
    recording, entity, joints = beside[how], "/compared/twin/angles", np.arange(len(NAMES))
    np.testing.assert_array_equal(recording.times(entity), np.round(ROBOT.t * 1e9))
    at = recording.times(entity, "gait_cycle") * 1e-9
    np.testing.assert_allclose(at, ROBOT.cycles(ROBOT.t), atol=2e-9)
    twin_cycles = TWIN.cycles(ROBOT.t) if how == "time" else at
    truth = np.rad2deg(TWIN.angle(joints, twin_cycles[:, None]) - ROBOT.angle(joints, at[:, None]))
    common = np.full(at.size, True)
    if how == "phase":
        common = (at >= 0.3) & (at <= TWIN.cycles(TWIN.t[-1]) - 5.0)
        assert 0.7 * at.size < np.count_nonzero(common)
    rows = degrees(recording, entity)
    assert np.isnan(rows[~common]).all()
    assert np.abs(rows[common] - truth[common]).max() < chord(TWIN, 1 / TWIN.rate_hz)
    assert recording.static(entity, "SeriesLines:names") == list(NAMES)


def test_the_twin_is_laid_on_the_robot_where_both_begin(beside):
    """Both go the same way in worlds of their own, so by time the heads part as one slows down."""
    recording = beside["time"]
    x, y, z, w = recording.static("/twin/world", "Transform3D:quaternion")[0]
    turn = 2 * math.atan2(z, w)
    assert (x, y) == (0.0, 0.0)
    # In a whole cycle each body bends to either side alike, so its head's axis is its direction.
    assert abs(math.remainder(turn + TWIN.turn, 2 * math.pi)) < 1e-3
    moved = np.array(recording.static("/twin/world", "Transform3D:translation")[0])
    cos, sin = math.cos(turn), math.sin(turn)
    there = TWIN.head(np.zeros(1))[0]
    back = np.array([cos * there[0] - sin * there[1], sin * there[0] + cos * there[1]]) + moved[:2]
    np.testing.assert_allclose(back, ROBOT.head(np.zeros(1))[0, :2], atol=1e-6)
    assert moved[2] == 0.0
    apart = np.array(recording.column("/compared/twin/head_distance", "Scalars:scalars"))[:, 0]
    assert apart[0] < 1e-6
    at = recording.times("/compared/twin/head_distance") * 1e-9
    twin_head = TWIN.head(at)[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + moved[:2]
    expected = np.linalg.norm(twin_head - ROBOT.head(at)[:, :2], axis=1)
    np.testing.assert_allclose(apart, expected, atol=1e-4)


@pytest.mark.nightly
def test_in_the_sessions_own_worlds_nothing_is_moved(files, read_back, tmp_path, report_of):
    path = tmp_path / "w.rrd"
    report = report_of("view", *files, "--place", "world", "--save", path)
    assert report["sessions"][1]["placed"] is None
    assert "every body is drawn at the pose of its own session" in report["warnings"]
    assert read_back(path).statics("/b/world", "Transform3D:translation") == []


def test_bodies_have_their_look_and_name_and_leave_when_their_session_ends(beside):
    recording = beside["time"]
    solid, wires = 3, 1
    for name, mode in (("robot", solid), ("twin", wires)):
        assert [mode] in recording.statics(f"/{name}/world/snake/measured", "Capsules3D:fill_mode")
        labels = recording.column(f"/{name}/world/snake/name", "Points3D:labels")
        assert {label for row in labels for label in row} == {name}
    cleared = "/robot/world/snake"
    for timeline in ("session_time", "gait_cycle"):  # at 1 Hz
        assert recording.times(cleared, timeline).tolist() == [round(ROBOT.t[-1] * 1e9) + 1]
    assert recording.times("/twin/world/snake").size == 0


BAR_VALUES = "BarChart:values"


@pytest.mark.nightly
def test_bars_and_their_differences_are_those_of_compare(make, tmp_path, overlaid, opened):
    slow = Wave(amplitude=0.36, delay=0.2)
    files = make(tmp_path / "a.mcap", ROBOT), make(tmp_path / "b.mcap", slow)
    _, recording = overlaid(*files)

    def bar(entity, joint):
        ((height,),) = (bar["buffer"] for bar in recording.static(f"{entity}/{joint}", BAR_VALUES))
        return height

    comparison = compare_sessions(*map(opened, files), Choices(any_gait=True))
    noted = {
        (difference.quantity, difference.place): difference for difference in comparison.differences
    }
    for joint in NAMES:
        gain = bar("/compared/b/segments/gain/estimate", joint)
        lag = bar("/compared/b/segments/lag/estimate", joint)
        assert abs(gain - 100 * (0.36 / 0.4 - 1)) < 0.05
        assert abs(lag - math.degrees(0.1)) < 0.05
        assert gain == pytest.approx(100 * noted["gain", joint].difference.value)
        assert lag == pytest.approx(math.degrees(noted["lag", joint].difference.value))
        assert abs(bar("/compared/segments/gain/b/estimate", joint) - 100 * (0.36 / 0.4 - 1)) < 0.05
    facts = recording.static("/compared/facts", "TextDocument:text")[0]
    said_first = facts.splitlines()[0].replace("\\", "")  # what Markdown would mark up is escaped
    assert said_first == f"**b (B) against a (A): {comparison.answer}.**"


@pytest.fixture(scope="module")
def still(make, tmp_path_factory):
    """A session without a gait's phase."""
    return make(tmp_path_factory.mktemp("still") / "still.mcap", Wave(seconds=2.0), gait=False)


def test_without_a_gait_phases_are_refused_and_times_are_not(files, still, make, tmp_path, command):
    back = make(tmp_path / "back.mcap", Wave(frequency_hz=-1.0, seconds=2.0))
    none = "no phase of a gait was logged (/gait) in still; align by --align time"
    save = ("--save", tmp_path / "x.rrd")
    for how, other, why in (
        ("phase", still, none),
        ("gait", still, none),
        ("phase", back, "runs backwards in back"),
    ):
        assert why in command("view", files[0], other, "--align", how, *save, code=2).err
    assert not (tmp_path / "x.rrd").exists()
    command("view", files[0], still, *save)


def test_a_phase_is_found_where_it_was_first_reached():
    """A gait at 1 Hz that rests from 2 s to 3 s, and is missing from 5 s to 6 s."""
    t = np.round(np.concatenate([np.arange(0, 5.005, 0.01), np.arange(6, 8.005, 0.01)]), 2)
    cycles = np.where(t < 2, t, np.where(t < 3, 2.0, t - 1.0))
    rhythm = LoggedRhythm(np.round(t * 1e9).astype(np.int64), cycles)
    asked = np.array([-0.1, 0.0, 0.735, 2.0, 2.5, 3.9999, 4.0, 4.5, 5.0, 6.125, 7.0, 7.01, np.nan])
    times, reached = times_of(rhythm, asked)
    expected = [np.nan, 0.0, 0.735, 2.0, 3.5, 4.9999, 5.0, np.nan, 6.0, 7.125, 8.0, np.nan, np.nan]
    np.testing.assert_array_equal(reached, np.isfinite(expected))
    np.testing.assert_allclose(times[reached] * 1e-9, np.array(expected)[reached], atol=1e-8)


@pytest.mark.nightly
def test_without_a_robot_the_other_body_stands_alone(files, make, read_back, tmp_path, report_of):
    bare = make(tmp_path / "bare.mcap", Wave(seconds=2.0), robot=False)
    for pair in ((files[0], bare), (bare, files[0])):
        report = report_of("view", *pair, "--save", tmp_path / "x.rrd", "--force")
        bodies = {session["name"]: session["body"] for session in report["sessions"]}
        assert bodies == {"a": True, "bare": False}
        back = read_back(tmp_path / "x.rrd")
        assert degrees(back, f"/compared/{pair[1].stem}/angles").shape[1] == len(NAMES)
        assert not [e for e in back.entities if e.startswith("/bare/world")]


def test_sessions_without_measured_angles_are_seen_too(chain, files, tmp_path, overlaid):
    t_ns = EPOCH_NS + np.arange(100) * 10_000_000
    topics = {"/joint_commands": (NAMES, "rad", np.zeros((100, 5)))}
    write_topics(tmp_path / "c.mcap", t_ns, topics, robot=chain(5))
    out, recording = overlaid(tmp_path / "c.mcap", files[0])
    assert "note: c: no measured joint angles on /joint_states" in out
    assert recording.times("/c/joints/commanded").size == 100
    places = {e for e in recording.entities if e.startswith("/compared/places")}
    assert places == {f"/compared/places/a/{label}" for label in ("head", "middle", "tail")}
    assert "/compared/a/angles" not in recording.entities


@pytest.mark.nightly
def test_joints_in_common_are_compared_and_without_one_nothing_is(make, tmp_path, overlaid):
    long = make(tmp_path / "long.mcap", ROBOT)
    short = make(tmp_path / "short.mcap", ROBOT, names=NAMES[:3])
    other = make(tmp_path / "other.mcap", ROBOT, robot=False, names=("left", "right"))
    out, recording = overlaid(long, short, other)
    assert recording.static("/compared/short/angles", "SeriesLines:names") == list(NAMES[:3])
    assert "robot: chain5 → chain3" in recording.static("/compared/facts", "TextDocument:text")[0]
    assert "\nother (B) against long (A): not compared: no joint" in out
    assert "/compared/other/angles" not in recording.entities


@pytest.mark.nightly
def test_three_sessions_are_each_held_against_the_first(files, still, overlaid):
    out, recording = overlaid(*files, still, "--names", "robot,twin,no gait")
    assert [line.split(" (B)")[0] for line in out.splitlines()[:2]] == ["twin", "no gait"]
    assert {"/compared/twin/angles", "/compared/no\\ gait/angles"} <= recording.entities
    assert recording.times("/no\\ gait/joints/measured", "gait_cycle").size == 0


def test_from_the_start_of_the_gait_what_came_before_has_negative_times(
    files, chain, tmp_path, overlaid
):
    i = np.arange(300)
    gait = np.stack([np.full(300, 0.4), 2 * np.pi * (i - 100) / 100], axis=1)
    gait[:100] = np.nan
    angles = np.tile(i[:, None] * 1e-3, 5)
    topics = {"/joint_states": (NAMES, "rad", angles), "/gait": (GAIT, "rad", gait)}
    late = write_topics(tmp_path / "late.mcap", EPOCH_NS + i * 10_000_000, topics, robot=chain(5))
    _, recording = overlaid(files[0], late, "--align", "gait")
    times = recording.times("/late/joints/measured")
    np.testing.assert_array_equal(times, (np.arange(300) - 100) * 10_000_000)
    rows = degrees(recording, "/compared/late/angles")
    at = ROBOT.t[ROBOT.t < 2.0]
    truth = (0.1 + 0.1 * at)[:, None] - ROBOT.angle(np.arange(5), ROBOT.cycles(at)[:, None])
    assert np.abs(rows[: at.size] - np.rad2deg(truth)).max() < 1e-4


@pytest.mark.nightly
def test_servos_polled_in_turn_differ_at_times_of_the_first(make, tmp_path, overlaid):
    wave = Wave(amplitude=0.3, frequency_hz=0.9, seconds=3.0)
    a = make(tmp_path / "a.mcap", Wave(seconds=3.0), noise=0.0, polled_s=1e-3)
    _, recording = overlaid(a, make(tmp_path / "b.mcap", wave, noise=0.0, polled_s=1.5e-3))
    entity, joints = "/compared/b/angles", np.arange(5)
    at = recording.times(entity) * 1e-9
    np.testing.assert_array_equal(recording.times(entity), recording.times("/a/joints/measured"))
    second, first = (motion.angle(joints, motion.cycles(at)[:, None]) for motion in (wave, ROBOT))
    truth = np.rad2deg(second - first)
    inner = slice(2, -1)  # b begins later: nothing to subtract, and no line to the next sample
    away = np.abs(degrees(recording, entity) - truth)[inner].max()
    assert away < chord(wave, 0.01) + chord(ROBOT, 0.01)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--names", "robot"], "1 names for 2 sessions"),
        (["--names", "x,x"], "a name of its own"),
        (["--names", "x,compared"], "where the differences go"),
        (["--clip", "x.mp4"], "one session's file"),
        (["--json"], "--save"),
    ],
)
def test_wrong_usage_is_explained(files, tmp_path, command, words, complaint):
    assert complaint in command("view", *files, *words, code=2).err
    alone = ("view", files[0], "--align", "phase", "--save", tmp_path / "x.rrd")
    assert "--align: needs two sessions or more" in command(*alone, code=2).err


@pytest.mark.nightly
def test_files_of_one_name_are_kept_apart(files, tmp_path, report_of):
    report = report_of("view", files[0], files[0], "--save", tmp_path / "x.rrd")
    assert [session["name"] for session in report["sessions"]] == ["a 1", "a 2"]
    assert any("same content" in warning for warning in report["warnings"])
    assert report["sessions"][1]["verdict"] == "same"


@pytest.fixture(scope="module")
def converted(files, tmp_path_factory):
    """Robot and twin, each converted."""
    folder = tmp_path_factory.mktemp("converted")
    with ExitStack() as stack:
        sessions = [stack.enter_context(Session.open(file)) for file in files]
        sides = list(map(read_side, sessions, ("robot", "twin")))
        return [
            Converted(aligned, *convert(session, folder / f"{aligned.name}.rrd"))
            for aligned, session in zip(align(sides, Align.TIME), sessions, strict=True)
        ]


@pytest.mark.nightly
def test_an_end_that_is_asked_for_leaves_what_was_there(converted, tmp_path):
    path = tmp_path / "x.rrd"
    path.write_bytes(b"mine")
    stop = StopRequest()
    stop.signal = signal.SIGTERM
    with pytest.raises(LogWriteError, match="stopped on request"):
        write_overlay(converted, path, Align.TIME, stop=stop)
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (b"mine", [path])


def test_an_end_that_is_asked_for_is_noticed_while_a_session_is_read(files, tmp_path, opened):
    path, stop, steps = tmp_path / "x.rrd", StopRequest(), []
    session = opened(files[0]).view(on_read=partial(check_stop, path, stop))
    assert session.joints("/joint_states").names
    stop.signal = signal.SIGTERM
    for read in (
        lambda: next(session.messages("/joint_states")),
        lambda: session.joints("/joint_states"),
        lambda: session.table("/joint_states"),
        lambda: session.columns({"/joint_states": ["position"]}, {}),
        session.forget,
    ):
        with pytest.raises(LogWriteError, match="stopped on request"):
            read()

    stop.signal = None

    def at_the_first_recording(done, note):
        steps.append(note)
        stop.signal = signal.SIGTERM if done else None

    with pytest.raises(LogWriteError, match="stopped on request"):
        combine_sessions(files, path, stop=stop, on_step=at_the_first_recording)
    assert (steps[0], len(steps)) == ("angles", 2)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def window(show, converted, tmp_path_factory):
    """Robot and twin as a user first sees them, after 3 s."""
    path = tmp_path_factory.mktemp("window") / "pair.rrd"
    write_overlay(converted, path, Align.TIME)
    return show(path, 3.0)


def in_a_grid(*shown):
    """Every view at once, none behind a tab."""

    def views(part):
        if isinstance(part, rrb.View):
            return [part]
        return [view for inner in part.contents for view in views(inner)]

    grid = rrb.Grid(*views(build_blueprint(*shown).root_container))
    panel = rrb.TimePanel(state="collapsed", timeline=SESSION_TIME)
    return rrb.Blueprint(grid, panel, collapse_panels=True)


@pytest.mark.nightly
def test_no_view_complains_and_each_shows_something(show, converted, rgb, tmp_path, monkeypatch):
    monkeypatch.setattr("undulog.replay.overlay.write.build_blueprint", in_a_grid)
    write_overlay(converted, tmp_path / "all.rrd", Align.TIME)
    grid = show(tmp_path / "all.rrd", 3.0)
    assert grid.complaints() == []
    # Bodies, three texts, places, power, differences, heads; three bars and three differences.
    assert len(grid.views) == 14
    for name in grid.views:
        assert marked(rgb(grid.picture(name))) > 150, f"the view {name!r} is empty"


@pytest.mark.nightly
def test_both_bodies_and_both_kinds_of_line_are_drawn(window, rgb):
    assert window.complaints() == []
    bodies = rgb(window.picture("robot solid, twin as wireframe"))
    red, blue = bodies[..., 0], bodies[..., 2]
    assert (bodies.min(axis=-1) > 200).sum() > 300  # the wireframe
    assert ((red > 1.5 * blue) & (red > 90)).sum() + ((blue > 1.3 * red) & (blue > 60)).sum() > 500
    lines = rgb(window.picture("Head, middle, tail [°]"))
    legend = lines[:, : lines.shape[1] // 4]
    for joint in (0, 2, 4):
        color = np.abs(lines - joint_colors(5)[joint, :3].astype(int)).max(axis=-1) <= 30
        assert color.sum() - color[:, : legend.shape[1]].sum() > 300
