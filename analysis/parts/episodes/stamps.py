"""Episodes whose own numbers or stamps show that frames are missing, or there twice."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import MISSING, NEGLIGIBLE

from .record import Record
from .result import EpisodeFault

LATE_S = 2e-3
"""Of a step between two stamps: they are rounded to single precision, 0.2 ms in an hour."""


def stamped(record: Record) -> Iterator[EpisodeFault]:
    """Yield what frame numbers and stamps show, at most one fault an episode."""
    steps = np.diff(record.frame).astype(np.float64)
    stamps: FloatArray = steps
    if record.stamps_s is not None:
        stamps = np.diff(record.stamps_s) * record.fps
    slack = LATE_S * record.fps
    for e in range(record.numbers.size):
        rows = slice(int(record.starts[e]), int(record.starts[e + 1]) - 1)
        if rows.stop <= rows.start:
            continue
        fault = _of_episode(int(record.numbers[e]), steps[rows], stamps[rows], record.fps, slack)
        if fault is not None:
            yield fault


def _of_episode(
    number: int, steps: FloatArray, stamps: FloatArray, fps: float, slack: float
) -> EpisodeFault | None:
    for name, values in (("frame numbers", steps), ("stamps", stamps)):
        longest = int(values.argmax())
        if values[longest] > MISSING + slack:
            lost = round(float(np.sum(np.maximum(values - 1, 0))))
            return _frames(number, "dropped", lost, (longest + 1) / fps, f"{name} leave out")
        if values.min() <= 0:
            count = int(np.count_nonzero(values <= 0))
            at_s = (int(values.argmin()) + 1) / fps
            return _frames(number, "doubled", count, at_s, f"{name} repeat")
    step = float(stamps.mean())
    if abs(step - 1) > max(NEGLIGIBLE, slack / stamps.size):
        sentence = f"stamps are {step / fps * 1e3:.4g} ms apart, at {fps:g} Hz {1e3 / fps:.4g} ms"
        return EpisodeFault(number, "rate", None, 1 / step, "", None, None, None, sentence)
    return None


def _frames(number: int, kind: str, count: int, at_s: float, what: str) -> EpisodeFault:
    sentence = f"{what} {count} frame{'s' * (count != 1)}, first at {at_s:.2f} s"
    return EpisodeFault(number, kind, None, float(count), "frames", None, None, at_s, sentence)
