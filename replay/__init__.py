"""See a session: its columns as a Rerun recording, and the viewer that shows it.

::

    from pathlib import Path
    from capture import Session
    from replay import write_recording

    with Session.open("run.mcap") as session:
        recording = write_recording(session, Path("run.rrd"))
        print(recording.recording_id, recording.warnings)

Names are imported when first used, so that ``import replay`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .content import Content
    from .rrd import Recording, write_recording

__all__ = ["Content", "Recording", "write_recording"]

_HOMES = {"Content": "content", "Recording": "rrd", "write_recording": "rrd"}


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
