"""LeRobot datasets, v2.1 and v3: an episode a session."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ....common.errors import UsageError
from ..format import DirectReader, DirectWriter, Format

if TYPE_CHECKING:
    from ...import_options import ImportOptions
    from ...reports import ExportReport, ImportReport

_DESCRIPTION = Path("meta", "info.json")
"""The file by which a folder is a dataset."""

_WHAT = "is a LeRobot dataset, which names its columns itself"


def is_lerobot(folder: Path) -> bool:
    """Return whether a folder is a LeRobot dataset."""
    return (folder / _DESCRIPTION).is_file()


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - a folder has none
    return float(is_lerobot(path))


def _read(source: Path, output: Path, options: ImportOptions) -> list[ImportReport]:
    from ...table_guess import parse_units
    from .importing import import_lerobot

    robot, units = options.described(), parse_units(options.units)
    return import_lerobot(
        source, output, episode=options.episode, robot=robot, units=units,
        force=options.force, stop=options.stop,
    )  # fmt: skip


def _write(
    sources: Sequence[Path], output: Path, *, fps: int | None = None, **options: Any
) -> ExportReport:
    from .exporting import export_lerobot

    if fps is None:
        raise UsageError("--to lerobot needs --fps, the frames a second of the dataset")
    return export_lerobot(sources, output, fps=fps, **options)


FORMAT = Format(
    "lerobot", "LeRobot dataset", (), _sniff,
    DirectReader(_read, _WHAT, ("--unit", "--episode"), several=True),
    DirectWriter(_write, "has episodes", ("fps", "task"), several=True),
)  # fmt: skip
