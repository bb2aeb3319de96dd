"""Lost samples and late cycles, planted in stamps: each is found as what it is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.checked_sessions import EPOCH_NS, STEP_NS, gait
from undulog.capture import SessionWriter
from undulog.capture.log.health.bus_tally import SourceHealth
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.health.skipped_cycles import with_skipped_cycles
from undulog.capture.log.health.tallies import ChannelHealth, Sequence, SeriesHealth, TimingTally

CYCLES = 6000
GRID = np.arange(CYCLES, dtype=float)
"""Times of an undisturbed sender [periods]."""
SEEDS = range(5)
JITTERS = (0.0, 0.003, 0.02, 0.05, 0.1)
"""Standard deviations of the stamps [periods]; above, the grid can't be seen."""


def timing(periods):
    """Measure stamps [periods]."""
    tally = TimingTally()
    tally.add(EPOCH_NS + np.rint(np.sort(periods) * STEP_NS).astype(np.int64))
    return tally.result()


def jittered(rng, sigma):
    return GRID + rng.normal(0.0, sigma, CYCLES)


def driver(rng, chance, mean, *, skips=False, sleeps=False):
    """Stamps of a control loop that the computer stops now and then for ``mean`` periods.

    It has fixed deadlines and catches up, or skips those that are over, or sleeps a period after
    each cycle, so that every stop shifts all that follows.
    """
    stops = (rng.random(CYCLES) < chance) * rng.exponential(mean, CYCLES)
    stamps, now, cycle = [], 0.0, 0
    for taken in (np.abs(rng.normal(0.0, 0.005, CYCLES)) + stops).tolist():
        now = (now + 1.01 if sleeps else max(now + 0.02, cycle)) + taken
        stamps.append(now)
        cycle = max(cycle + 1, int(now) + 1) if skips else cycle + 1
    return np.array(stamps)


# -- losses ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", JITTERS)
@pytest.mark.parametrize("part", [0.005, 0.05, 0.12])
@pytest.mark.parametrize("seed", SEEDS)
def test_samples_dropped_at_random_are_missing(seed, part, sigma):
    rng = np.random.default_rng(seed)
    stamps = jittered(rng, sigma)[kept := rng.random(CYCLES) >= part]
    dropped = CYCLES - kept.sum()
    assert timing(stamps).missing == pytest.approx(dropped, rel=0.1, abs=2)


@pytest.mark.parametrize("sigma", JITTERS[:-1])
@pytest.mark.parametrize("length", [1, 7, 30])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_single_loss_is_missing(seed, length, sigma):
    stamps = np.delete(jittered(np.random.default_rng(seed), sigma), slice(3000, 3000 + length))
    rhythm = timing(stamps)
    assert (rhythm.gaps, rhythm.late) == (1, 0)
    assert rhythm.missing == length


@pytest.mark.parametrize("loop", [{}, {"sleeps": True}], ids=["catches up", "sleeps"])
@pytest.mark.parametrize(("chance", "mean"), [(0.003, 2.0), (0.01, 10.0), (0.05, 1.0)])
def test_losses_are_found_beside_late_cycles(chance, mean, loop):
    """Where stops shift all that follows, some stand for losses: most often 1.4 times as many."""
    ratios = []
    for seed in range(11):
        rng = np.random.default_rng(seed)
        stamps = driver(rng, chance, mean, **loop)[kept := rng.random(CYCLES) >= 0.05]
        rhythm = timing(stamps)
        assert rhythm.missing_part > 0.03
        ratios.append(rhythm.missing / (CYCLES - kept.sum()))
    assert min(ratios) > 0.8
    assert np.median(ratios) < 1.6
    assert max(ratios) < 2.0


# -- late cycles ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "loop", [{}, {"skips": True}, {"sleeps": True}], ids=["catches up", "skips", "sleeps"]
)
@pytest.mark.parametrize(("chance", "mean"), [(0.003, 2.0), (0.01, 1.0), (0.01, 10.0), (0.1, 1.0)])
def test_late_cycles_are_not_missing(chance, mean, loop):
    called_lost = 0
    for seed in range(20):
        rhythm = timing(driver(np.random.default_rng(seed), chance, mean, **loop))
        assert rhythm.late + rhythm.missing >= rhythm.gaps > 0
        called_lost += rhythm.missing > 0
    assert called_lost <= 3, "chance puts more gaps on the grid in one of twenty"


def test_jitter_is_no_loss():
    for seed in SEEDS:
        rhythm = timing(jittered(np.random.default_rng(seed), 0.2))
        assert (rhythm.missing, rhythm.late) == (0, rhythm.gaps)
        assert rhythm.gaps > 100


@pytest.mark.parametrize("length", [50, 200])
def test_a_stall_followed_by_a_burst_is_no_loss(length):
    stamps = GRID.copy()
    stamps[3000 : 3000 + length] = 2999.7 + length + 0.003 * np.arange(length)
    rhythm = timing(stamps)
    assert (rhythm.gaps, rhythm.late, rhythm.missing) == (1, 1, 0)


