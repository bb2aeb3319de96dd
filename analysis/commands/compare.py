"""Command ``compare``: two sessions, or two groups of them."""

from __future__ import annotations

from collections.abc import Sequence
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import emit_json, progress
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_output, write_text

from .analyse import PAGES, chosen, opened, show

if TYPE_CHECKING:
    from ..results.comparison import Comparison


_EXAMPLE = "e.g. undulog compare before.mcap after.mcap"


def compare(
    *files: Path,
    a: Annotated[list[Path] | None, Parameter(consume_multiple=True)] = None,
    b: Annotated[list[Path] | None, Parameter(consume_multiple=True)] = None,
    paired: bool = False,
    any_gait: bool = False,
    margin_gain: float = 0.02,
    margin_lag_deg: float = 1.0,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    start: float | None = None,
    stop: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    robot: str | None = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Report what differs between two sessions, or two groups of runs, and what is the same.

    Robot and twin, before and after a repair, two surfaces: gain, lag and energy of each joint,
    speed and cost of transport, aligned by the gait's phase; of sessions without commands amplitude
    and phase lag of each joint, frequency and wave. The first line printed is the answer;
    decisions hold for all quantities together (Holm), and so do the intervals.

    Example: `undulog compare --a before1.mcap before2.mcap --b after1.mcap after2.mcap`

    Args:
        files: Session A and session B (MCAP).
        a: Runs of side A, instead of two files.
        b: Runs of side B.
        paired: Run i of B belongs to run i of A.
        any_gait: Compare although the gaits differ; the result notes it.
        margin_gain: Gains and amplitudes that differ by less count as the same, as a share.
        margin_lag_deg: Lags that differ by less count as the same [degrees].
        output: Write the result to this file: a page if its name ends in .html, else .json.
        start: Start of what is analysed, from each session's start [s]; chosen if not given.
        stop: Its end [s].
        topics: Where commands and responses are.
        robot: Description for logs without one, a name or a TOML file.
        force: Replace the output file if it exists.
        json: Print the result as one JSON object.
    """
    sides = _sides(files, a or [], b or [])
    session = chosen(start, stop, topics)
    if not (0 < margin_gain < 1 and 0 < margin_lag_deg < 180):
        raise UsageError("--margin-gain lies between 0 and 1, --margin-lag-deg between 0 and 180")
    if output is not None:
        why = "end its name in .html for a page, in .json for numbers"
        check_output(output, (".json", *PAGES), why, force=force)
    from ..compare.compare import Choices, compare_sessions
    from ..compare.decisions import Margins
    from ..present.text_experiment import render_comparison

    margins = Margins(margin_gain, radians(margin_lag_deg))
    choices = Choices(paired=paired, any_gait=any_gait, margins=margins, session=session)
    with progress("compare", total=sum(map(len, sides))) as bar:
        first = opened(sides[0], bar, robot=robot)
        second = opened(sides[1], bar, len(sides[0]), robot=robot)
        result = compare_sessions(first, second, choices)
    if output is not None:
        _write(result, output)
    if json:
        emit_json(result.to_dict())
        return
    show(lambda width, color: render_comparison(result, width=width, color=color), output)


def _write(result: Comparison, output: Path) -> None:
    """Write the page or the numbers; the file was checked before."""
    if output.suffix.lower() not in PAGES:
        result.save(output, force=True)
        return
    from ..present.page import render

    write_text(output, render(result))


def _sides(
    files: Sequence[Path], a: Sequence[Path], b: Sequence[Path]
) -> tuple[Sequence[Path], Sequence[Path]]:
    if files and (a or b):
        raise UsageError(f"either two files, or --a and --b, not both; {_EXAMPLE}")
    if files and len(files) != 2:
        raise UsageError(
            f"compare takes two sessions, here are {len(files)}; for groups name the sides: "
            "--a A1.mcap A2.mcap --b B1.mcap B2.mcap"
        )
    if not files and not (a and b):
        raise UsageError(f"compare needs sessions on both sides, {_EXAMPLE}")
    return (files[:1], files[1:]) if files else (a, b)
