"""Mutated files through the commands: a seed is a base file, its faults and a command line."""

import base64
import contextlib
import itertools
import json
import random
import re
import shlex
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path

from support.read_back import messages_of

from . import binary
from .bag_faults import BAGS, mutate_folder
from .base import EPOCH_NS, files_below, write_files
from .case import Result, front_door, judge, run_forked
from .commands import COMMANDS, WEIGHTS
from .line import fed
from .mutate import mutate_bytes, mutate_text, remake_database, remake_log
from .structure import STRUCTURE

RECORDS_FOR_S = 12.0
"""A recorder with mutated settings may have been given an hour: it is ended then [s]."""
TEXTS = {".toml", ".yaml", ".dbc", ".csv", ".txt", ".log", ".asc", ".trc", ".json", ".jsonl"}
TEMPORARY = "temporary"
"""Folder of the temporary files of a case, beside its own."""
READING = {"import", "analyse", "report", "view", "compare", "api"}
OUTPUTS = ("new.", "new/", "new-")
FIELDS = ("position", "velocity", "effort")


@dataclass(frozen=True)
class Case:
    """Files and the command line to run on them."""

    words: tuple[str, ...]
    files: dict[str, bytes]
    ended_after_s: float | None = None

    def as_json(self):
        """Return the case as one text, for a file."""
        files = {name: base64.b64encode(data).decode() for name, data in self.files.items()}
        fields = {"words": self.words, "ended_after_s": self.ended_after_s, "files": files}
        return json.dumps(fields, indent=1) + "\n"

    @classmethod
    def from_json(cls, text):
        """Return a case from such a text."""
        fields = json.loads(text)
        files = {name: base64.b64decode(data) for name, data in fields["files"].items()}
        return cls(tuple(fields["words"]), files, fields["ended_after_s"])

    def run(self, folder, modules=None):
        """Write the files to an empty folder and run the command there.

        The names of the imported modules go to the file ``modules``.
        """
        write_files(folder, self.files)
        temporary = folder.parent / TEMPORARY
        temporary.mkdir(exist_ok=True)
        work = front_door(self.words)
        if self.words[0] == "api":
            work = partial(try_session, folder / self.words[1])
        elif "line.bin" in self.files:
            work = partial(fed, work, self.files["line.bin"])

        def listed():
            tempfile.tempdir = str(temporary)
            try:
                work()
            finally:
                if modules is not None:
                    modules.write_text("\n".join(sys.modules))

        return run_forked(listed, folder, end_after_s=self.ended_after_s, end_by=signal.SIGTERM)


def make_case(seed, bases, scratch, part="mutated"):
    """Return the case of a seed of a part of the campaign."""
    rng, weights = random.Random(seed), WEIGHTS[part]
    kind = rng.choices(list(weights), list(weights.values()))[0]
    base = rng.choice([base for base in bases if base.kind == kind])
    lines = COMMANDS[kind]
    line = rng.choices([text for _, text in lines], [weight for weight, _ in lines])[0]
    files = dict(base.files)
    if "gait0.mcap" in line:
        gait = next(base for base in bases if base.name == "gait.mcap")
        files["gait0.mcap"] = gait.files["gait.mcap"]
    names = [rng.choice(base.mutable) for _ in range(rng.choice([1, 1, 1, 2]))]
    for name in dict.fromkeys(names):  # in this order, whatever the hash seed of the process is
        files[name] = _mutated(files[name], Path(name).suffix, rng, scratch, part)
    if kind in {"unfinished", "split"} and rng.random() < 0.1:
        del files[rng.choice(base.mutable)]
    if kind == "bag" and rng.random() < 0.1:
        mutate_folder(files, rng)
    words = shlex.split(line.format(file=base.name))
    if words == ["api"]:
        words.append(base.name)
    ends_itself = words[0] != "record" or "line.bin" in files
    return Case(tuple(words), files, None if ends_itself else RECORDS_FOR_S)


def _mutated(data, suffix, rng, scratch, part):
    structure = BAGS if part == "bags" else STRUCTURE
    if part == "binary":
        structure = binary.structure(scratch, STRUCTURE | BAGS)
    if suffix in structure and rng.random() < 0.6:
        return structure[suffix](data, rng)
    if suffix in TEXTS:
        return mutate_text(data, rng)
    if suffix == ".db" and rng.random() < 0.7:
        return remake_database(data, rng, scratch)
    # What a kill left has no end; it may be empty, or as short as the magic at its beginning.
    if suffix == ".mcap" and rng.random() < 0.6 and data and data[8:].endswith(data[:8]):
        return remake_log(data, rng, scratch)
    return mutate_bytes(data, rng)


def read_session(path):
    """Read all parts of a session; errors of the error tree are answers, too."""
    from undulog.capture import Session
    from undulog.capture.common.errors import UndulogError

    with Session(path) as session:
        for part in session_parts(session):
            try:
                part()
            except UndulogError as error:
                str(error)


def try_session(path):
    """Read a session if it can be opened."""
    from undulog.capture.common.errors import UndulogError

    with contextlib.suppress(UndulogError):
        read_session(path)


