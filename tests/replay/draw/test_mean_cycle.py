"""The mean cycle in a recording: its own timeline, closed, and true to a twin's periodic motion."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import undulog
from support.twin_chains import chain, wave
from undulog.analysis.common.estimate import Estimate
from undulog.analysis.parts.artefacts.result import Artefact
from undulog.analysis.session.analyse import measure_session
from undulog.analysis.session.cycle_maps import cycle_maps
from undulog.capture import Session
from undulog.replay.draw.drawing import Sources, clock_of
from undulog.replay.draw.mean_cycle import Averaged
from undulog.replay.draw.steps import cycle_tables
from undulog.replay.numbers import computed
from undulog.replay.recording import write_recording
from undulog.replay.samples import timeline
from undulog.replay.samples.timeline import ENSEMBLE_CYCLE


@pytest.fixture(scope="module")
def twin(tmp_path_factory, read_back):
    """A chain of five joints in a steady wave: (session's file, what was reported, recording)."""
    folder = tmp_path_factory.mktemp("twin")
    (folder / "chain.toml").write_text(chain(5, planes=["horizontal"]))
    run = {"duration_s": 8.0, "settle_s": 3.0, "physics_rate_hz": 4000, "gait": {"ramp_s": 0.5}}
    (folder / "wave.toml").write_text(wave(**run, horizontal={"lag": 1.0}))
    words = ["sim", "run", str(folder / "wave.toml"), "-o", str(folder / "run.mcap")]
    assert undulog.run(words) == 0
    with Session.open(folder / "run.mcap") as session:
        written = write_recording(session, folder / "run.rrd", analysis=computed(session).analysis)
    return folder / "run.mcap", written, read_back(folder / "run.rrd")


def rows(recorded, entity):
    """Values by degrees, shape (73, joints)."""
    return np.array(recorded.column(entity, "Scalars:scalars"), dtype=float)


def test_angles_errors_and_power_are_the_closed_form(recording):
    written, recorded = recording
    assert written.content.mean.period_s == pytest.approx(2.0)
    degrees = np.arange(0, 361, 5)
    np.testing.assert_array_equal(recorded.times("/ensemble/measured", ENSEMBLE_CYCLE), degrees)
    phase, k = np.radians(degrees)[:, None], np.arange(13)
    late = phase - k * np.pi / 3 - np.radians(7 + 0.5 * k)
    (series,) = written.content.mean.measured
    assert len(series.names) == 25
    angles = rows(recorded, "/ensemble/measured")
    np.testing.assert_array_equal(angles[0], angles[-1])
    np.testing.assert_allclose(angles[:, ::2], np.degrees(0.38 * np.sin(late)), atol=1e-3)
    np.testing.assert_allclose(angles[:, 1::2], 0.0, atol=1e-9)
    error = np.degrees(0.38 * np.sin(late) - 0.4 * np.sin(phase - k * np.pi / 3))
    np.testing.assert_allclose(rows(recorded, "/ensemble/error")[:, ::2], error, atol=1e-3)
    power = 0.1 * np.cos(late + 1.2) * 0.38 * np.pi * np.cos(late)
    np.testing.assert_allclose(rows(recorded, "/ensemble/power")[:, ::2], power, atol=1e-5)


def test_the_body_moves_about_its_own_middle(recording):
    _, recorded = recording
    entity = "/ensemble/body/measured"
    origin, turn, length = (
        np.array(recorded.column(entity, f"Capsules3D:{part}"), dtype=float)
        for part in ("translations", "quaternions", "lengths")
    )
    assert origin.shape == (73, 26, 3)
    along = Rotation.from_quat(turn.reshape(-1, 4)).apply([0.0, 0.0, 1.0]).reshape(origin.shape)
    middle = origin + 0.5 * length[..., None] * along
    np.testing.assert_allclose(middle.mean(axis=1), 0.0, atol=1e-3)
    assert (middle[:, 0, 0] > 0.3).all()  # the head is in front
    assert np.ptp(middle[:, 0, 1]) > 0.03  # and swings
    # On the session's timelines there is a shape that stands, and nothing else.
    assert recorded.times("/ensemble/measured", "session_time").size == 0
    assert recorded.times("/ensemble/body/on_session_time/measured", "session_time").size == 1


def test_one_cycle_has_no_interval_and_says_so(recording):
    _, recorded = recording
    assert not any(path.endswith("/low") for path in recorded.entities)
    words = recorded.static("/ensemble/about", "TextDocument:text")[0]
    assert "Mean of 1 cycle, 0.0 to 2.0 s" in words
    assert "there is no interval" in words


def test_a_gait_that_changes_is_averaged_and_says_so(
    session_file, analysis, tmp_path, read_back, opened
):
    none = dataclasses.replace(analysis.gait, frequency_hz=Estimate())
    changing = dataclasses.replace(analysis, gait=none)
    write_recording(opened(session_file), tmp_path / "a.rrd", analysis=changing)
    words = read_back(tmp_path / "a.rrd").static("/ensemble/about", "TextDocument:text")[0]
    assert "No steady gait was found" in words
    assert "0.0 to 3.0 s" in words  # all of the logged phase


@pytest.mark.nightly
def test_the_twins_settled_motion_is_its_mean_cycle(twin):
    file, written, recorded = twin
    (series,) = written.content.mean.measured
    angles = np.radians(rows(recorded, "/ensemble/measured"))
    with Session.open(file) as session:
        joints = session.joints("/joint_states", "position")
        gait = session.joints("/gait")
        start_ns = session.start_ns
    phase = dict(zip(gait.names, zip(gait.t_ns, gait.values, strict=True), strict=True))
    t_ns, logged = phase["horizontal.phase"]
    for k, name in enumerate(series.names):
        sample_ns, values = joints.t_ns[k], joints.values[k]
        last = sample_ns - start_ns > 7_000_000_000  # the last cycle, sample by sample
        at = np.degrees(np.interp(sample_ns[last], t_ns, np.unwrap(logged))) % 360
        drawn = np.interp(at, np.arange(0, 361, 5), angles[:, k])
        assert joints.names[k] == name
        # Between 5 degrees a straight line is off by 0.4 (pi / 72)^2 / 2 rad at most.
        np.testing.assert_allclose(values[last], drawn, atol=1.5e-3)


@pytest.mark.nightly
def test_the_twins_interval_is_as_narrow_as_its_cycles_agree(twin):
    _, _, recorded = twin
    low = rows(recorded, "/ensemble/places/head/low")
    high = rows(recorded, "/ensemble/places/head/high")
    assert (high >= low).all()
    assert np.degrees(1e-3) > (high - low).max()


@pytest.mark.nightly
def test_the_cycles_agree_with_the_reports_maps(twin, opened):
    measured = measure_session(opened(twin[0]))
    maps = cycle_maps(measured)
    gain, lag, energy = cycle_tables(measured.analysis)
    inside = gain.start_s >= maps.start_s[0]
    for table, expected in (
        (gain, 100 * (maps.gain.mean(axis=1) - 1)),
        (lag, np.degrees(maps.lag_rad.mean(axis=1))),
    ):
        np.testing.assert_allclose(table.value[:, inside].mean(axis=1), expected, atol=0.02)
    np.testing.assert_allclose(energy.value / (energy.stop_s - energy.start_s), maps.power_w)


def test_joints_with_a_false_sensor_are_left_out(
    session_file, analysis, tmp_path, read_back, opened
):
    frozen = Artefact("joint09", "/joint_states", "position", "frozen", ((0.2, 1.0),))
    false = dataclasses.replace(analysis, artefacts=(frozen,))
    written = write_recording(opened(session_file), tmp_path / "a.rrd", analysis=false)
    (series,) = written.content.mean.measured
    assert "joint09" not in series.names
    assert any("the mean cycle leaves out joint09" in note for note in written.warnings)
    shapes = read_back(tmp_path / "a.rrd").column("/ensemble/body/measured", "Capsules3D:radii")
    assert {len(row) for row in shapes} == {9}  # the links before the joint


@pytest.mark.nightly
def test_what_was_kept_stretch_by_stretch_is_what_is_read_at_once(twin, monkeypatch):
    monkeypatch.setattr(timeline, "STRETCH_NS", 10**9)
    with Session.open(twin[0]) as session:
        analysis, sources, clock = (
            computed(session).analysis,
            Sources.of(session),
            clock_of(session),
        )
        averaged, fields = Averaged(clock, analysis), sources.survey.topics
        stretches = list(timeline.stretches(session, fields, sources.survey.context_ns))
        for stretch in stretches:
            averaged.keep(stretch)
        kept, read = averaged.kept, averaged.read(session, fields)
    assert len(stretches) > 3
    assert kept.keys() == read.keys()
    for key in read:
        for track, other in zip(kept[key], read[key], strict=True):
            assert track.name == other.name
            np.testing.assert_array_equal(track.t_ns, other.t_ns)
            np.testing.assert_array_equal(track.values, other.values)
