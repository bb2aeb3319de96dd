"""Where the cases of all parts run: whole files, empty folders, a place for failing cases."""

import gc
import shlex
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

from .bags import bag_bases
from .base import make_bases
from .binary import binary_bases
from .case import run_command
from .commands import COMMANDS
from .foreign import foreign_bases
from .fuzz import Case, warm

WHOLE = {
    "log", "trace", "scenario", "robot", "columns", "apart", "arrays", "dataset", "serial",
    "feetech line", "dynamixel2 line", "bag", "bag file", "binary trace", "database",
}  # fmt: skip
"""Kinds whose command lines end with exit code 0 on whole files."""


class Stage:
    """A folder of the campaign.

    Attributes:
        bases: The whole files.
        failing: Where minimised failing cases go; None to keep none.
    """

    def __init__(self, folder, failing=None):
        """Write the whole files; import what the commands need."""
        self.folder, self.failing = folder, failing
        self._number = 0
        (folder / "bases").mkdir()
        self.bases = make_bases(folder / "bases", self.result_of)
        self.bases += foreign_bases(folder / "bases" / "foreign")
        bags = bag_bases(folder / "bases" / "bags")
        database = next(base for base in bags if base.name == "bare.db3")
        self.bases += bags
        self.bases += binary_bases(folder / "bases" / "binary", database.files["bare.db3"])
        self.warm_failures = self._warm()

    def result_of(self, gait):
        """The JSON of ``undulog analyse`` for a session."""
        output = gait.with_suffix(".json")
        with self.fresh() as folder:
            run_command(["analyse", gait, "--json", "-o", output], folder)
        return output.read_bytes()

    def _warm(self):
        """Run every command line once on whole files, and import here what it imported."""
        cases, seen = [], set()
        firsts = {(base.kind, Path(base.name).suffix): base for base in reversed(self.bases)}
        for (kind, suffix), base in firsts.items():
            files = base.files | {"gait0.mcap": self.files_of("lz4.mcap")["lz4.mcap"]}
            for _, line in COMMANDS[kind]:
                verb = (*line.split()[:2], suffix)
                left_out = "--null" in line or verb[0] in {"predict", "api"} or verb in seen
                if kind in WHOLE and not left_out:
                    seen.add(verb)
                    cases.append(Case(tuple(shlex.split(line.format(file=base.name))), files))
        failures = warm(cases, self.fresh)
        gc.collect()
        gc.freeze()  # forked processes share what is here
        return failures

    @contextmanager
    def fresh(self):
        """Yield an empty folder that is removed afterwards."""
        with tempfile.TemporaryDirectory(prefix="c", dir=self.folder) as name:
            folder = Path(name) / "w"
            folder.mkdir()
            yield folder

    def keep(self, name, case):
        """Store a failing case."""
        if self.failing is not None:
            self.failing.mkdir(parents=True, exist_ok=True)
            (self.failing / f"{name}.json").write_text(case.as_json())

    def files_of(self, name):
        """Return the files of a base."""
        return next(base for base in self.bases if base.name == name and base.kind == "log").files

    def close(self):
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
