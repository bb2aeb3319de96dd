"""The signals of one session, as all parts of its analysis see them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from undulog.capture import SessionView
from undulog.capture.common.console import Warn
from undulog.capture.log.health.rules import judge_made_times
from undulog.capture.robot.model import Robot

from ..common.remarks import Note, Remarks
from ..estimators.series import Series
from .columns import Columns, read_columns
from .stretch import (
    Choice,
    Options,
    choose_stretch,
    fetched_part,
    recorded,
    series_in,
    without_breaks,
)
from .windows import Stretch

_FEW = 1e-3
"""Up to one sample in a thousand left out is a note: no loss for a fit."""


@dataclass
class Signals:
    """Signals of a session in the window that is analysed.

    Attributes:
        session: Where they were read from.
        options: Of the analysis; topics are named.
        columns: Joints and their quantities, over the whole session.
        choice: The window, and those of further gaits.
        recorded: The whole time that has commands and positions, within the options' limits.
        origin_ns: Unix time that the times of all series count from, the window's middle [ns].
        commands: By joint, in the window [rad, s].
        responses: Positions by joint, in the window [rad, s].
        left_out: What is left out beside breaks of the recording, in words; may be empty.
    """

    session: SessionView
    options: Options
    columns: Columns
    choice: Choice
    recorded: Stretch
    origin_ns: int
    commands: Mapping[str, Series] = field(repr=False)
    responses: Mapping[str, Series] = field(repr=False)
    left_out: str

    @property
    def robot(self) -> Robot | None:
        """Its description, or None."""
        return self.session.robot

    @property
    def window(self) -> Stretch:
        """The window that is analysed."""
        return self.choice.stretch

    @property
    def start_ns(self) -> int:
        """Unix time of the session's start [ns]."""
        return self.session.start_ns

    def release(self, *, commands: bool = False) -> None:
        """Give back memory: of the session's samples, and of the commands once no part reads them.

        What one part has looked at need not stay in memory beside the next one's.
        """
        if commands:
            self.commands = {}
        self.session.forget()


def read_signals(session: SessionView, options: Options, remarks: Remarks) -> Signals:
    """Read a session's joints, and choose the window.

    Raises:
        MissingChannelError: If the session has neither commands nor responses.
        DataError: If they hold no samples.
        UsageError: If the options leave nothing of the session.
    """
    session = fetched_part(session, options, remarks)
    columns, options = _read(session, options, remarks)
    for finding in judge_made_times(session.metadata.get("undulog", {})):
        remarks(finding.sentence)
    columns, left_out = without_breaks(session, columns, options, remarks)
    session.forget()
    choice = choose_stretch(session, columns, options, remarks)
    window = choice.stretch
    whole = recorded(session, columns, options)
    origin_ns = window.start_ns + (window.stop_ns - window.start_ns) // 2
    commands = series_in(columns.names, columns.command, window, origin_ns)
    session.forget()
    responses = series_in(columns.names, columns.position, window, origin_ns)
    _warn_dropped(commands, responses, remarks)
    session.forget()
    return Signals(
        session, options, columns, choice, whole, origin_ns, commands, responses, left_out
    )


def _read(session: SessionView, options: Options, warn: Warn) -> tuple[Columns, Options]:
    """Read the joints' columns; the options then name the topics that they are of."""
    columns = read_columns(
        session,
        options.command_topic,
        options.response_topic,
        warn,
        reference_topic=options.reference_topic,
        excitation_topic=options.excitation_topic,
    )
    return columns, dataclasses.replace(
        options,
        command_topic=columns.topics.get("command", options.command_topic),
        response_topic=columns.topics.get("position", options.response_topic),
    )


def _warn_dropped(
    commands: Mapping[str, Series], responses: Mapping[str, Series], warn: Warn
) -> None:
    for kind, series in (("command", commands), ("response", responses)):
        lost = [
            channel
            for channel in series.values()
            if channel.dropped_nan or channel.dropped_duplicates
        ]
        if lost:
            nan = sum(channel.dropped_nan for channel in lost)
            double = sum(channel.dropped_duplicates for channel in lost)
            text = (
                f"left out of the {kind}s: {nan} samples that are not numbers and {double} with a "
                f"time that was there already ({', '.join(channel.name for channel in lost)})"
            )
            few = nan + double <= _FEW * sum(channel.count for channel in series.values())
            warn(Note(text) if few else text)
