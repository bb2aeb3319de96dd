"""What a log says of its session: files, robot, run, verdict, metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ...robot.model import Robot
from ...robot.run import Run
from .open_log import OpenLog


class SessionFacts:
    """The facts of a session, which hold for each of its views."""

    def __init__(self, log: OpenLog) -> None:
        """Take the facts of a log."""
        self._log = log

    @property
    def path(self) -> Path:
        """The file, or the folder of a split session."""
        return self._log.path

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are read, in order: one, or the parts of a split session."""
        return tuple(file.path for file in self._log.file.files)

    @property
    def is_remote(self) -> bool:
        """Whether it is on a server, so that each read costs time."""
        return any(file.remote is not None for file in self._log.file.files)

    @property
    def size(self) -> int:
        """Size of the files [byte]."""
        return self._log.file.size

    def fingerprint(self) -> str:
        """Return the SHA-256 of the files; of those on a server, their ETags."""
        return self._log.file.fingerprint()

    @property
    def warnings(self) -> list[str]:
        """Missing or doubtful parts, one sentence each; grows while columns are read."""
        return list(self._log.warnings)

    @property
    def chunk_times_ns(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
        """First and last log time stated in each chunk [Unix ns], shape (n,) each."""
        return self._log.file.spans

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The file's metadata records; ``undulog`` holds session id, epoch and versions."""
        return MappingProxyType(self._log.file.metadata)

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """Attached files, e.g. ``robot.toml``, by name."""
        stored = self._log.file.attachments
        return MappingProxyType({name: item.data for name, item in stored.items()})

    @property
    def session_id(self) -> str:
        """The session's id; the file's name if it has none."""
        return self._log.file.metadata.get("undulog", {}).get("session_id") or self.path.stem

    @property
    def settle_s(self) -> float | None:
        """Settling time to leave out of a steady-state analysis [s]; None if not stated."""
        stated = self._log.file.metadata.get("undulog", {}).get("settle_s", "")
        try:
            seconds = float(stated)
        except ValueError:
            return None
        return seconds if 0.0 <= seconds < math.inf else None

    @property
    def robot(self) -> Robot | None:
        """The robot whose description is attached, or None."""
        return self._log.robot

    @property
    def robot_given(self) -> str | None:
        """Name or file of the robot that was given for a log without one; None otherwise."""
        given = self._log.robot_given
        return None if given is None else given[0]

    @property
    def run(self) -> Run | None:
        """Servos, contact and physics rate of a twin's run; None for other sessions."""
        return self._log.run

    @property
    def robot_as_run(self) -> Robot | None:
        """The robot with the servos and masses of a twin's run; else as described."""
        if self.robot is None or self.run is None:
            return self.robot
        return self.robot.with_modules(self.run.servo_of, self.run.mass_factor)

    @property
    def verdict(self) -> str | None:
        """The recorder's final health verdict, or None."""
        return self._log.file.metadata.get("undulog.health", {}).get("verdict")

    @property
    def library(self) -> str:
        """The library that wrote the file."""
        return self._log.file.library

    @property
    def profile(self) -> str:
        """The MCAP profile, ``ros2`` for a log of the log contract."""
        return self._log.file.profile