def test_a_burst_within_one_stamp_is_no_loss():
    stamps = GRID.copy()
    for start in range(500, CYCLES, 500):
        stamps[start : start + 12] = start + 11  # on the grid, as the cycle of a robot takes them
    rhythm = timing(stamps)
    assert (rhythm.gaps, rhythm.late, rhythm.missing) == (11, 11, 0)
    assert rhythm.duplicates == 11 * 11


@pytest.mark.parametrize("length", [5.4, 50.37, 200.37])
def test_a_stall_that_shifts_what_follows_is_no_loss(length):
    rhythm = timing(np.where(GRID < 3000, GRID, GRID + length))
    assert (rhythm.gaps, rhythm.late, rhythm.missing) == (1, 1, 0)


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 400), max_size=4))
def test_blocks_don_t_change_a_cause(seed, cuts):
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(
        rng.choice([1.0, 1.001, 2.0, 2.5, 31.37], 400, p=[0.6, 0.2, 0.1, 0.05, 0.05])
    )
    whole, parts = TimingTally(), TimingTally()
    t_ns = EPOCH_NS + np.rint(stamps * STEP_NS).astype(np.int64)
    whole.add(t_ns)
    for part in np.split(t_ns, sorted(cuts)):
        parts.add(part)
    first, second = whole.result(), parts.result()
    assert (first.late, first.missing, first.scattered) == (
        second.late,
        second.missing,
        second.scattered,
    )


# -- a session ------------------------------------------------------------------------------------


def session(path, stamps):
    """A session of one joint whose commands and answers have given stamps [periods]."""
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        topics = [writer.joint_state(f"/joint_{name}", ["a"], unit="rad") for name in KINDS]
        for periods in stamps:
            t_ns = EPOCH_NS + round(periods * STEP_NS)
            for topic in topics:
                topic.write(t_ns, gait(periods)[:1])
    return path


KINDS = ("commands", "states")


def test_a_controller_that_is_late_in_a_tenth_of_its_cycles_is_not_bad(tmp_path):
    stamps = driver(np.random.default_rng(1), 0.2, 1.0, sleeps=True)[:2000]
    health = check_session(session(tmp_path / "s.mcap", stamps))
    assert health.verdict != "bad"
    assert not any("missing" in finding.sentence for finding in health.findings)
    (late,) = [
        finding.sentence for finding in health.findings if "late command cycles" in finding.sentence
    ]
    assert late.startswith("/joint_commands (a) and /joint_states (a), late together: at most ")
    assert "none lost in them" in late


def test_a_tenth_dropped_from_the_same_topic_is_bad(tmp_path):
    rng = np.random.default_rng(1)
    stamps = GRID[:2000][rng.random(2000) >= 0.13]
    health = check_session(session(tmp_path / "s.mcap", stamps))
    assert health.verdict == "bad"
    assert "samples missing" in health.reasons[0]


# -- whole cycles left out ------------------------------------------------------------------------


def series(topic, stamps):
    return SeriesHealth(topic, "sensor_msgs/msg/JointState", ("a",), timing(stamps), 0, 0, 0, 0)


def channel(topic, *sequence):
    return ChannelHealth(topic, "sensor_msgs/msg/JointState", CYCLES, 0, Sequence(*sequence))


SOURCE = {"dropped": 0, "malformed": 0, "reconnects": 0}


@pytest.mark.parametrize(
    ("counters", "sequence", "proved"),
    [
        ([SOURCE], 0, True),
        ([SOURCE, SOURCE], 0, True),
        ([], 0, False),
        ([SOURCE], None, False),
        ([SOURCE], 2, False),
        ([SOURCE | {"dropped": 3}], 0, False),
        ([SOURCE | {"dropped": None}], 0, False),
        ([SOURCE, SOURCE | {"dropped": None}], 0, False),
        ([SOURCE | {"malformed": 1}], 0, False),
        ([SOURCE | {"reconnects": 1}], 0, False),
    ],
)
def test_only_counters_that_exclude_a_loss_make_a_skipped_cycle(counters, sequence, proved):
    stamps = np.delete(GRID, [700, 701, 702, 900])
    other = np.delete(GRID, [2000, 2001, 2002, 4000])
    every = [
        series("/joint_commands", stamps),
        series("/joint_states", stamps + 0.3),
        series("/joint_current", other),
    ]
    channels = [
        channel("/joint_commands", "counted", sequence, 0),
        channel("/joint_states", "none", None, None),
    ]
    sources = [SourceHealth(f"can{k}", 9, **counter) for k, counter in enumerate(counters)]
    all_series = with_skipped_cycles(every, channels, sources, "/joint_commands")
    missing = [series.timing.missing for series in all_series]
    assert missing == ([0, 0, 4] if proved else [4, 4, 4])


def test_losses_of_a_session_s_states_stay_losses_beside_whole_commands():
    commands, states = GRID, np.delete(GRID, [700, 900])
    every = [series("/joint_commands", commands), series("/joint_states", states)]
    channels = [channel("/joint_commands", "counted", 0, 0)]
    sources = [SourceHealth("can0", 9, **SOURCE)]
    all_series = with_skipped_cycles(every, channels, sources, "/joint_commands")
    assert [series.timing.missing for series in all_series] == [0, 2]
