"""Gain, lag and power of each joint in each cycle of a gait, computed and drawn as it is recorded.

The estimator is the analysis's own (:mod:`.analysis.estimators.demodulation`), on cycles that
start where its do: half a turn after the logged phase began to run evenly. It looks half a cycle to
either side, so a cycle is known half a cycle after its end.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from undulog.analysis.estimators.demodulation import DRIVEN_SHARE, LoggedPhase, demodulate, weigh
from undulog.analysis.estimators.series import Series, clean
from undulog.analysis.parts.over_time.measure import LoggedGait
from undulog.analysis.session.cycle_maps import LEAST_COVERED
from undulog.analysis.signals.columns import planes_of
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot

from ..draw.heat_maps import POWER
from ..draw.plots import Plot
from ..draw.steps import CYCLES, SEGMENTS
from ..samples.content import GAIN, LAG, Chart, Color, CycleQuantity
from ..samples.content import PlottedSeries as Lines
from ..samples.quantities import GAIT, products, refined
from ..samples.timeline import SESSION_TIME, TimeColumns
from ..samples.tracks import Track, one_after_another
from .decode import PATIENCE_NS, SampleBatch

KEPT_S = 60.0
"""A cycle and its surroundings that last longer than this are not computed [s]."""

_TURN = 2.0 * np.pi
_ROUNDING_RAD = 1e-6
_MARGIN_NS = 100_000_000
_BEYOND = 2  # samples of the phase beyond a cycle's surroundings that are waited for
_KEYS = (
    ("/joint_commands", "position"),
    ("/joint_states", "position"),
    ("/joint_states", "velocity"),
    ("/joint_states", "effort"),
)
_COMMAND, _POSITION, _VELOCITY, _EFFORT = _KEYS

_WIDTH = 0.8


@dataclass(frozen=True)
class Cycle:
    """What m joints did in one cycle.

    Attributes:
        start_ns: Its start [Unix ns].
        stop_ns: Its end [Unix ns].
        names: The joints, head to tail.
        gain: Response over command, NaN where it can't be computed, shape (m,).
        lag_rad: Positive where the response is late [rad], shape (m,).
        power_w: Mean mechanical power [W], NaN where it isn't known, shape (m,).
    """

    start_ns: int
    stop_ns: int
    names: tuple[str, ...]
    gain: FloatArray
    lag_rad: FloatArray
    power_w: FloatArray


class CycleMeter:
    """Computes each cycle once its surroundings have come."""

    def __init__(self, origin_ns: int) -> None:
        """Know nothing yet.

        Args:
            origin_ns: Unix time from which seconds are counted [ns].
        """
        self._origin_ns = origin_ns
        # Of each joint the batches of the last minute.
        self._stores: dict[tuple[str, str], dict[str, list[Track]]] = {key: {} for key in _KEYS}
        self._gait_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._gait: dict[str, FloatArray] = {}
        # Phase at which the run's first cycle starts, and the number of the next one. Counted, not
        # added up: a sample at a cycle's edge has to be of the same cycle as in the analysis.
        self._next: dict[str, tuple[float, int]] = {}
        self._largest: dict[str, float] = {}  # of each joint's commands
        self._newest_ns = 0

    def add(self, batch: SampleBatch, robot: Robot | None) -> list[Cycle]:
        """Take new samples.

        Args:
            robot: The robot, for the joints' planes; None where it isn't known.

        Returns:
            The cycles that have become known.
        """
        for key, stores in self._stores.items():
            for track in batch.columns.get(key, ()):
                if track.t_ns.size:
                    stores.setdefault(track.name, []).append(track)
                    self._newest_ns = max(self._newest_ns, int(track.t_ns[-1]))
        self._add_gait(batch.columns.get((GAIT, "position"), ()))
        cycles: list[Cycle] = []
        if self._gait_ns.size > 2 and any(name.endswith(".phase") for name in self._gait):
            gait = LoggedGait(self._seconds(self._gait_ns), self._gait)
            first = 0
            for first, stop in gait.runs():
                if first:  # a run of its own, with cycles of its own
                    self._next.clear()
                values = {name: value[first:stop] for name, value in gait.values.items()}
                run = LoggedGait(gait.t_s[first:stop], values)
                over = stop < gait.t_s.size
                cycles += self._finished(run, planes_of(robot), over=over)
            self._cut_gait(first)
        self._forget()
        return cycles

    # -- the gait --------------------------------------------------------------------------

    def _add_gait(self, tracks: Sequence[Track]) -> None:
        """Append what the controller meant; phases run on over a whole turn."""
        if not tracks:
            return
        names = {track.name for track in tracks}
        if self._gait and names != set(self._gait):
            self._gait_ns, self._gait = self._gait_ns[:0], {}
            self._next.clear()
        t_ns = tracks[0].t_ns
        if any(not np.array_equal(track.t_ns, t_ns) for track in tracks):
            return  # torn: what is missing shows as a gap
        later = t_ns > (self._gait_ns[-1] if self._gait_ns.size else -1)
        finite = later & np.isfinite([track.values for track in tracks]).all(axis=0)
        for track in tracks:
            old, new = self._gait.get(track.name, np.zeros(0)), track.values[finite]
            if track.name.endswith(".phase"):
                new = np.unwrap(np.concatenate([old[-1:], new]))[old[-1:].size :]
            self._gait[track.name] = np.concatenate([old, new])
        self._gait_ns = np.concatenate([self._gait_ns, t_ns[finite]])

    def _cut_gait(self, first: int) -> None:
        """Keep the run that goes on, and of it no more than is needed."""
        oldest_ns = int(self._gait_ns[-1]) - round(KEPT_S * 1e9)
        first = max(first, int(np.searchsorted(self._gait_ns, oldest_ns)))
        self._gait_ns = self._gait_ns[first:]
        self._gait = {name: values[first:] for name, values in self._gait.items()}

    def _forget(self) -> None:
        """Let go of samples that no cycle needs any more."""
        oldest_ns = self._newest_ns - round(KEPT_S * 1e9)
        if self._gait_ns.size and self._next:
            needed = [
                self._needed_ns(name, first + _TURN * number)
                for name, (first, number) in self._next.items()
            ]
            oldest_ns = max(oldest_ns, min(needed))
        for stores in self._stores.values():
            for batches in stores.values():
                while batches and int(batches[0].t_ns[-1]) < oldest_ns:
                    batches.pop(0)

    def _needed_ns(self, name: str, start: float) -> int:
        """The time of the first sample that the next cycle needs [ns]."""
        whole = _whole(self._gait[name])
        at = int(np.searchsorted(whole, start - np.pi))
        return int(self._gait_ns[min(at, self._gait_ns.size - 1)]) - _MARGIN_NS

    # -- cycles ----------------------------------------------------------------------------

    def _finished(self, run: LoggedGait, planes: dict[str, str], *, over: bool) -> Iterator[Cycle]:
        """Cycles of one run that are complete and not yet told."""
        joints = [n for n in self._stores[_POSITION] if n in self._stores[_COMMAND]]
        by_phase: dict[str, list[str]] = {}
        for joint in joints:
            phase = run.phase_name(joint, planes.get(joint, ""))
            main = run.phase_name("", planes.get(joint, "")) or phase
            if main is not None:
                by_phase.setdefault(main, []).append(joint)
        for name, group in by_phase.items():
            whole = _whole(run.values[name])
            if not np.all(np.diff(whole) > 0):
                self._next.pop(name, None)
                continue
            first, number = self._next.get(name, (float(whole[0]) + np.pi, 0))
            while first + _TURN * number - np.pi < whole[0] - _ROUNDING_RAD:
                number += 1  # its beginning is let go of already
            while first + _TURN * (number + 1) + np.pi <= whole[-1] + _ROUNDING_RAD:
                start, end = first + _TURN * np.array([number, number + 1])
                at = np.array([start, end, start - np.pi, end + np.pi])
                begin, end, early, late = (float(t) for t in np.interp(at, whole, run.t_s))
                stop = int(np.searchsorted(run.t_s, late)) + _BEYOND
                if stop > run.t_s.size and not over:
                    break
                if not self._ready(float(run.t_s[min(stop, run.t_s.size) - 1]), group):
                    break
                near = slice(max(int(np.searchsorted(run.t_s, early)) - _BEYOND, 0), stop)
                yield self._cycle(run, near, (begin, end), group, planes)
                number += 1
            self._next[name] = first, number

    def _ready(self, until_s: float, joints: Sequence[str]) -> bool:
        """Whether all joints' samples have come up to a time, or won't come any more."""
        ends = [
            int(batches[-1].t_ns[-1]) if batches else 0
            for key in (_COMMAND, _POSITION)
            for batches in (self._stores[key][joint] for joint in joints)
        ]
        known_ns = max(min(ends), self._newest_ns - PATIENCE_NS)
        return (known_ns - self._origin_ns) * 1e-9 >= until_s

    def _cycle(
        self,
        run: LoggedGait,
        near: slice,
        edges: tuple[float, float],
        joints: Sequence[str],
        planes: dict[str, str],
    ) -> Cycle:
        edges_s: FloatArray = np.array(edges)
        gain, lag, power = (np.full(len(joints), np.nan) for _ in range(3))
        for i, joint in enumerate(joints):
            name = run.phase_name(joint, planes.get(joint, "")) or ""
            phase = LoggedPhase(run.t_s[near], _whole(run.values[name])[near])
            command, response = self._series(_COMMAND, joint), self._series(_POSITION, joint)
            if command.count > 1 and response.count > 1 and np.ptp(command.values) > 0.0:
                asked, given = demodulate(command, response, phase, edges_s)
                size = float(np.abs(asked[0]))
                if np.isfinite(size):
                    self._largest[joint] = max(self._largest.get(joint, 0.0), size)
                if size > DRIVEN_SHARE * self._largest.get(joint, np.inf):
                    gain[i], lag[i] = np.abs(given[0] / asked[0]), -np.angle(given[0] / asked[0])
            power[i] = self._power(joint, edges)
        start_ns, stop_ns = (self._origin_ns + round(edge * 1e9) for edge in edges)
        return Cycle(start_ns, stop_ns, tuple(joints), gain, lag, power)

    def _power(self, joint: str, edges: tuple[float, float]) -> float:
        """Mean of torque times velocity [W]; NaN where less than nine tenths of it are known."""
        both = [
            (self._track(key, joint),) for key in (_EFFORT, _VELOCITY) if joint in self._stores[key]
        ]
        power = products(*both) if len(both) == 2 else ()
        if not power:
            return float("nan")
        (track,) = power
        series = clean(joint, track.t_ns, track.values, self._origin_ns).between(*edges)
        if series.count < 2:
            return float("nan")
        weighed = weigh(series.t_s, *edges, 1)
        if weighed.coverage < LEAST_COVERED:
            return float("nan")
        return float(np.sum(weighed.weights * series.values)) / (edges[1] - edges[0])

    def _track(self, key: tuple[str, str], joint: str) -> Track:
        nothing = Track(joint, np.zeros(0, dtype=np.int64), np.zeros(0))
        return one_after_another(self._stores[key][joint] or [nothing])

    def _series(self, key: tuple[str, str], joint: str) -> Series:
        track = self._track(key, joint)
        return clean(joint, track.t_ns, track.values, self._origin_ns)

    def _seconds(self, t_ns: IntArray) -> FloatArray:
        return (t_ns - self._origin_ns).astype(np.float64) * 1e-9


def _whole(phase: FloatArray) -> FloatArray:
    """The phase counted upwards, whichever way the gait runs."""
    return phase if phase[-1] >= phase[0] else -phase


class CycleBars:
    """Bars and steps of gain, lag and power.

    The entities are the replay's; here a bar is the newest cycle, and a joint of which the cycle
    has no values has none. Power takes the place of the net energy: its mean over the cycle.
    """

    def __init__(self) -> None:
        """Nothing has been drawn."""
        self._plots: dict[CycleQuantity, Plot] = {}
        self._drawn: set[str] = set()
        self._waiting: deque[tuple[CycleQuantity, Cycle, FloatArray]] = deque()

    @property
    def charts(self) -> tuple[Chart, ...]:
        """The bar charts that have been written to."""
        return tuple(
            Chart(quantity.key, f"{quantity.name} [{quantity.unit}]", ())
            for quantity, _ in self.cycles
        )

    @property
    def cycles(self) -> tuple[tuple[CycleQuantity, tuple[Lines, ...]], ...]:
        """The quantities whose steps have been written, each with where."""
        return tuple(
            (quantity, self._plots[quantity].series)
            for quantity in (GAIN, LAG, POWER)
            if quantity in self._plots
        )

    def take(self, cycle: Cycle) -> None:
        """Take a cycle, to be drawn a quantity at a time, so that no batch is late for it."""
        for quantity, values in (
            (GAIN, 100.0 * (cycle.gain - 1.0)),
            (LAG, np.degrees(cycle.lag_rad)),
            (POWER, 1e3 * cycle.power_w),
        ):
            if quantity in self._plots or np.isfinite(values).any():
                self._waiting.append((quantity, cycle, values))

    def write(
        self,
        rec: rr.RecordingStream,
        clock: TimeColumns,
        palette: Mapping[str, Color],
        *,
        everything: bool = False,
    ) -> None:
        """Draw waiting cycles, at the times at which they started.

        Args:
            palette: Colour by joint name, head to tail.
            everything: Whether to draw all of it rather than one quantity of one cycle.
        """
        while self._waiting:
            quantity, cycle, values = self._waiting.popleft()
            t_ns = np.array([cycle.start_ns], dtype=np.int64)
            tracks = [Track(name, t_ns, values[i : i + 1]) for i, name in enumerate(cycle.names)]
            rec.set_time(
                SESSION_TIME, duration=np.timedelta64(cycle.start_ns - clock.start_ns, "ns")
            )
            self._write_bars(rec, quantity, tracks, palette)
            rec.reset_time()
            before = self._plots.get(quantity)
            drawn = [] if before is None else [series.names for series in before.series]
            plot = Plot(f"{CYCLES}/{quantity.key}", refined(drawn, [cycle.names]))
            plot.style(rec, palette, steps=True)
            plot.write(rec, clock, tracks)
            self._plots[quantity] = plot
            if not everything:
                return

    def _write_bars(
        self,
        rec: rr.RecordingStream,
        quantity: CycleQuantity,
        tracks: Sequence[Track],
        palette: Mapping[str, Color],
    ) -> None:
        place = {name: i + 1 for i, name in enumerate(palette)}
        for track in tracks:
            part = rr.escape_entity_path_part(track.name)
            entity = f"{SEGMENTS}/{quantity.key}/estimate/{part}"
            if np.isfinite(track.values).all():
                left = place[track.name] - _WIDTH / 2
                color = palette[track.name]
                bar = rr.BarChart(track.values, abscissa=[left], widths=[_WIDTH], color=color)
                rec.log(entity, bar)
                self._drawn.add(entity)
            elif entity in self._drawn:
                rec.log(entity, rr.Clear(recursive=False))
                self._drawn.discard(entity)
