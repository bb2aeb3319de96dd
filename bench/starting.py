"""Starting: all help, and a small command, against importing NumPy.

``undulog --help`` and ``undulog COMMAND --help`` may each take twice the processor time of
``python -c 'import numpy'``, and ``undulog log info`` of a small session three times. Each turn
runs all of them and the peer, in turn, in processes of their own, after a first turn that fills the
caches; compiled modules are kept, as an installation has them.

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

HELP, INFO = 2.0, 3.0


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
        commands = {"--help": ["--help"]}
        commands |= {f"{verb} --help": [*verb.split(), "--help"] for verb in undulog.VERBS}
        commands["log info, a small session"] = ["log", "info", str(session)]
        starts = [
            partial(start, *command)
            for words in commands.values()
            for command in (("-m", "undulog", *words), ("-c", "import numpy"))
        ]
        in_turn(1, *starts)  # fills the caches
        took = in_turn(runs, *starts)
    used = [[usage.processor_s for usage in turns] for turns in took]
    peer = f"import of {versions('numpy')}"
    good = [
        compared(f"undulog {name}", mine, theirs, peer, bar=HELP if "--help" in name else INFO)
        for name, mine, theirs in zip(commands, used[::2], used[1::2], strict=True)
    ]
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
