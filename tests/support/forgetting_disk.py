"""A disk that forgets what wasn't synced when the power is lost; see ``forgetting_disk.c``.

A child process uses it and is killed or ends; what a computer finds after that is rebuilt from the
copies that the preloaded library made at each sync::

    with Programs("from pathlib import Path") as programs:
        disk = ForgettingDisk(tmp_path, programs)
        disk.run(PROGRAM, disk.root / "run.mcap")
        for loss in Loss:
            found = disk.after(loss) / "run.mcap"
"""

import atexit
import enum
import functools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from support.paths import ROOT

SOURCE = Path(__file__).with_suffix(".c")
KINDS = ("data", "names", "held", "failed")


class Loss(enum.Enum):
    """What a loss of power leaves, the two extremes that POSIX allows."""

    EVERYTHING = "nothing that was not synced survives, neither bytes nor names"
    BYTES = "names and lengths survive; bytes that were not synced are zeros"


@functools.cache
def build():
    """Compile the library once a run; a test fails where there is no compiler."""
    folder = tempfile.mkdtemp(prefix="forgetting-disk-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    library = Path(folder, "forgetting_disk.so")
    compiler = shutil.which("cc") or shutil.which("gcc") or "cc"
    command = [compiler, "-shared", "-fPIC", "-O2", "-o", library, SOURCE]
    subprocess.run(command, check=True)
    return library


# Reads requests, one a line, and answers each with the exit code of a fork that runs its program.
FORKING = """
import json, os, sys, traceback

space = {}
exec(sys.argv[1], space)
for line in sys.stdin:
    request = json.loads(line)
    child = os.fork()
    if child:
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        continue
    code = 1
    try:
        for stream, name in enumerate(request["output"], start=1):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        os.environ.update(request["environment"])
        sys.argv[1:] = request["words"]
        exec(request["program"], space)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)
"""


class Programs:
    """Runs programs of Python below the library, in forks of one process that has imported all."""

    def __init__(self, start):
        """Start that process.

        Args:
            start: A program that imports and defines what the others use.
        """
        environment = {"LD_PRELOAD": str(build()), "PYTHONPATH": str(ROOT / "tests")}
        self._process = subprocess.Popen(
            [sys.executable, "-c", FORKING, start],
            env=os.environ | environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.communicate()

    def run(self, program, words, environment, output):
        """Run a program to its end; return its exit code.

        Args:
            output: Files for what it prints and for its errors.
        """
        request = {"program": program, "words": list(map(str, words)), "environment": environment}
        request |= {"output": list(map(str, output))}
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return int(self._process.stdout.readline())


class ForgettingDisk:
    """A folder whose files are on the disk as far as they were synced.

    Attributes:
        root: The folder; a program that :meth:`run` starts writes there.
    """

    def __init__(self, place, programs):
        """Make an empty disk in a folder, which :class:`Programs` use."""
        self._place, self._programs = place, programs
        self.root = place / "disk"
        self._shadow = place / "shadow"
        self.root.mkdir(parents=True)
        for kind in KINDS:
            (self._shadow / kind).mkdir(parents=True)
        self.settle()

    def settle(self):
        """Take all that lies there as synced, as before what is tested begins."""
        for folder, folders, files in os.walk(self.root):
            entries = [(name, os.lstat(Path(folder, name)).st_ino) for name in (*folders, *files)]
            rows = [
                f"{'d' if name in folders else 'f'} {inode} {name}\0" for name, inode in entries
            ]
            self._stored("names", Path(folder).stat().st_ino).write_text("".join(rows))
            for name, inode in entries[len(folders) :]:
                shutil.copyfile(Path(folder, name), self._stored("data", inode))
                if not self._stored("held", inode).exists():
                    self._stored("held", inode).hardlink_to(Path(folder, name))

    def run(self, program, *words, code=-9, ends=0, fails=0, name="", room=None):
        """Run a program to its end; return its exit code and the lines that it printed.

        Args:
            code: Its exit code: that of a process that is killed, if not given; None for any.
            ends: Number of the sync at whose begin it is killed.
            fails: Number of the sync that fails.
            name: For both: only syncs of paths that end so are counted.
            room: Bytes that can be written.
        """
        settings = {"ROOT": self.root, "SHADOW": self._shadow, "ENDS": ends, "FAILS": fails}
        settings |= {"NAME": name, "ROOM": "" if room is None else room}
        environment = {f"FORGETTING_DISK_{key}": str(value) for key, value in settings.items()}
        printed, errors = self._place / "printed", self._place / "errors"
        status = self._programs.run(program, words, environment, (printed, errors))
        assert code in (None, status), errors.read_text()
        return status, printed.read_text().splitlines()

    def after(self, loss):
        """Rebuild in a new folder what is there after a loss of power, and return that folder."""
        path = Path(tempfile.mkdtemp(prefix=f"{loss.name.lower()}-", dir=self._place))
        if loss is Loss.EVERYTHING:
            self._rebuild_synced(self.root.stat().st_ino, path)
        else:
            self._rebuild_named(self.root, path)
        return path

    def _stored(self, kind, inode):
        return self._shadow / kind / str(inode)

    def _synced_bytes(self, inode):
        stored = self._stored("data", inode)
        return stored.read_bytes() if stored.exists() else b""

    def _rebuild_synced(self, folder, goal):
        """Rebuild a folder from the names and bytes that were synced."""
        listing = self._stored("names", folder)
        for row in listing.read_text().split("\0")[:-1] if listing.exists() else []:
            kind, inode, name = row.split(" ", 2)
            if kind == "d":
                (goal / name).mkdir()
                self._rebuild_synced(inode, goal / name)
            else:
                (goal / name).write_bytes(self._synced_bytes(inode))

    def _rebuild_named(self, folder, goal):
        """Rebuild a folder as it is, but with the bytes that were synced."""
        for entry in os.scandir(folder):
            if entry.is_dir(follow_symlinks=False):
                (goal / entry.name).mkdir()
                self._rebuild_named(entry.path, goal / entry.name)
            elif entry.is_file(follow_symlinks=False):
                facts = entry.stat()
                synced = self._synced_bytes(facts.st_ino)[: facts.st_size]
                (goal / entry.name).write_bytes(synced.ljust(facts.st_size, b"\0"))
