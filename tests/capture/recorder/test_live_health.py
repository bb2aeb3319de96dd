"""The verdict on a running recording is the one that its finished file gets."""

import gc
import itertools
import json
import sys
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from undulog.capture import SessionWriter, load_robot
from undulog.capture.log.health.freeze import FreezeTally, RangeTally
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.messages.definitions import OK, DiagnosticStatus
from undulog.capture.log.messages.frames import ERROR_FLAG, empty_frames
from undulog.capture.log.write.mcap_sink import McapSink
from undulog.capture.recorder import health as live_health
from undulog.capture.recorder.health import LiveHealth
from undulog.capture.recorder.recording import TappedSink
from undulog.capture.sources.contract import SourceCounts

EPOCH_NS = 1_700_000_000_000_000_000
NS = 1_000_000_000
STEP_NS = 10_000_000
ROBOT = load_robot("snake25")
NAMES = ROBOT.joint_names


class Lossy:
    """A sink that loses every message whose number a draw hits; others keep their numbers."""

    def __init__(self, sink, rng, part):
        self._sink, self._rng, self._part = sink, rng, part

    def define(self, record):
        self._sink.define(record)

    def write(self, channel_id, log_ns, publish_ns, number, data):
        if self._rng.random() >= self._part:
            self._sink.write(channel_id, log_ns, publish_ns, number, data)

    def close(self, last):
        self._sink.close(last)


@dataclass(frozen=True)
class Faults:
    """What goes wrong in a recording, as parts of the ticks or as whole ticks."""

    seed: int = 1
    ticks: int = 800
    lost: float = 0.0
    skipped: float = 0.0
    nan: float = 0.0
    frozen: int = 0
    back: float = 0.0
    late: float = 0.0
    clipped: bool = False
    gap: int = 0
    dropped: int = 0
    updates: float = 0.2


@contextmanager
def judged(path, health):
    """A session that is judged while it is written."""
    sink = TappedSink(McapSink(path), [health])
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, sink=sink) as writer:
        yield writer


faults = st.builds(
    Faults,
    seed=st.integers(0, 2**32),
    ticks=st.integers(1, 900),
    lost=st.sampled_from([0.0, 0.0, 0.01, 0.3]),
    skipped=st.sampled_from([0.0, 0.0, 0.02, 0.2]),
    nan=st.sampled_from([0.0, 0.0, 0.002, 0.2]),
    frozen=st.integers(0, 25),
    back=st.sampled_from([0.0, 0.0, 0.01]),
    late=st.sampled_from([0.0, 1e6, 5e6]),
    clipped=st.booleans(),
    gap=st.sampled_from([0, 0, 30, 500]),
    dropped=st.sampled_from([0, 0, 7, 100_000]),
    updates=st.sampled_from([0.0, 0.01, 0.5]),
)


