"""The command line ``undulog``, and the objects of a notebook.

Each command is imported when it is used, and so is each name of ``__all__``. Exit codes: 0 done, 1
the work failed, 2 wrong usage.
"""

from __future__ import annotations

import errno
import gc
import os
import sys
from codecs import lookup
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cyclopts import App
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions
    from rich.text import Text

    from undulog.analysis import Analysis as Analysis
    from undulog.analysis import Catalog as Catalog
    from undulog.analysis import Choices as Choices
    from undulog.analysis import Comparison as Comparison
    from undulog.analysis import Experiment as Experiment
    from undulog.analysis import Options as Options
    from undulog.analysis import load as load
    from undulog.capture import Robot as Robot
    from undulog.capture import Session as Session
    from undulog.capture import SessionWriter as SessionWriter
    from undulog.capture import load_robot as load_robot
    from undulog.capture.common.errors import MissingExtraError
    from undulog.notebook import analyse as analyse
    from undulog.notebook import compare as compare
    from undulog.notebook import record as record
    from undulog.replay import write_recording as write_recording
    from undulog.sim import Scenario as Scenario
    from undulog.sim import Twin as Twin
    from undulog.sim import load_scenario as load_scenario

__all__ = [
    "Analysis",
    "Catalog",
    "Choices",
    "Comparison",
    "Experiment",
    "Options",
    "Robot",
    "Scenario",
    "Session",
    "SessionWriter",
    "Twin",
    "analyse",
    "compare",
    "load",
    "load_robot",
    "load_scenario",
    "record",
    "run",
    "write_recording",
]

_HOMES = {
    "analysis": "Analysis Catalog Choices Comparison Experiment Options load",
    "capture": "Robot Session SessionWriter load_robot",
    "notebook": "analyse compare record",
    "replay": "write_recording",
    "sim": "Scenario Twin load_scenario",
}
"""Module of this package to the names of ``__all__`` that are imported from it."""

VERBS: dict[str, tuple[str, str]] = {
    "record": ("capture record:record", "Record a robot, or its twin, into a session."),
    "record status": ("capture record:status", "Show the state of the running recordings."),
    "record mark": ("capture record:mark", "Mark this moment of the running recording."),
    "record note": ("capture record:note", "Write a remark into the running recording."),
    "record split": ("capture record:split", "Begin a new part of the recording."),
    "record stop": ("capture record:stop", "End the running recording in good order."),
    "record unit": ("capture record:unit", "Print or install a systemd unit."),
    "import": ("capture import_log:import_log", "Bring in bags, CAN traces, tables."),
    "log info": ("capture log_info:log_info", "Show what a log holds."),
    "log check": (
        "capture log_info:log_check",
        "Judge whether a session is good, degraded or bad, and why.",
    ),
    "log recover": ("capture log_edit:log_recover", "Write a whole file from what a crash left."),
    "log cut": ("capture log_edit:log_cut", "Write a part of a log to a new file."),
    "log merge": ("capture log_edit:log_merge", "Put several logs into one new file."),
    "log export": (
        "capture log_export:log_export",
        "Write sessions for other tools: frames, joints, datasets.",
    ),
    "robot list": ("capture robot:robot_list", "List the shipped robots."),
    "robot show": ("capture robot:robot_show", "Show a robot: joints, limits, sensors, bus."),
    "robot check": ("capture robot:robot_check", "Check a robot description; list all faults."),
    "robot new": (
        "capture robot:robot_new",
        "Write a description to start from, from a log if given.",
    ),
    "sim list": ("sim run:list_scenarios", "List the shipped scenarios."),
    "sim show": ("sim run:show", "Show a scenario: every value with its unit."),
    "sim run": ("sim run:run", "Simulate a scenario and record it."),
    "sim fit": ("replay fit:fit", "Fit the twin's servo and friction to sessions."),
    "sim null": ("sim run:null", "Model identical modules, for analyse --null."),
    "sim serve": ("sim serve:serve", "Be a robot on a bus, in real time."),
    "drive": ("sim drive:drive", "Drive a gait, a plan or recorded commands."),
    "analyse": ("analysis analyse:analyse", "Numbers: response, energy, spread over the segments."),
    "predict": (
        "analysis predict:predict",
        "From kicks: how oscillators that feel their servos synchronise.",
    ),
    "compare": ("analysis compare:compare", "What differs between two sessions or groups."),
    "plan compensate": (
        "analysis predict:compensate",
        "Commands that make the response homogeneous, from kicks.",
    ),
    "plan lag-sweep": (
        "analysis plan:lag_sweep",
        "Commands that identify the coupling without contact.",
    ),
    "plan multisine": (
        "analysis plan:multisine",
        "Commands at many frequencies at once: a band, or tones without contact.",
    ),
    "plan phase-kicks": ("analysis plan:phase_kicks", "Commands that identify the coupling."),
    "plan reversal": ("analysis plan:reversal", "Commands that separate boundary from module."),
    "report": ("analysis report:report", "The offline report, one HTML page."),
    "catalog": ("analysis catalog:catalog", "Find sessions by robot, date, verdict and results."),
    "replay": ("replay replay:replay", "Run a recorded experiment again in the twin; compare."),
    "sweep": ("replay sweep:sweep", "Run the twin over a design of parameters."),
    "view": ("replay view:view", "See a session in Rerun."),
    "info": ("capture info:info", "Versions and extras, for a bug report."),
}
"""Command to the function behind it, in its package's folder ``commands``, and its summary."""

