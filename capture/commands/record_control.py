"""Commands ``record status``, ``mark``, ``note``, ``split``, ``stop`` and ``unit``.

They reach running recorders through their control sockets.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from ..common.console import complain, echo, emit_json, refuse_existing
from ..common.errors import ControlError, LogWriteError, UsageError
from ..common.files import write_text

if TYPE_CHECKING:
    from ..recorder.control_client import ControlClient


_Words = Annotated[str, Parameter(show_default=False)]
_UNITS = Path("/etc/systemd/system")
_FAULTS = ("malformed", "error_frames", "reconnects")


def counted_faults(source: Mapping[str, Any]) -> list[str]:
    """Return the counts of faults of a source that are not zero: ``3 error frames``."""
    return [f"{source[key]} {key.replace('_', ' ')}" for key in _FAULTS if source.get(key)]


def status(*, socket: Path | None = None, json: bool = False) -> int:
    """Show the state of the running recordings.

    Example: `undulog record status`

    Args:
        socket: Control socket of one recorder; all that run by default.
        json: Report as one JSON object, `recordings`.
    """
    from ..recorder.control_client import ControlClient

    found: list[dict[str, Any]] = []
    silent: list[str] = []
    for path in [socket] if socket is not None else _running():
        try:
            with ControlClient(path) as recorder:
                found.append({"socket": str(path), **recorder.ask({"do": "status"})})
        except ControlError as error:
            silent.append(str(error))
    if json:
        emit_json({"recordings": found, "silent": silent})
    for recording in [] if json else found:
        echo(*_summary(recording))
    for error in silent:
        complain(f"error: {error}")
    return int(bool(silent))


def mark(
    *text: _Words, level: str = "info", socket: Path | None = None, json: bool = False
) -> None:
    """Mark this moment of the running recording; a ring is written to a file.

    Example: `undulog record mark slipped on wet sand`

    Args:
        text: Remark on it; it goes to `/rosout`.
        level: `info`, `warn` or `error`.
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    _ask({"do": "mark", "text": " ".join(text), "level": level}, "marked", socket, as_json=json)


def note(
    *text: _Words, level: str = "info", socket: Path | None = None, json: bool = False
) -> None:
    """Write a remark into the running recording, to `/rosout`.

    Example: `undulog record note battery changed`

    Args:
        text: The remark.
        level: `info`, `warn` or `error`.
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    if not text:
        raise UsageError("a note needs a text: undulog record note battery changed")
    _ask({"do": "note", "text": " ".join(text), "level": level}, "noted", socket, as_json=json)


def split(*, socket: Path | None = None, json: bool = False) -> None:
    """Begin a new part of the running recording.

    Example: `undulog record split`

    Args:
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    _ask({"do": "split"}, "split", socket, as_json=json)


def stop(*, wait: bool = False, socket: Path | None = None, json: bool = False) -> int:
    """End the running recording in good order.

    Example: `undulog record stop --wait`

    Args:
        wait: Wait until the file is complete, and print its name.
        socket: The recorder's control socket, where several run.
        json: Report as one JSON object.
    """
    # Finalising takes as long as it takes; without --wait the answer comes at once.
    with _recorder(socket, for_ever=wait) as recorder:
        reply = recorder.ask({"do": "stop", "wait": True} if wait else {"do": "stop"})
    if json or not wait:
        _print_reply("stopping", reply, as_json=json)
    else:
        files = ", ".join(str(file) for file in reply.get("files", []))
        echo(f"{files or 'nothing written'}: {_facts(reply)}", *_reasons(reply))
    return int(bool(reply.get("failed", False)))


