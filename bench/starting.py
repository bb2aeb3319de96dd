"""Starting: all help, a small command and an analysis, against importing NumPy and SciPy.

``undulog --help`` and ``undulog COMMAND --help`` may each take twice the processor time of
``python -c 'import numpy'``, and ``undulog log info`` of a small session three times; ``undulog
analyse`` of 20 s of a snake of 25 joints takes at most five times that of ``import numpy,
scipy.signal``. Each turn runs all of them and the peer, in turn, in processes of their own, after a
first turn that fills the caches; compiled modules are kept, as an installation has them.

Run: python bench/starting.py [--runs 5]
"""

from __future__ import annotations

import os
import sys
import tempfile
from functools import partial
from pathlib import Path

from measuring import arguments, command_took, in_turn
from records import compared, versions

import undulog
from undulog.capture import SessionWriter

HELP, INFO, ANALYSIS = 2.0, 3.0, 5.0
NUMPY, SCIPY = "import numpy", "import numpy, scipy.signal"


def write_session(path: Path) -> None:
    """Write a session of two joints and a second."""
    epoch_ns = 1_700_000_000_000_000_000
    with SessionWriter(path, session_id="starting", epoch_ns=epoch_ns) as writer:
        states = writer.joint_state("/joint_states", ["one", "two"], unit="rad")
        for k in range(100):
            states.write(epoch_ns + k * 10_000_000, [0.01 * k, -0.01 * k])


def main() -> int:
    """Start all in turn, print; return 1 if a bar is missed."""
    runs: int = arguments(__doc__, runs=5).parse_args().runs
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "small.mcap"
        bytecode = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": f"{folder}/bytecode"}
        start = partial(command_took, sys.executable, env=os.environ | bytecode)
        write_session(session)
        snake = Path(folder) / "snake.mcap"
        undulog.record("weak-servo-pi3", snake, duration_s=20.0)
        cases = [("--help", ["--help"], NUMPY, HELP)]
        cases += [
            (f"{verb} --help", [*verb.split(), "--help"], NUMPY, HELP) for verb in undulog.VERBS
        ]
        cases += [
            ("log info, a small session", ["log", "info", str(session)], NUMPY, INFO),
            ("analyse, 20 s of 25 joints", ["analyse", str(snake)], SCIPY, ANALYSIS),
        ]
        starts = [
            partial(start, *command)
            for _, words, peer, _ in cases
            for command in (("-m", "undulog", *words), ("-c", peer))
        ]
        in_turn(1, *starts)  # fills the caches
        took = in_turn(runs, *starts)
    used = [[usage.processor_s for usage in turns] for turns in took]
    peers = {NUMPY: versions("numpy"), SCIPY: versions("numpy", "scipy")}
    good = [
        compared(f"undulog {name}", mine, theirs, f"import of {peers[peer]}", bar=bar)
        for (name, _, peer, bar), mine, theirs in zip(cases, used[::2], used[1::2], strict=True)
    ]
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