_GROUPS = {
    "plan": "Write the commands of an experiment around a recorded gait or pose.",
    "record": "Record a robot; look after a running recording.",
    "log": "Look after sessions.",
    "robot": "Robot descriptions: list, show, check, begin one.",
    "sim": "The twin: simulate and record.",
}

_COMPLETION = "--install-completion"

_OF_LINEAR_ALGEBRA = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""The matrices are small: more threads wait for each other, on a busy machine for most of the time.
What the user has set stays."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
"""What writing to a full or failing disk raises."""


def __getattr__(name: str) -> Any:
    """Import a name of ``__all__`` when it is first used."""
    for module, names in _HOMES.items():
        if name in names.split():
            return getattr(import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """What the package offers."""
    return sorted(__all__)


def build(arguments: Sequence[str] = ()) -> App:
    """The command with all its commands, none of them imported.

    Args:
        arguments: The command line; the command that it names takes its help from its own
            docstring, the others only have their line in the list.

    Returns:
        The application.
    """
    from cyclopts import App, Parameter

    completion = list(arguments[:1]) == [_COMPLETION]
    app = App(
        name="undulog",
        help="Record, simulate, measure and replay undulating robots. "
        "Every session is one MCAP file that explains itself. "
        "Every command takes `--max-chunk-mib N`: larger chunks (256 MiB by default) are not read.",
        version=_version,
        help_format="markdown" if completion else "plaintext",
        help_formatter=_HelpLayout(),
        help_epilogue="Example: undulog sim run flat -o run.mcap && undulog analyse run.mcap",
        default_parameter=Parameter(negative=()),
        result_action="return_value",
        suppress_keyboard_interrupt=False,  # run() says so, and ends with 1
    )
    if not arguments or arguments[0].startswith("-"):  # no other command can be the one meant
        app.register_install_completion_command(  # pyright: ignore[reportUnknownMemberType] untyped **
            _COMPLETION, help="Install completion of commands and options for bash, zsh or fish."
        )
    groups = {name: _group(name, arguments) for name in _GROUPS}
    for group in groups.values():
        app.command(group)
    for verb, (target, summary) in VERBS.items():
        if verb in groups:
            continue
        *group, name = verb.split()
        asked = list(arguments[: len(group) + 1]) == [*group, name]
        parent = groups[group[0]] if group else app
        parent.command(
            _in_commands(target), name=name, help=None if asked else summary, help_epilogue=""
        )
    return app


class _HelpLayout:
    """Layout of help for cyclopts; as for Markdown whose only marks are backticks and empty lines.

    Importing the parser of Markdown takes longer than all else of a help.
    """

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print a panel of commands or parameters."""
        from cyclopts.help import DefaultFormatter

        for entry in panel.entries:
            _fill(entry.description)
        DefaultFormatter()(console, options, panel)

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        """Print the line of the usage."""
        from cyclopts.help import DefaultFormatter

        DefaultFormatter().render_usage(console, options, usage)

    def render_description(self, console: Console, _: ConsoleOptions, description: Any) -> None:
        """Print the description of a command."""
        _fill(description)
        console.print(description)


def _fill(description: Any) -> None:
    """Lay out the plain text that an ``InlineText`` of cyclopts holds."""
    plain = getattr(getattr(description, "primary_renderable", None), "plain", None)
    if plain is not None:
        description.primary_renderable = _filled(plain)


def _filled(text: str) -> Text:
    """Return a text with a line for each paragraph and a style for code."""
    from rich.text import Text

    paragraphs = (" ".join(paragraph.split()) for paragraph in text.strip().split("\n\n"))
    styled = Text()
    for k, part in enumerate("\n\n".join(paragraphs).split("`")):
        styled.append(part, "markdown.code" if k % 2 else "")
    return styled


def _version() -> str:
    from importlib.metadata import version

    return version("undulog")


def _in_commands(target: str) -> str:
    """The full path of a function: a package's commands are in its folder ``commands``."""
    package, function = target.split()
    return f"undulog.{package}.commands.{function}"


def _group(name: str, arguments: Sequence[str]) -> App:
    """A group of commands; if it is a command itself, that is imported when the group is used.

    ``undulog record can:...`` records, ``undulog record stop`` ends a recording: a word that names
    a command of the group is that command, anything else goes to the group's own.
    """
    from cyclopts import App

    if name not in VERBS or list(arguments[:1]) not in ([name], [_COMPLETION]):
        summary = VERBS[name][1] if name in VERBS else _GROUPS[name]
        return App(name=name, help=summary, help_epilogue="")
    module, function = _in_commands(VERBS[name][0]).split(":")
    group = App(name=name, help_epilogue="")
    group.default(getattr(import_module(module), function))
    return group


def run(arguments: Sequence[str]) -> int:
    """Run one command line.

    Args:
        arguments: Without the program's name.

    Returns:
        The exit code: 0 done, 1 the work failed, 2 wrong usage.

    Example::

        code = undulog.run(["log", "info", "run.mcap"])
    """
    from cyclopts import CycloptsError, UnknownCommandError

    from undulog.capture.common.errors import UndulogError, UsageError

    try:
        if "" in arguments:  # as a path it would be this folder
            raise UsageError("an argument is empty; is it a variable of the shell that isn't set?")
        arguments = _without_chunk_limit(arguments)
        app, result = build(arguments), None
        *command, last = arguments or [""]
        if last == "--help" and " ".join(command) in ("", *VERBS, *_GROUPS):
            app.help_print(command)  # reads the options once, which takes a tenth less time
        else:
            result = app(arguments, exit_on_error=False, print_error=False)
    except UnknownCommandError:  # its own text would import every command
        return _complain(_unknown(arguments), 2)
    except CycloptsError as error:
        return _complain(f"{error}\nTry 'undulog --help', or --help after the command.", 2)
    except (UndulogError, ImportError) as error:
        foreseen = error if isinstance(error, UndulogError) else _missing_extra(error, arguments)
        if foreseen is None:
            raise
        return _complain(str(foreseen), foreseen.exit_code)
    except (OSError, UnicodeEncodeError) as error:
        fault = _file_fault(error)
        if fault is None:
            raise
        return _complain(fault, 1)
    except KeyboardInterrupt:
        return _complain("interrupted", 1)
    return result if isinstance(result, int) else 0


def main() -> None:
    """Run the process's own command line and exit."""
    if "--help" in sys.argv:
        gc.disable()  # a seventh of the time, and the process ends with the help
    for name in _OF_LINEAR_ALGEBRA:
        os.environ.setdefault(name, "1")
    try:
        from undulog.capture.common.streams import prepare_streams

        prepare_streams()
        if not sys.stderr.isatty():
            os.environ.setdefault("NO_COLOR", "1")  # Rerun's log is coloured anyway: no-color.org
        from undulog.capture.common.extras import defer

        defer()
        code = run(sys.argv[1:])
        sys.stdout.flush()
    except KeyboardInterrupt:  # while the first modules were imported
        code = _complain("interrupted", 1)
    except BrokenPipeError:  # the reader (head, less) has seen enough
        _discard_output()
        code = 1
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            sys.exit(_complain(f"{str(error.filename)[:60]} ...: too long for a file's name", 2))
        if error.errno not in _FULL or error.filename is not None:
            raise
        _discard_output()
        code = 1
        try:
            _complain(f"the output can't be written: {error.strerror}", code)
        except OSError:  # the error output may be on the same disk
            _discard_output()
    waits = sys.modules.get("undulog.capture.common.waits")
    if waits is not None and waits.calls_go_on():
        os._exit(code)  # standard output was flushed, and standard error has no buffer to flush
    sys.exit(code)


def _discard_output() -> None:
    """Send what is still to be printed nowhere, so that the end of the process can't fail."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(nowhere, stream.fileno())


def _without_chunk_limit(arguments: Sequence[str]) -> list[str]:
    """Move ``--max-chunk-mib``, an option of every command, into the environment.

    Raises:
        UsageError: If its value is no positive whole number.
    """
    option, left, rest = "--max-chunk-mib", list[str](), iter(arguments)
    for word in rest:
        name, equals, value = word.partition("=")
        if name == option:
            from undulog.capture.common.errors import UsageError
            from undulog.capture.log.mcap.chunk import LARGEST_CHUNK_VARIABLE, largest_chunk

            os.environ[LARGEST_CHUNK_VARIABLE] = value if equals else next(rest, "")
            try:
                largest_chunk()
            except UsageError:
                wrong = os.environ.pop(LARGEST_CHUNK_VARIABLE)
                raise UsageError(f"{option} {wrong}: give a whole number of MiB above 0") from None
        else:
            left.append(word)
    return left


def _file_fault(error: OSError | UnicodeEncodeError) -> str | None:
    """What is wrong with a file, if it is a file's fault."""
    if isinstance(error, OSError):  # a file that vanished or a disk that failed, at any moment
        if error.filename is None or error.errno == errno.ENAMETOOLONG:
            return None
        return f"{error.filename}: {error.strerror}"
    names = lookup(error.encoding).name, lookup(sys.getfilesystemencoding()).name
    if names[0] != names[1] or names[0] == "utf-8":
        return None
    return (
        f"{error.object}: in this locale ({error.encoding}) a file's name can't have "
        f"{error.object[error.start]!r}; set LC_ALL=C.UTF-8"
    )


def _unknown(arguments: Sequence[str]) -> str:
    from difflib import get_close_matches

    words = [word for word in arguments if not word.startswith("-")][:2]
    typed = " ".join(words if words and words[0] in _GROUPS else words[:1])
    options = [word for word in arguments if word.startswith("-")]
    if options and (arguments[0] in options or typed in _GROUPS):
        place = f" of 'undulog {typed}'" if typed in _GROUPS else " in front of a command"
        return f"there is no option '{options[0]}'{place}. Try 'undulog --help'."
    near = get_close_matches(typed, VERBS, n=1)
    hint = f"Did you mean '{near[0]}'? " if near else ""
    return f"there is no command '{typed}'. {hint}There are: {', '.join(VERBS)}."


def _missing_extra(error: ImportError, arguments: Sequence[str]) -> MissingExtraError | None:
    """The extra that would mend the import, if one would."""
    from undulog.capture.common.errors import MissingExtraError
    from undulog.capture.common.extras import extra_of, missing_package

    if (package := missing_package(error)) is None:
        return None
    verb = max((v for v in VERBS if " ".join(arguments).startswith(v)), key=len)
    return MissingExtraError(f"'undulog {verb}'", extra_of(package, verb), package)


def _complain(message: str, code: int) -> int:
    from undulog.capture.common.console import complain

    complain(f"error: {message}")
    return code
