"""Clocks that jump once: the longest unbroken stretch is analysed, and the answer says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hostile_logs import gait

from undulog.analysis import Options, analyse_session
from undulog.capture import Session
from undulog.capture.judgement.session import judgement_of_session
from undulog.capture.log.read.sample_times import BREAK_S, longest_unbroken

NS = 1_000_000_000
HOUR = 3600 * NS
DAY = 24 * HOUR


def length(analysis: object) -> float:
    return analysis.gait.fitted.stop_s - analysis.gait.fitted.start_s


@pytest.mark.parametrize("log_too", [False, True])
@pytest.mark.parametrize("jump_ns", [60 * NS, HOUR, DAY, 365 * DAY, -DAY])
def test_the_longest_unbroken_stretch_gives_the_numbers(
    tmp_path: Path, jump_ns: int, log_too: bool
) -> None:
    jumps = {1200: jump_ns}
    path = gait(tmp_path / "run.mcap", jumps=jumps, log_jumps=jumps if log_too else None)
    with Session.open(path) as session:
        analysis = analyse_session(session)
        assert judgement_of_session(session).faults == ()
    assert analysis.gait.frequency_hz.value == pytest.approx(1.0, abs=1e-4)
    for joint in analysis.joints:  # as the file was written
        assert joint.gain.value == pytest.approx(0.9, abs=2e-3)
        assert joint.lag_rad.value == pytest.approx(0.3, abs=2e-3)
        assert joint.coverage == pytest.approx(1.0, abs=1e-2)
    assert length(analysis) == pytest.approx(12.0, abs=0.05)
    shown = "longest unbroken stretch, 12.0 s, is analysed, 1 other stretch of 8.0 s altogether"
    assert shown in analysis.answer.sentence
    assert any(shown in text for text in analysis.warnings)


def test_start_and_stop_choose_another_stretch(tmp_path: Path, opened) -> None:
    path = gait(tmp_path / "run.mcap", jumps={1200: HOUR})
    analysis = analyse_session(opened(path), Options(start_s=3000.0))
    assert length(analysis) == pytest.approx(8.0, abs=0.05)
    assert analysis.joints[0].gain.value == pytest.approx(0.9, abs=2e-3)
    assert not any("unbroken" in text for text in analysis.warnings)
    assert "unbroken" not in analysis.answer.sentence


def test_a_loss_of_some_seconds_breaks_nothing(tmp_path: Path, opened) -> None:
    path = gait(tmp_path / "run.mcap", jumps={1200: 4 * NS})  # four whole cycles
    analysis = analyse_session(opened(path))
    assert "unbroken" not in analysis.answer.sentence
    assert length(analysis) == pytest.approx(24.0, abs=0.05)


def test_every_other_sample_apart_by_years_takes_no_memory(tmp_path: Path, opened) -> None:
    """Clocks that jump to and fro leave stretches of a few samples: no gait, and no grid."""
    jumps = {tick: (9 if tick % 40 else 90 * DAY // NS) * NS for tick in range(0, 2000, 20)}
    analysis = analyse_session(opened(gait(tmp_path / "run.mcap", jumps=jumps)))
    assert analysis.gait.frequency_hz.value is None


def brute(times: list[np.ndarray]) -> tuple[int, int]:
    every = np.unique(np.concatenate(times))
    edges = np.flatnonzero(np.diff(every) > BREAK_S * NS)
    firsts = every[np.concatenate([[0], edges + 1])]
    lasts = every[np.concatenate([edges, [len(every) - 1]])]
    k = int(np.argmax(lasts - firsts))
    return int(firsts[k]), int(lasts[k])


@pytest.mark.parametrize("seed", range(20))
def test_channels_bridge_each_others_gaps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = []
    for _ in range(3):
        step = np.where(rng.random(200) < 0.05, rng.uniform(8, 40, 200), rng.uniform(0.1, 1, 200))
        times.append((np.cumsum(step) * NS).astype(np.int64))
    stretch = longest_unbroken(times)
    assert (stretch.start_ns, stretch.last_ns) == brute(times)


def test_slow_channels_are_not_broken_by_their_own_interval() -> None:
    slow = np.arange(100) * 60 * NS
    stretch = longest_unbroken([slow])
    assert (stretch.start_ns, stretch.last_ns, stretch.others) == (0, int(slow[-1]), 0)