def session_parts(session):
    """Yield functions that read one part of a session each."""
    window = {"start_ns": EPOCH_NS + 20_000_000, "stop_ns": EPOCH_NS + 50_000_000}
    yield lambda: session.robot
    yield lambda: (session.session_id, session.verdict, session.metadata)
    yield lambda: session.attachments
    yield lambda: (session.start_ns, session.end_ns, session.duration_s)
    for topic in session.channels:
        yield partial(session.table, topic)
        yield partial(session.table, topic, start_ns=EPOCH_NS + 30_000_000)
        yield lambda t=topic: sum(1 for _ in session.messages(t))
        yield partial(session.frames, topic)
        for name in FIELDS:
            yield partial(session.joints, topic, name)
        yield partial(session.joints, topic, **window)


def check_output(folder):
    """Return faults of the outputs under their final names, by mcap's own reader."""
    damage = []
    names = ("new*.mcap", "new/*.mcap", "frames.mcap")
    for path in itertools.chain.from_iterable(map(folder.glob, names)):
        try:
            messages_of(path)
        except Exception as error:  # noqa: BLE001 - whatever the foreign reader raises
            damage.append(f"output: {path.name} is no whole file: {type(error).__name__}: {error}")
    for path in folder.glob("new*.json"):
        try:
            json.loads(path.read_bytes())
        except ValueError as error:
            damage.append(f"output: {path.name}: {error}")
    return damage


def check_strays(case, folder):
    """Return inputs that a command changed, and files that one that reads put elsewhere."""
    strays = [name for name, data in case.files.items() if (folder / name).read_bytes() != data]
    strays = [f"input: {name} was changed" for name in strays]
    if case.words[0] not in READING:
        return strays
    beside = {f"{folder.name}.out", f"{folder.name}.err", "modules"}
    for name in files_below(folder.parent):
        inner = name.removeprefix(f"{folder.name}/")
        expected = (
            inner in case.files or inner.startswith(OUTPUTS) if inner != name else name in beside
        )
        if not expected and not name.startswith("scratch"):
            strays.append(f"stray: {name} was left")
    return strays


def run_case(case, folder, modules=None):
    """Run a case in an empty folder; return failures and outcome."""
    outcome = case.run(folder, modules)
    strays = [] if outcome.signal else check_strays(case, folder)
    return [*judge(outcome), *check_output(folder), *strays], outcome


def run_seed(seed, bases, folder, part):
    """Make and run the case of a seed of a part, in an empty folder."""
    case = make_case(seed, bases, folder.parent / "scratch", part)
    failures, outcome = run_case(case, folder)
    result = Result(" ".join(case.words), failures)
    result.measure(outcome)
    return result, case


def kind_of(failure):
    """Return the kind of a failure; for a traceback its error and its line of code, too."""
    if failure.startswith("traceback: "):
        error, _, place = failure.removeprefix("traceback: ").rpartition(" [")
        return f"traceback {error.split(':')[0]} {place.rstrip(']')}"
    return re.sub(r"[\d.]+", "N", failure.split(":", maxsplit=1)[0])


def minimise(case, kind, bases, fresh, seconds=40.0):
    """Return a smaller case with the same kind of failure, as far as the time allows.

    Unneeded files are left out, unneeded faults are undone, then parts are cut out by halves.
    """
    deadline = time.monotonic() + seconds
    originals = {(base.name, path): data for base in bases for path, data in base.files.items()}

    def fails(files):
        tried = Case(case.words, files, case.ended_after_s)
        with fresh() as folder:
            return any(kind_of(failure) == kind for failure in run_case(tried, folder)[0])

    files = dict(case.files)
    for name in list(files):
        if time.monotonic() > deadline:
            break
        fewer = {path: data for path, data in files.items() if path != name}
        if fails(fewer):
            files = fewer
            continue
        for (_, path), data in originals.items():
            if path == name and data != files[name] and fails(files | {name: data}):
                files[name] = data
                break
    for name in sorted(files, key=lambda name: -len(files[name])):
        step = len(files[name]) // 2
        while step >= 1 and time.monotonic() < deadline:
            at = 0
            while at < len(files[name]) and time.monotonic() < deadline:
                data = files[name]
                shorter = data[:at] + data[at + step :]
                if fails(files | {name: shorter}):
                    files[name] = shorter
                else:
                    at += step
            step //= 2
    return Case(case.words, files, case.ended_after_s)


def warm(cases, fresh):
    """Import here all modules that some cases import, so that forked processes needn't.

    Returns:
        Failures of the cases.
    """
    modules = {}
    faults = []
    for case in cases:
        with fresh() as folder:
            listing = folder.parent / "modules"
            failures, outcome = run_case(case, folder, listing)
            if listing.exists():
                modules |= dict.fromkeys(listing.read_text().split("\n"))
        if outcome.code:
            failures.append(f"exit code {outcome.code}: {outcome.errors}")
        faults += [f"{' '.join(case.words)}: {fault}" for fault in failures]
    for name in modules:
        if name not in sys.modules and not name.startswith("__"):
            with contextlib.suppress(Exception):  # parts of a package that only it can import
                import_module(name)
    return faults
