"""See a session: its columns as a Rerun recording, and the viewer that shows it.

::

    from pathlib import Path
    from undulog.capture import Session
    from undulog.replay import write_recording

    with Session.open("run.mcap") as session:
        recording = write_recording(session, Path("run.rrd"))
        print(recording.recording_id, recording.warnings)

Names are imported when first used, so that ``import undulog.replay`` costs nothing.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from undulog.capture.common.extras import attach

if TYPE_CHECKING:
    from .recording import Recording as Recording
    from .recording import write_recording as write_recording
    from .samples.content import Content as Content

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__,
    {
        "Content": "samples.content",
        "Recording": "recording",
        "write_recording": "recording",
    },
)
