"""Options of ``view``: of one session, of a clip, of several sessions side by side."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

# Cyclopts parses the whole file of a class for its help: a short file.

_TYPED = {"start": "from", "end": "to"}


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SingleOptions:
    """How one session is shown; None where an option is not given.

    Attributes:
        result: With one session: show what was found before instead of analysing now, `.json` of
            `undulog analyse`. Results of an experiment or a comparison that it is part of mark the
            modules they name. May be given several times.
        tab: With one session: the tab in front, `session` by default; the mean cycle's
            plays at once.
    """

    result: Annotated[list[Path] | None, Parameter(negative=())] = None
    tab: Literal["session", "cycles", "mean-cycle"] | None = None


@dataclass(frozen=True, kw_only=True)
class ClipOptions:
    """The command line's options of a clip; None for those not given.

    Attributes:
        start: With `--clip`: where it begins, in seconds of the session.
        end: With `--clip`: where it ends.
        fps: With `--clip`: frames a second; 25 by default.
        speed: With `--clip`: seconds of the session in a second of the clip, e.g. 0.25.
        size: With `--clip`: WIDTHxHEIGHT in pixels; 960x540 by default.
    """

    start: Annotated[float | None, Parameter(name="--from")] = None
    end: Annotated[float | None, Parameter(name="--to")] = None
    fps: Annotated[int | None, Parameter(name="--fps")] = None
    speed: Annotated[float | None, Parameter(name="--speed")] = None
    size: Annotated[str | None, Parameter(name="--size")] = None


@dataclass(frozen=True, kw_only=True)
class OverlayOptions:
    """The command line's options of sessions side by side; None for those not given.

    Attributes:
        align: With several sessions, what happens at once: the same `time` since each one's first
            sample (the default), the same time since the start of its `gait`, or the
            same `phase` of the gait.
        names: With several sessions: what they are called, with commas, e.g. `robot,twin`; the
            files' names by default.
        place: With several sessions: whether bodies are laid on the first one at the `start`
            (the default) or stay where each session's `world` has them.
    """

    align: Annotated[Literal["time", "gait", "phase"] | None, Parameter(name="--align")] = None
    names: Annotated[str | None, Parameter(name="--names")] = None
    place: Annotated[Literal["start", "world"] | None, Parameter(name="--place")] = None


def given(options: SingleOptions | ClipOptions | OverlayOptions) -> str:
    """Return the options that were given, as they are typed, with commas."""
    names = [field.name for field in fields(options) if getattr(options, field.name) is not None]
    return ", ".join(f"--{_TYPED.get(name, name.replace('_', '-'))}" for name in names)
