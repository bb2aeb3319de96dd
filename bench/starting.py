"""Starting: all help, and a small command, against importing NumPy.

``undulog --help`` and ``undulog COMMAND --help`` may each take twice the processor time of
``python -c 'import numpy'``, and ``undulog log info`` of a small session three times. Each turn
runs all of them and the peer, in turn, in processes of their own, after a first turn that fills the
caches; compiled modules are kept, as an installation has them.

Run: python bench/starting.py [--runs 5]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from measuring import arguments
from records import compared, versions

import undulog
from undulog.capture import SessionWriter

HELP, INFO = 2.0, 3.0


def processor_s(bytecode: str, *command: str) -> float:
    """Return the processor time of a command, its children included [s].

    Args:
        bytecode: Folder of compiled modules.
        command: Arguments of Python.
    """
    env = os.environ | {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": bytecode}
    child = subprocess.Popen([sys.executable, *command], stdout=subprocess.DEVNULL, env=env)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(command)} ended with exit code {child.returncode}")
    return used.ru_utime + used.ru_stime


def write_session(path: Path) -> None:
    """Write a session of two joints and a second."""
    epoch_ns = 1_700_000_000_000_000_000
    with SessionWriter(path, session_id="starting", epoch_ns=epoch_ns) as writer:
        states = writer.joint_state("/joint_states", ["one", "two"], unit="rad")
        for k in range(100):
            states.write(epoch_ns + k * 10_000_000, [0.01 * k, -0.01 * k])


def main() -> int:
    """Start all in turn, print; return 1 if a bar is missed."""
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=int, default=5)
    runs: int = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "small.mcap"
        bytecode = f"{folder}/bytecode"
        write_session(session)
        commands = {"--help": ["--help"]}
        commands |= {f"{verb} --help": [*verb.split(), "--help"] for verb in undulog.VERBS}
        commands["log info, a small session"] = ["log", "info", str(session)]
        ours: dict[str, list[float]] = {name: [] for name in commands}
        peer: dict[str, list[float]] = {name: [] for name in commands}
        for turn in range(runs + 1):
            for name, words in commands.items():
                mine = processor_s(bytecode, "-m", "undulog", *words)
                theirs = processor_s(bytecode, "-c", "import numpy")
                if turn:
                    ours[name].append(mine)
                    peer[name].append(theirs)
    good = [
        compared(
            f"undulog {name}",
            ours[name],
            peer[name],
            f"import of {versions('numpy')}",
            bar=HELP if name.endswith("--help") else INFO,
        )
        for name in commands
    ]
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