def record(path, wrong):
    """A recording of up to 9 s with faults; its live verdict, at its end."""
    rng = np.random.default_rng(wrong.seed)
    health = LiveHealth(ROBOT)
    sink = Lossy(TappedSink(McapSink(path), [health]), rng, wrong.lost)
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=ROBOT, sink=sink) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True)
        current = writer.joint_state("/joint_current", NAMES, unit="A")
        sensor = {"min_range": 0.1, "max_range": 4.0, "field_of_view": 0.2}
        sonar = writer.range("/sonar", frame="head", **sensor)
        bus, events = writer.frames("/can/can0"), writer.log("/rosout")
        diagnostics = writer.diagnostics()
        limit = ROBOT.joints[0].upper
        for tick in range(wrong.ticks):
            after = wrong.gap if tick >= wrong.ticks // 2 else 0
            log_ns = EPOCH_NS + (tick + after) * STEP_NS
            t_ns = log_ns + int(rng.normal(0.0, wrong.late))
            if rng.random() < wrong.back:
                t_ns -= 3 * STEP_NS
            command = 0.4 * np.sin(np.pi * tick / 100 - 0.5 * np.arange(len(NAMES)))
            angles = command + rng.normal(0.0, 1e-3, len(NAMES))
            angles[: wrong.frozen] = 0.1
            if wrong.clipped:
                angles[20] = np.clip(3 * command[20], -limit, limit)
            angles[rng.random(len(NAMES)) < wrong.nan] = np.nan
            commands.write(t_ns, command, log_time_ns=log_ns)
            if rng.random() >= wrong.skipped:
                states.write(t_ns, angles, command, log_time_ns=log_ns)
            if tick % 3 == 0:
                current.write(t_ns, angles, log_time_ns=log_ns)
                sonar.write(t_ns, np.nan if rng.random() < wrong.nan else 1.0, log_time_ns=log_ns)
            frames = empty_frames(int(rng.integers(0, 30)))
            frames["t_host_ns"] = log_ns + np.arange(len(frames)) * 1000
            frames["dlc"] = 8
            frames["id_flags"][rng.random(len(frames)) < wrong.nan] = ERROR_FLAG
            bus.write(log_ns, frames)
            if tick % 100 == 0:
                events.write(log_ns, "info", "recorder", f"tick {tick}")
                counts = {"frames": str(tick * 15), "dropped": str(wrong.dropped * tick // 100)}
                diagnostics.write(log_ns, [DiagnosticStatus(OK, "source can0", "", "", counts)])
            if rng.random() < wrong.updates:
                health.step(log_ns)
        outcome = health.final()
        writer.set_verdict(outcome.verdict, outcome.reasons)
    return outcome


def without_rounding(health):
    """All that was measured; a standard deviation is a difference of sums, so to nine digits."""
    timings = [series.timing for series in health.series]
    series = tuple(
        replace(series, timing=replace(timing, std_s=round(timing.std_s or 0.0, 9)))
        for series, timing in zip(health.series, timings, strict=True)
    )
    rounded = replace(health, series=series)
    names = ("robot", "start_ns", "end_ns", "channels", "joints", "buses", "sources", "findings")
    return [getattr(rounded, name) for name in (*names, "series")]


@pytest.mark.nightly
@given(faults)
@settings(max_examples=60, deadline=None)
def test_the_live_verdict_is_that_of_the_finished_file(tmp_path_factory, wrong):
    path = tmp_path_factory.mktemp("live") / "s.mcap"
    live = record(path, wrong)
    checked = check_session(path)
    assert checked.file.damage == ()
    assert without_rounding(live) == without_rounding(checked)
    assert live.findings == checked.findings
    assert (checked.stored, checked.stored_reasons) == (live.verdict, live.reasons)
    if not checked.following:  # what only the whole file shows
        assert (checked.verdict, checked.reasons) == (live.verdict, live.reasons)


def test_a_clean_recording_is_good(tmp_path):
    live = record(tmp_path / "s.mcap", Faults())
    assert (live.verdict, live.reasons) == ("good", ())
    assert live.sources[0].name == "can0"


def test_pieces_keep_the_order(tmp_path, monkeypatch):
    monkeypatch.setattr(live_health, "PIECE", 2000)
    live = record(tmp_path / "s.mcap", Faults(back=0.01, nan=0.002, lost=0.01, updates=1.0))
    assert without_rounding(live) == without_rounding(check_session(tmp_path / "s.mcap"))


def test_frames_lost_before_the_recorder_are_held_against_the_session(tmp_path):
    live = record(tmp_path / "s.mcap", Faults(dropped=12))
    checked = check_session(tmp_path / "s.mcap")
    # At tick 700: 700 * 15 taken, 7 * 12 lost.
    loss = "source can0 lost 84 of 10584 frames before the recorder (0.79%)"
    assert checked.reasons == live.reasons == (loss,)
    assert (
        json.loads(json.dumps([asdict(source) for source in checked.sources]))[0]["dropped"] == 84
    )


def test_a_later_part_answers_for_its_own_losses_only(tmp_path):
    path = tmp_path / "s.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        diagnostics = writer.diagnostics()
        for second, dropped in ((100, 50), (101, 50), (102, 53)):
            counts = {"frames": str(1000 * second), "dropped": str(dropped)}
            values = {"recorder": {"elapsed_s": str(second)}, "source can0": counts}
            statuses = [DiagnosticStatus(OK, name, "", "", values[name]) for name in values]
            diagnostics.write(EPOCH_NS + second * NS, statuses)
    (source,) = check_session(path).sources
    assert (source.frames, source.dropped) == (2000, 3)


def test_other_people_s_diagnostics_are_no_sources(tmp_path):
    path = tmp_path / "s.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        status = DiagnosticStatus(OK, "source of light", "on", "lamp", {"dropped": "twice"})
        writer.diagnostics().write(EPOCH_NS, [status])
    assert check_session(path).sources == ()


# -- what is shown while recording -------------------------------------------------------------


def test_rates_ages_and_gaps_are_those_of_the_last_seconds(tmp_path):
    health = LiveHealth(ROBOT)
    with judged(tmp_path / "s.mcap", health) as writer:
        states = writer.joint_state("/joint_states", NAMES, unit="rad")
        sonar = writer.string("/gait/mode")
        bus = writer.frames("/can/can0")
        for tick in range(2001):
            t_ns = EPOCH_NS + tick * STEP_NS
            if tick % 200 == 0:
                sonar.write(t_ns, "walk")
            if tick < 1500 or tick % 2 == 0:  # half of the rate in the last quarter
                states.write(t_ns, np.sin(0.1 * tick + np.arange(25)))
            frames = empty_frames(8)
            frames["t_host_ns"], frames["dlc"] = t_ns + np.arange(8), 8
            bus.write(t_ns, frames)
            if tick % 100 == 0:
                health.update(t_ns)
        topics = {topic.topic: topic for topic in health.topics()}
        states = topics["/joint_states"]
        assert (states.count, states.gaps, states.dropped) == (1751, 250, 0)
        assert states.rate_hz == pytest.approx(50.0)
        assert topics["/gait/mode"].gaps is None
        assert topics["/can/can0"].rate_hz == pytest.approx(100.0)
        health.update(EPOCH_NS + 23 * NS)
        topics = {topic.topic: topic for topic in health.topics()}
        assert topics["/joint_states"].age_s == pytest.approx(3.0)
        assert topics["/joint_states"].rate_hz < 50.0


def test_the_frame_rate_of_a_source_is_that_of_the_last_seconds():
    health = LiveHealth(None)
    counts = SourceCounts()
    source = SimpleNamespace(name="can0", robot=None, counts=counts, connected=True, finished=False)
    rates = []
    for second in range(20):
        health.update(EPOCH_NS + second * NS)
        rates.append(health.source(source, "can:socketcan:can0", None).rate_hz)
        counts.frames += 800 if second < 10 else 400
    assert rates[0] is None
    assert rates[1:11] == [800.0] * 10
    assert rates[-1] == 400.0


def test_stepping_looks_at_one_channel_a_tick_and_loses_none(tmp_path):
    health = LiveHealth(None)
    with judged(tmp_path / "s.mcap", health) as writer:
        channels = [writer.string(f"/text/{k}") for k in range(5)]
        for tick in range(1000):
            t_ns = EPOCH_NS + tick * 5_000_000
            for channel in channels:
                channel.write(t_ns, "walk")
            health.step(t_ns)
        seen = [600 <= topic.count < 1000 for topic in health.topics()]
        assert seen == [True] * 5  # up to the last whole round
        assert [channel.count for channel in health.final().channels] == [1000] * 5


# -- bounded memory ----------------------------------------------------------------------------


def longest(flags):
    """Longest run of true flags and where the first such begins."""
    best, start = (0, 0), 0
    for flag, run in itertools.groupby(flags):
        count = len(list(run))
        if flag and count > best[0]:
            best = (count, start)
        start += count
    return best


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=300), st.data())
@settings(max_examples=60, deadline=None)
def test_a_freeze_is_the_same_whether_seconds_are_forgotten_or_kept(seconds, data):
    """Joint a stands in the seconds that are flagged first, its command moves in the others."""
    measured, command = RangeTally(horizon_s=5), RangeTally(horizon_s=5)
    freeze = FreezeTally(("b", "a"), ("a", "x"))
    within = np.arange(6) * 150_000_000
    frozen = None
    for second, (stands, moves) in enumerate(seconds):
        t_ns = EPOCH_NS + second * NS + within
        angles = np.column_stack([np.linspace(0, 1, 6), np.linspace(0, not stands, 6)])
        commands = np.column_stack([np.linspace(0, 0.2 * moves, 6), np.zeros(6)])
        for tally, values in ((measured, angles), (command, commands)):
            tally.add(t_ns, values)
        if data.draw(st.booleans()):
            closed = min(measured.closed, command.closed)
            frozen = freeze.result(measured.result(2), command.result(2), closed)
            for tally in (measured, command):
                tally.forget(closed)
                assert len(tally.result(2).second) <= 6
    frozen = freeze.result(measured.result(2), command.result(2), None)
    lasted, since = longest([stands and moves for stands, moves in seconds])
    assert freeze.columns == (1,)
    assert frozen[0].tolist() == [lasted]
    assert frozen[1].tolist() == [EPOCH_NS // NS + since if lasted else 0]


@pytest.mark.nightly
def test_a_day_takes_no_more_memory_than_ten_minutes(tmp_path):
    """What is kept is counted after 10 and after 60 minutes of a slow recording."""

    def kept():
        gc.collect()
        seen, stack, total = set(), [health], 0
        while stack:
            part = stack.pop()
            if id(part) in seen or isinstance(part, type):
                continue
            seen.add(id(part))
            total += sys.getsizeof(part)
            stack += [other for other in gc.get_referents(part) if not callable(other)]
        return total

    health = LiveHealth(ROBOT)
    sizes = []
    with judged(tmp_path / "s.mcap", health) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES, unit="rad")
        bus, log, diagnostics = writer.frames("/can/can0"), writer.log(), writer.diagnostics()
        frames = empty_frames(1)
        for second in range(3600):
            t_ns = EPOCH_NS + second * NS
            commands.write(t_ns, np.full(25, 0.1 * (second % 2)))
            states.write(t_ns, np.full(25, 0.1))
            frames["t_host_ns"] = t_ns
            bus.write(t_ns, frames)
            if second % 5 == 0:
                log.write(t_ns, "info", "recorder", f"second {second} of {'x' * (second % 97)}")
                values = {"frames": str(second), "elapsed_s": str(second)}
                diagnostics.write(t_ns, [DiagnosticStatus(OK, "source c", "", "", values)])
            if second % 10 == 9:
                health.update(t_ns)
            if second in (599, 3599):
                sizes.append(kept())
    assert sizes[1] < sizes[0] + 21_845


def test_the_verdict_meanwhile_is_that_of_a_good_recording(tmp_path):
    """Channels are measured in turn; none of them seems to end before the others for that."""
    health = LiveHealth(ROBOT)
    with judged(tmp_path / "s.mcap", health) as writer:
        topics = ["/joint_commands", "/joint_states", "/joint_current", "/joint_voltage", "/gait"]
        channels = [writer.joint_state(topic, NAMES, unit="rad") for topic in topics]
        verdicts = set()
        for tick in range(2000):  # a silence is reported after some seconds
            t_ns = EPOCH_NS + tick * NS // 100
            for channel in channels[: 4 if tick > 1000 else 5]:
                channel.write(t_ns, 0.3 * np.sin(0.05 * tick + np.arange(25)))
            health.step(t_ns)
            if tick == 1000:
                assert verdicts == {("good", ())}
            if tick > 100:
                verdicts.add((health.result().verdict, health.result().reasons))
    text = "; ".join(reason for _, reasons in verdicts for reason in reasons)
    assert "/gait: ends" in text
    assert "/joint" not in text
