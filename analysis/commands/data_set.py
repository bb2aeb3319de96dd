"""What ``analyse`` does with a data set for learning: a table of its episodes."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING

from undulog.capture.common.console import (
    TerminalColumn,
    echo,
    emit_json,
    output_width,
    progress,
    table,
)
from undulog.capture.common.files import check_output, write_text

if TYPE_CHECKING:
    from ..parts.episodes.result import EpisodesResult

READING = 0.5
"""Part of the progress that reading is."""


def is_data_set(path: Path) -> bool:
    """Return whether a path is the folder of a LeRobot data set."""
    if not path.is_dir():
        return False
    from undulog.capture.exchange.formats.lerobot.format import is_lerobot

    return is_lerobot(path)


def analyse_data_set(folder: Path) -> EpisodesResult:
    """Read a data set and compare its episodes, with the progress on stderr.

    Raises:
        ImportFormatError: If it is damaged.
        MissingExtraError: If pyarrow is not installed.
    """
    from undulog.capture.exchange.formats.lerobot.frames import read_frames
    from undulog.capture.exchange.formats.lerobot.importing import open_lerobot

    from ..parts.episodes.measure import measure_episodes
    from ..parts.episodes.record import Record

    dataset = open_lerobot(folder)
    files = max(len(dataset.files()), 1)
    with progress("analyse", total=1.0) as bar:
        frames = read_frames(dataset, lambda done, name: bar.update(READING * done / files, name))
        record = Record(
            frames.names, dataset.fps, frames.numbers, frames.starts, frames.commands,
            frames.states, frames.frame, frames.stamps_s,
        )  # fmt: skip
        count = max(frames.numbers.size, 1)
        return measure_episodes(
            record,
            folder.resolve().name,
            lambda done: bar.update(READING + (1 - READING) * done / count, f"{done} episodes"),
        )


def check_result_file(output: Path | None, *, force: bool) -> None:
    """Check the path of a result before any work is done.

    Raises:
        OutputExistsError: If it is there and ``force`` is not given.
        UsageError: If its name doesn't end in .json.
    """
    if output is not None:
        why = "the result file is JSON; end its name in .json (a page is made by undulog report)"
        check_output(output, (".json",), why, force=force)


def show_data_set(
    folder: Path, output: Path | None, csv: Path | None, *, force: bool, as_json: bool
) -> int:
    """Print the table of a data set, and write it to files."""
    check_result_file(output, force=force)
    if csv is not None:
        check_output(csv, (".csv",), "the table of episodes is one CSV file", force=force)
    result = analyse_data_set(folder)
    facts = result.to_dict()
    if output is not None:
        write_text(output, dumps(facts, indent=2, allow_nan=False) + "\n")
    if csv is not None:
        from pandas import DataFrame

        from ..parts.episodes.show import table_of
        from ..present.data_frames import write_frame

        write_frame(DataFrame(table_of(result)), csv)
    if as_json:
        emit_json(facts)
        return 0
    print_table(result)
    return 0


def print_table(result: EpisodesResult) -> None:
    """Print the worst episodes, what is to be left out, and what can't be seen."""
    from ..parts.episodes.show import COLUMNS, closing, heading, rows_of

    echo(heading(result))
    rows = [[(cell, "") for cell in row] for row in rows_of(result)]
    if rows:
        columns = [TerminalColumn(title, left=title != "times the limit") for title in COLUMNS]
        lines, _ = table(columns, rows, output_width(), cropped=True)
        echo(*(line.plain for line in lines))
    echo(*closing(result))
