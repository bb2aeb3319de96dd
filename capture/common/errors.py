"""The one error tree of undulog.

::

    UndulogError
    |- UsageError (ValueError)              wrong options or arguments; exit code 2
    |  |- MissingExtraError (ImportError)   a command whose extra is not installed
    |  |- OutputExistsError (FileExistsError)
    |  |- SettingsError                    settings of a recording, all faults listed
    |  `- JointSetError (DataError)        commands of another joint set than the robot's
    |- InputFileError (OSError)            a file to read that isn't there, or can't be read
    |  `- DamagedFileError                 a stored file whose bytes aren't those that were written
    |- RobotFileError (ValueError)          a robot description with faults, all listed
    |- ScenarioError (ValueError)           a scenario file with faults, all listed
    |- PlanError (ValueError)               a drive plan with faults, all listed
    |- NullModelError (ValueError)          a null model with faults, all listed
    |- SimulationError (ArithmeticError)    the twin blew up: time, link and likely cause
    |- DataError (ValueError)               samples unfit for a computation
    |- SourceError                          a source that can't be opened or used
    |- ControlError                         a running recorder that can't be reached, or refuses
    |  `- SocketInUseError                  another recorder listens at a control socket
    |- NoAnswerError (TimeoutError)         a thread, a program or a disk that stands still
    `- LogError                             a log that cannot be read or written
       |- NotALogError                      not an MCAP file, or none of it readable
       |- MissingChannelError (KeyError)    the topic is not there; lists those that are
       |- ImportFormatError (ValueError)    a foreign log that cannot be imported
       `- LogWriteError (OSError)           disk full, closed file

The message of an error has what was found, where, and what to do. ``exit_code`` is that of the
command line: 1 the work failed, 2 wrong usage.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_MOST_LISTED = 20  # names in a message


class UndulogError(Exception):
    """Base of all errors that undulog raises on purpose."""

    exit_code: int = 1


class UsageError(UndulogError, ValueError):
    """The command or call is wrong: an option, an argument, a name."""

    exit_code = 2


class MissingExtraError(UsageError, ImportError):
    """A command needs an optional part that is not installed."""

    def __init__(self, verb: str, extra: str, missing: str, instead: str = "") -> None:
        """Build the message.

        Args:
            verb: The command, e.g. ``sim run``.
            extra: The extra that installs the package, e.g. ``sim``.
            missing: The package that could not be imported.
            instead: What works without it.
        """
        from .extras import install_command  # reads the metadata of packages

        self.extra = extra
        parts = [
            f"{verb} needs the package {missing}, which is not installed",
            f"the extra '{extra}' brings it: {install_command(extra, missing)}",
            instead,
        ]
        super().__init__("; ".join(part for part in parts if part))


class OutputExistsError(UsageError, FileExistsError):
    """The output is there already and ``--force`` was not given."""

    def __init__(self, path: Path | str) -> None:
        """Build the message from the file that would have been overwritten."""
        self.path = Path(path)
        super().__init__(f"{path} exists already; choose another name or give --force")


class _PathError(UndulogError):
    """An error of one file."""

    def __init__(self, path: Path | str, message: str) -> None:
        """Build the message from the path and a description of the fault and its cure."""
        self.path = Path(path)
        super().__init__(f"{path}: {message}")


class InputFileError(_PathError, OSError):
    """A description, a model or a result that is missing or can't be read."""


class DamagedFileError(InputFileError):
    """A file of a store (rows of a sweep, a catalogue) that isn't what was written."""


@dataclass(frozen=True)
class DescriptionFault:
    """One fault of a description file.

    Attributes:
        key: Where it is, e.g. ``joints[3].plane``.
    """

    key: str
    actual: str
    valid: str

    def __str__(self) -> str:
        """Return key, found value and valid values in one line."""
        return f"{self.key}: found {self.actual}; valid: {self.valid}"


def _listing(faults: Sequence[DescriptionFault], place: str) -> str:
    count = len(faults)
    head = f"{count} fault{'s' if count != 1 else ''} in {place}"
    return "\n".join([head, *(f"  {fault}" for fault in faults)])


