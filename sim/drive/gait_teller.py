"""Telling a running recorder what the controller means: ``/gait`` and ``/gait/mode``.

The recorder answers once a tick of its own, so a thread asks: the control loop only leaves what is
to be told. A recorder that goes, refuses or is slow never holds the loop up.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from undulog.capture.common.errors import ControlError
from undulog.capture.recorder.control_client import ControlClient

from ..gait.contract import GaitTick

_MOST_HELD = 1000
_AT_ONCE = 64
_WAIT_S = 0.02
_LAST_S = 5.0


class GaitTeller:
    """One connection to a recorder's control socket.

    Attributes:
        told: Samples of the gait that the recorder took.
        dropped: Samples that it had no time for.
        error: Why it is told nothing any more; None while it is.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        """Connect.

        Args:
            path: The recorder's control socket.
            names: Names of the gait's values.

        Raises:
            ControlError: If nobody listens there.
        """
        self.told = self.dropped = 0
        self.error: str | None = None
        self._client = ControlClient(path)
        self._names = tuple(names)
        self._mode = ""
        self._held: deque[Mapping[str, Any]] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="undulog-gait", daemon=True)
        self._thread.start()

    def note(self, text: str, level: str = "info") -> None:
        """Leave a remark for ``/rosout``.

        Args:
            text: What to say.
            level: ``info``, ``warn`` or ``error``.
        """
        self._held.append({"do": "note", "text": text, "level": level})

    def tell(self, tick: GaitTick, t_ns: int) -> None:
        """Leave what the gait says, without waiting.

        Args:
            tick: What it says.
            t_ns: From when on it holds [Unix ns].
        """
        if tick.mode != self._mode:
            self._mode = tick.mode
            self._held.append({"do": "mode", "text": tick.mode})
        if not self._names or self.error is not None:
            return
        if len(self._held) >= _MOST_HELD:
            self.dropped += 1
            return
        values: list[float] = tick.values.tolist()
        told = [value if math.isfinite(value) else None for value in values]  # as JSON has it
        named = dict(zip(self._names, told, strict=True))
        self._held.append({"do": "gait", "values": named, "t_ns": t_ns})

    def close(self) -> None:
        """Tell what is left, for a few seconds, and disconnect; safe to call twice."""
        self._ended.set()
        self._thread.join(_LAST_S)
        self._client.close()

    def _run(self) -> None:
        while self.error is None:
            last = self._ended.wait(_WAIT_S)  # looked at before the deque: what is left comes first
            while self._held and self.error is None:
                count = min(len(self._held), _AT_ONCE)
                batch = [self._held.popleft() for _ in range(count)]
                try:
                    self._client.ask_all(batch)
                except ControlError as error:
                    self.error = str(error)
                else:
                    self.told += sum(request["do"] == "gait" for request in batch)
            if last:
                return
