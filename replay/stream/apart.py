"""A session's analysis in a process of its own, which can be ended at any time.

It takes seconds and memory that the picture needs first; once it is done all of that is free.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from undulog.capture import Session

from ..content.layer import Layer

_NICENESS = 10


class Analysing:
    """An analysis that is on its way."""

    def __init__(self, path: Path, topics: tuple[str, str]) -> None:
        """Prepare it.

        Args:
            path: The session.
            topics: JointState topics of its commands and responses.
        """
        self._arguments = [str(path), *topics]
        self._process: subprocess.Popen[bytes] | None = None
        self._answer = tempfile.TemporaryFile()  # noqa: SIM115  closed with the process
        self._said = tempfile.TemporaryFile()  # noqa: SIM115

    def __enter__(self) -> Self:
        """Nothing to do: it is started when there is time for it."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()  # it has nothing to put in order
            self._process.wait()
        self._answer.close()
        self._said.close()

    def start(self) -> None:
        """Start it, unless it has been."""
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603  our own arguments
                # -P: a file of the user's in this folder is not to be taken for one of ours.
                [sys.executable, "-P", "-m", __name__, *self._arguments],
                stdin=subprocess.DEVNULL,
                stdout=self._answer,
                stderr=self._said,
                process_group=0,  # a Ctrl-C ends it through us
            )

    @property
    def layer(self) -> Layer | None:
        """What it found; None while it isn't done, and a note where it failed."""
        if self._process is None or self._process.poll() is None:
            return None
        code = self._process.returncode
        if code:
            self._said.seek(0)
            lines = self._said.read().decode(errors="replace").split("\n")
            last = next((line for line in reversed(lines) if line.strip()), "")
            why = f": {last.strip()}" if last else ""
            return Layer(None, notes=(f"not analysed: the analysis ended with {code}{why}",))
        self._answer.seek(0)
        layer: Layer = pickle.load(self._answer)  # noqa: S301  of our own process
        return layer


def main(arguments: Sequence[str]) -> None:
    """Analyse, and write what was found to standard output.

    Args:
        arguments: The session's path, the topics of commands and responses.
    """
    os.nice(_NICENESS)
    from undulog.analysis.signals.stretch import Options

    from ..record.results import computed

    path, command, response = arguments
    options = Options(command_topic=command, response_topic=response)
    folder = Path(tempfile.gettempdir())  # its columns lie there in files without names
    with Session.open(path, column_folder=folder) as session:
        layer = computed(session, options)
    pickle.dump(layer, sys.stdout.buffer)


if __name__ == "__main__":
    main(sys.argv[1:])