class FaultyFileError(UndulogError, ValueError):
    """A description file with faults; the message lists them all."""

    kind = "file"

    def __init__(self, path: Path | str, faults: Iterable[DescriptionFault]) -> None:
        """Build the message from all faults, at least one."""
        self.path = Path(path)
        self.faults: tuple[DescriptionFault, ...] = tuple(faults)
        super().__init__(f"{path}: {_listing(self.faults, f'this {self.kind}')}")


class RobotFileError(FaultyFileError):
    """A robot description with faults."""

    kind = "robot description"


class ScenarioError(FaultyFileError):
    """A scenario with faults."""

    kind = "scenario"


class PlanError(FaultyFileError):
    """A plan of what to drive, with faults."""

    kind = "plan"


class NullModelError(FaultyFileError):
    """A model of identical modules, with faults."""

    kind = "null model"


class SettingsError(UsageError):
    """The settings of a recording have faults, wherever they come from."""

    def __init__(self, faults: Iterable[DescriptionFault]) -> None:
        """Build the message.

        Args:
            faults: All faults, at least one; their keys are the places: ``--ring``,
                ``UNDULOG_RECORD_RING`` or ``snake.toml: record.ring``.
        """
        self.faults: tuple[DescriptionFault, ...] = tuple(faults)
        super().__init__(_listing(self.faults, "the settings of this recording"))


class SimulationError(UndulogError, ArithmeticError):
    """An impossible state of the twin; names time, link and likely cause."""


class DataError(UndulogError, ValueError):
    """Samples that are unfit for a computation."""


class JointSetError(UsageError, DataError):
    """Commands of another joint set than that of the robot that is to take them."""


class LogError(_PathError):
    """A log that cannot be read or written."""


class NotALogError(LogError):
    """Not an MCAP file, or nothing in it can be read."""


def some_names(names: Sequence[str], most: int) -> str:
    """Return a list of at most so many names, and the number of the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


class MissingChannelError(LogError, KeyError):
    """A topic, joint or field that the log does not have."""

    def __init__(
        self, path: Path | str, missing: str, available: Sequence[str], fix: str = ""
    ) -> None:
        """Build the message; ``fix`` is added to it."""
        self.missing = missing
        self.available = tuple(available)
        listed = some_names(available, _MOST_LISTED) or "nothing"
        advice = f" ({fix})" if fix else ""
        LogError.__init__(self, path, f"has no {missing}; it has {listed}{advice}")

    def __str__(self) -> str:
        """Return the message without the quotes of ``KeyError``."""
        return str(self.args[0])


class SourceError(UndulogError):
    """A source of a recording that can't be opened or used."""

    def __init__(self, source: str, message: str) -> None:
        """Build the message from the source as on the command line, and the fault."""
        self.source = source
        super().__init__(f"{source}: {message}")


class ControlError(UndulogError):
    """A running recorder can't be reached, or refuses a request."""


class SocketInUseError(ControlError):
    """Another recorder listens at a control socket."""


class NoAnswerError(UndulogError, TimeoutError):
    """What is waited for, outside this code, made no progress within its limit."""

    def __init__(self, what: str, limit_s: float, advice: str) -> None:
        """Build the message: what didn't answer, within how long, and what to do."""
        self.what, self.limit_s = what, limit_s
        super().__init__(f"{what} did not answer within {limit_s:g} s; {advice}")


class ImportFormatError(LogError, ValueError):
    """A foreign log that cannot be imported."""


class LogWriteError(LogError, OSError):
    """The log could not be written: disk full, closed, no permission."""


@contextmanager
def raised_as(
    kind: type[_PathError], path: Path | str, what: str, *caught: type[Exception]
) -> Generator[None]:
    """Raise errors of a library as one that names the file; those of this tree pass.

    Args:
        kind: The error to raise.
        what: What failed, before the library's text.
        caught: The library's errors.
    """
    try:
        yield
    except UndulogError:
        raise
    except caught as error:
        raise kind(path, f"{what}: {error}" if what else str(error)) from error