def unit(*, install: bool = False, folder: Path = _UNITS, force: bool = False) -> None:
    """Print or install a systemd unit for recordings that start with the computer.

    It is hardened, runs as a user of its own and reads its settings from `/etc/undulog/NAME.toml`.

    Example: `undulog record unit --install`

    Args:
        install: Write the unit to the folder instead of printing it; needs the rights to do so.
        folder: Folder of units, for `--install`.
        force: Replace the unit if it is there.
    """
    from ..recorder.systemd import UNIT_NAME, hidden_folder, installed_program, unit_text

    program = installed_program()
    text = unit_text(program)
    if install:
        path = folder / UNIT_NAME
        refuse_existing(path, force=force)
        if not os.access(folder, os.W_OK):
            raise LogWriteError(path, f"no right to write; sudo {program} record unit --install")
        write_text(path, text)
        path.chmod(0o644)
        echo(
            f"{path}: runs {program}",
            "next, for the settings /etc/undulog/NAME.toml:",
            "  systemctl daemon-reload && systemctl enable --now undulog-record@NAME",
        )
    else:
        echo(*text.splitlines())
    if (hidden := hidden_folder(program)) is not None:
        complain(
            f"warning: {program} lies below {hidden}, which this unit hides from the service; "
            "install undulog elsewhere, e.g. in /opt/undulog"
        )


def _running() -> list[Path]:
    from ..recorder.control_client import find_sockets

    paths = find_sockets(os.environ)
    if not paths:
        raise ControlError("no recorder runs here; --socket names one elsewhere")
    return paths


def _recorder(socket: Path | None, *, for_ever: bool = False) -> ControlClient:
    """Connect to the recorder of a socket, or to the only one that runs."""
    from ..recorder.control_client import PATIENCE_S, ControlClient

    if socket is None:
        paths = _running()
        if len(paths) > 1:
            listed = "\n".join(f"  --socket {path}" for path in paths)
            raise UsageError(f"{len(paths)} recorders run; which one?\n{listed}")
        socket = paths[0]
    return ControlClient(socket, patience_s=None if for_ever else PATIENCE_S)


def _summary(recording: Mapping[str, Any]) -> list[str]:
    """Return the status of a recording, the most important line first."""
    return [
        f"{recording.get('output')}: {recording.get('state', 'recording')}, {_facts(recording)}",
        *_reasons(recording),
        *(f"  {_source(source)}" for source in recording.get("sources", [])),
        f"  socket: {recording['socket']}",
    ]


def _reasons(reply: Mapping[str, Any]) -> list[str]:
    return [f"  reason: {reason}" for reason in reply.get("reasons", [])]


def _source(source: Mapping[str, Any]) -> str:
    """Return the state of a source in one line."""
    ended = "has ended" if source.get("finished") else "not connected"
    parts = ["connected" if source.get("connected") and not source.get("finished") else ended]
    if (frames := source.get("frames")) is not None:
        parts.append(f"{frames} frames")
    if (rate_hz := source.get("rate_hz")) is not None:
        parts.append(f"{rate_hz:.0f} frames/s")
    if source.get("dropped"):
        parts.append(f"{source['dropped']} lost before us")
    parts += counted_faults(source)
    return f"{source.get('name')}: {', '.join(parts)}"


def _facts(reply: Mapping[str, Any]) -> str:
    """Return duration, messages, size and verdict, as far as they are known."""
    from ..common.amounts import format_size

    facts: tuple[tuple[Any, Callable[[Any], str]], ...] = (
        (reply.get("elapsed_s", reply.get("duration_s")), "{:.1f} s".format),
        (reply.get("messages"), "{} messages".format),
        (reply.get("bytes", reply.get("size_bytes")), format_size),
        (reply.get("free"), lambda size: f"{format_size(size)} free"),
        (reply.get("verdict"), "verdict {}".format),
        (reply.get("ended"), "ended: {}".format),
    )
    return ", ".join(text(value) for value, text in facts if value is not None)


def _ask(request: Mapping[str, Any], done: str, socket: Path | None, *, as_json: bool) -> None:
    with _recorder(socket) as recorder:
        reply = recorder.ask(request)
    _print_reply(done, reply, as_json=as_json)


def _print_reply(done: str, reply: Mapping[str, Any], *, as_json: bool) -> None:
    if as_json:
        emit_json(dict(reply))
    elif reply:
        echo(f"{done}: {', '.join(f'{name} {value}' for name, value in reply.items())}")
    else:
        echo(done)
