"""Choose the time window of a session that is analysed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import NS, IntArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError, UsageError
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC
from undulog.capture.log.read.sample_times import Signal, longest_unbroken

from ..common.remarks import Leading, Note
from ..estimators.series import Series, clean, clean_together
from ..response.groups import find_groups
from ..response.rhythm import MIN_CYCLES, MIN_EXPLAINED
from .columns import QUANTITIES, Columns
from .gait_windows import several_gaits
from .windows import Stretch, covered, long_enough, moving, settled, steady_part, steady_runs

GAIT_TOPIC = "/gait"
_WORTH_IT = 0.1
"""Less than this part of a session after its settling time is not worth leaving the rest out."""
_AROUND_S = 2.0
"""Read on each side of a window that was chosen, so that no sample at its ends is missing."""


@dataclass(frozen=True)
class Options:
    """The user's options.

    Example::

        options = undulog.Options(start_s=1.0, stop_s=5.0)
        result = undulog.analyse("run.mcap", options=options)

    Attributes:
        start_s: Start of what is analysed, from the session's start [s]; None: chosen.
        stop_s: Its end, not included [s]; None: chosen.
        command_topic: Topic of the commands, as :meth:`.SessionView.joint_topics` takes it.
        response_topic: Topic of the responses, likewise.
        reference_topic: JointState topic of a second sensor of the same positions, or None.
        excitation_topic: JointState topic of what the commands follow from outside, or None.
        period_s: Period of a motion without commands [s]; None: found.
    """

    start_s: float | None = None
    stop_s: float | None = None
    command_topic: str = COMMAND_TOPIC
    response_topic: str = RESPONSE_TOPIC
    reference_topic: str | None = None
    excitation_topic: str | None = None
    period_s: float | None = None

    def arguments(self) -> list[str]:
        """Return the command-line arguments for these options, without defaults."""
        arguments: list[str] = []
        for field in fields(self):
            if (value := getattr(self, field.name)) != field.default:
                option = field.name.removesuffix("_s").replace("_", "-")
                arguments += [f"--{option}", str(value)]
        return arguments


SharedTimes = dict[int, tuple[slice, IntArray]]


def part_of(signal: Signal, start_ns: int, stop_ns: int, times: SharedTimes) -> Signal:
    """Return the samples of a signal within a half-open window.

    Args:
        times: Filled with the times of the parts, so that signals which share their times before
            share them afterwards.
    """
    if id(signal.t_ns) not in times:
        inside = slice(*np.searchsorted(signal.t_ns, (start_ns, stop_ns)).tolist())
        times[id(signal.t_ns)] = inside, signal.t_ns[inside]
    inside, t_ns = times[id(signal.t_ns)]
    return Signal(signal.name, signal.unit, t_ns, signal.values[inside])


def series_in(
    names: Iterable[str], signals: Mapping[str, Signal], stretch: Stretch, origin_ns: int
) -> dict[str, Series]:
    """Return the signals of a time window as series.

    Args:
        names: In chain order.
        origin_ns: Unix time that becomes 0 s.
    """
    times: SharedTimes = {}
    parts = {
        name: part_of(signals[name], stretch.start_ns, stretch.stop_ns, times)
        for name in names
        if name in signals
    }
    return clean_together(parts, origin_ns)


def without_breaks(
    session: SessionView, columns: Columns, options: Options, warn: Warn
) -> tuple[Columns, str]:
    """Leave out all but the longest time window without a break, within the options' limits.

    Returns:
        The columns of that window, and a description of what is left out, which may be empty.

    Raises:
        DataError: If there are no samples at all, or commands and responses don't overlap.
    """
    times = [
        signal.t_ns for kind in (columns.command, columns.position) for signal in kind.values()
    ]
    every = longest_unbroken(times)
    if every is None or not every.others:
        return columns, ""
    both = recorded(session, columns, options)
    stretch = longest_unbroken(times, both.start_ns, both.stop_ns)
    if stretch is None:
        return columns, ""
    if stretch.others:
        warn(str(stretch))
    shared: SharedTimes = {}

    def parts_of(signals: Mapping[str, Signal]) -> dict[str, Signal]:
        limits = stretch.start_ns, stretch.last_ns + 1
        return {name: part_of(signal, *limits, shared) for name, signal in signals.items()}

    kept = replace(
        columns,
        **{quantity: parts_of(columns.of(quantity)) for quantity in QUANTITIES},
        excitation=parts_of(columns.excitation),
        powers={topic: parts_of(signals) for topic, signals in columns.powers.items()},
    )
    return kept, str(stretch) if stretch.others else ""


@dataclass(frozen=True)
class Choice:
    """The time window to analyse.

    Attributes:
        stretch: The window; of several gaits the longest one's.
        gaits: Windows of a constant gait in order of time, where there are several.
    """

    stretch: Stretch
    gaits: tuple[Stretch, ...] = ()

    @classmethod
    def longest(cls, gaits: Sequence[Stretch], warn: Warn) -> Choice:
        """Choose the longest of some windows of a constant gait."""
        longest = max(gaits, key=lambda gait: gait.duration_s)
        if len(gaits) == 1:
            return cls(longest)
        rest = sum(gait.duration_s for gait in gaits) - longest.duration_s
        warn(
            f"the gait changes: of {len(gaits)} windows with a constant gait the longest is "
            f"analysed, and joints are compared over all, {rest:.1f} s in the others (choose with "
            "--start and --stop)"
        )
        return cls(longest, tuple(gaits))


def choose_stretch(session: SessionView, columns: Columns, options: Options, warn: Warn) -> Choice:
    """Choose the time window to analyse; a start in the options replaces the settling time.

    Raises:
        DataError: If there are no samples at all.
        UsageError: If the user's limits leave nothing.
    """
    chosen = recorded(session, columns, options)
    if chosen.duration_s <= 0:
        first, last = recorded(session, columns, Options()).since(session.start_ns)
        raise UsageError(
            f"{session.path}: nothing between --start and --stop; it has joint samples from "
            f"{first:.2f} to {last:.2f} s"
        )
    settle_s = (session.settle_s or 0.0) if options.start_s is None else 0.0
    runs = _gait_runs(session, chosen, settle_s, warn)
    if not runs and settle_s > 0:
        runs = _gait_runs(session, chosen, 0.0, warn)
        if runs:
            settle_s = 0.0
            warn(
                f"fewer than {MIN_CYCLES:g} steady cycles are left after the settling time that "
                "the session states: the gait is analysed before it has settled"
            )
    if runs:
        return Choice.longest(runs, warn)
    if GAIT_TOPIC in session.channels:
        warn(
            f"no stretch of {MIN_CYCLES:g} cycles has steady gait parameters: the commands are "
            "analysed as if it were steady"
        )
    later = settled(chosen, session.start_ns, settle_s)
    if _too_short(columns, chosen, later):
        warn(
            Leading(
                f"too short: {later.duration_s:.3g} of {chosen.duration_s:.3g} s are left after "
                f"the settling time of {settle_s:g} s; all of it is analysed, unsettled as it is"
            )
        )
        later = chosen
    stated = settle_s > 0 or GAIT_TOPIC in session.channels
    if not columns.command and not stated and options.start_s is None:
        return Choice(_after_soft_start(columns, later, warn))
    series = _swinging(columns, later)
    span = moving(series)
    if span is None:
        return Choice(later)
    if GAIT_TOPIC not in session.channels and (gaits := _constant(series, span, later)):
        return Choice.longest(gaits, warn)
    return Choice(_in_motion(series, span, later, options, warn, stated=stated))


def _too_short(columns: Columns, chosen: Stretch, later: Stretch) -> bool:
    """Whether what is left after the settling time is next to nothing, or loses the gait."""
    if later.duration_s < _WORTH_IT * chosen.duration_s:
        return True
    return later != chosen and not _has_gait(columns, later) and _has_gait(columns, chosen)


def _has_gait(columns: Columns, stretch: Stretch) -> bool:
    groups = find_groups(_swinging(columns, stretch), stretch.duration_s)
    return groups is not None and groups.explained >= MIN_EXPLAINED


def _swinging(columns: Columns, stretch: Stretch) -> list[Series]:
    """Return the commands of a window, from its start, without joints that turn without end."""
    return [
        clean(name, signal.t_ns, signal.values, stretch.start_ns).between(0.0, stretch.duration_s)
        for name, signal in columns.command.items()
        if name not in columns.turning
    ]


def _constant(
    commands: Sequence[Series], span: tuple[float, float], stretch: Stretch
) -> list[Stretch]:
    """Return the windows of several gaits by what the commands repeat."""
    origin = stretch.start_ns
    return [
        Stretch(origin + round(gait.start_s * NS), origin + round(gait.stop_s * NS))
        for gait in several_gaits(commands, *span)
    ]


def fetched_part(session: SessionView, options: Options, warn: Warn) -> SessionView:
    """Return a view that reads no more of a session on a server than the options leave of it.

    Of a file on this computer all is read: artefacts and cycles are those of the whole session.

    Raises:
        UsageError: If the user's limits leave nothing.
    """
    chosen = options.start_s, options.stop_s
    if not session.is_remote or chosen == (None, None):
        return session
    if (options.start_s or 0.0) >= session.duration_s:
        raise UsageError(
            f"{session.path}: nothing after --start {options.start_s:g}; it lasts "
            f"{session.duration_s:.2f} s"
        )
    warn(Note("only the window was fetched: artefacts and cycles around it are not known"))
    ends = [
        None if t is None else session.start_ns + round((t + side) * NS)
        for t, side in zip(chosen, (-_AROUND_S, _AROUND_S), strict=True)
    ]
    return session.part(*ends)


def recorded(session: SessionView, columns: Columns, options: Options) -> Stretch:
    """Return the overlap of commands and positions, or the window of one, within the limits.

    Raises:
        DataError: If there are no samples at all, or commands and responses don't overlap.
    """
    kinds = (columns.command, columns.position)
    spans = [covered([signal.t_ns for signal in kind.values()]) for kind in kinds]
    covered_spans = [span for span in spans if span is not None]
    if not covered_spans:
        raise DataError(f"{session.path}: the joint topics hold no samples; nothing to analyse")
    both = Stretch(max(s.start_ns for s in covered_spans), min(s.stop_ns for s in covered_spans))
    if both.duration_s <= 0:
        raise DataError(
            f"{session.path}: commands and responses don't overlap in time; their clocks differ"
        )
    chosen_s, first_ns = (options.start_s, options.stop_s), session.start_ns
    return both.intersect(*(None if t is None else first_ns + round(t * NS) for t in chosen_s))


def _gait_runs(session: SessionView, chosen: Stretch, settle_s: float, warn: Warn) -> list[Stretch]:
    """Steady, settled runs of the logged gait with enough cycles; empty if none is known."""
    if GAIT_TOPIC not in session.channels:
        return []
    try:
        logged = session.joints(GAIT_TOPIC)
    except (DataError, LogError) as error:
        warn(f"{GAIT_TOPIC} can't be used to find steady stretches: {error}")
        return []
    omegas = [k for k, name in enumerate(logged.names) if name.endswith(".omega")]
    if not omegas or len({t.size for t in logged.t_ns}) != 1 or not logged.t_ns[0].size:
        warn(f"{GAIT_TOPIC} names no plane's omega: it can't be used to find steady stretches")
        return []
    t_ns, values = logged.t_ns[0], np.stack(logged.values, axis=-1)
    start_ns = session.start_ns
    fastest = float(np.nanmax(np.abs(values[:, omegas]), initial=0.0)) / (2 * math.pi)
    if fastest <= 0:
        return []
    for ignore in ((), ("offset",)):
        stretches: list[Stretch] = []
        least_s = (MIN_CYCLES - 1) / fastest  # each run's own frequency decides below
        for run in steady_runs(t_ns, logged.names, values, ignore, least_s=least_s):
            part = settled(run, start_ns, settle_s)
            part = part.intersect(chosen.start_ns, chosen.stop_ns)
            row = int(np.searchsorted(t_ns, run.start_ns))
            frequency = max(abs(float(values[row, k])) for k in omegas) / (2 * math.pi)
            if long_enough(part.duration_s, frequency):
                stretches.append(part)
        if stretches:
            if ignore:
                warn("the gait's offset changes within the analysed stretch: the robot steers")
            return stretches
    return []


def _in_motion(
    series: Sequence[Series],
    span: tuple[float, float],
    stretch: Stretch,
    options: Options,
    warn: Warn,
    *,
    stated: bool,
) -> Stretch:
    """Without standing still at the ends; without a soft start where the session states none."""
    origin = stretch.start_ns
    if not stated:
        soft = span
        span = steady_part([channel.between(span[0], span[1]) for channel in series], *span)
        start_s = span[0] if options.start_s is None else soft[0]
        span = start_s, span[1] if options.stop_s is None else soft[1]
        _warn_soft(soft, span, warn)
    start, stop = (origin + round(time_s * NS) for time_s in span)
    period = max((channel.period_s for channel in series if channel.count > 1), default=0.0)
    # Moving to the last sample: that sample's own interval belongs to it.
    ends = stretch.stop_ns - stop <= 2 * round(period * NS)
    return stretch.intersect(start, None if ends else stop)


def _after_soft_start(columns: Columns, stretch: Stretch, warn: Warn) -> Stretch:
    """Without a soft start of a motion whose commands were not logged."""
    series = [
        clean(name, signal.t_ns, signal.values, stretch.start_ns).between(0.0, stretch.duration_s)
        for name, signal in columns.position.items()
    ]
    start_s, _ = steady_part(series, 0.0, stretch.duration_s)
    if start_s <= 0:
        return stretch
    warn(
        f"soft start: {start_s:.1f} s before the motion has its steady amplitude are left out "
        "(choose with --start)"
    )
    return stretch.intersect(stretch.start_ns + round(start_s * NS), None)


def _warn_soft(motion: tuple[float, float], steady: tuple[float, float], warn: Warn) -> None:
    """Report what is left out by the amplitude of the commands."""
    for kind, when, left_s, option in (
        ("start", "before", steady[0] - motion[0], "--start"),
        ("stop", "after", motion[1] - steady[1], "--stop"),
    ):
        if left_s > 0:
            warn(
                f"soft {kind}: {left_s:.1f} s {when} the commands have their steady amplitude are "
                f"left out (choose with {option})"
            )
