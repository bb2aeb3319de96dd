"""What a session says of the computer that recorded it, and the room left on its disk."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Mapping
from pathlib import Path

from ..common.errors import LogWriteError


def machine_facts() -> Mapping[str, str]:
    """Host, kernel and versions, for the session's metadata."""
    system = platform.uname()
    return {
        "host": system.node,
        "kernel": f"{system.system} {system.release} {system.machine}",
        "python": platform.python_version(),
    }


def free_space(path: Path) -> int:
    """Bytes that are free for us where a file is.

    Args:
        path: The file, which need not be there yet.

    Returns:
        Free bytes.

    Raises:
        LogWriteError: If the folder can't be asked.
    """
    try:
        return shutil.disk_usage(path.parent).free
    except OSError as error:
        raise LogWriteError(
            path, f"its folder can't be used: {os.strerror(error.errno or 0)}"
        ) from error
