"""Options of ``view``: for one session, for a clip, for several sessions; None where not given."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from ..samples.content import Tab

if TYPE_CHECKING:
    from undulog.capture import SessionView

_COMMANDS = "/joint_commands"
_STATES = "/joint_states"
_TYPED = {"start": "from", "end": "to"}


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Options of the command line that belong together."""

    @property
    def given(self) -> list[str]:
        """Options that were given, as they are typed."""
        names = [one.name for one in fields(self) if getattr(self, one.name) is not None]
        return [f"--{_TYPED.get(name, name.replace('_', '-'))}" for name in names]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SingleOptions(_Options):
    """How one session is shown; None where an option is not given.

    Attributes:
        result: With one session: show what was found before instead of analysing now, `.json` of
            `undulog analyse`. Results of an experiment or a comparison that it is part of mark the
            modules they name. May be given several times.
        tab: With one session: the tab in front, `session` by default; the mean cycle's
            plays at once.
        command_topic: With one session: JointState topic of the commands, in a bag of another make.
        response_topic: With one session: JointState topic of the responses.
    """

    result: Annotated[list[Path] | None, Parameter(negative=())] = None
    tab: Tab | None = None
    command_topic: str | None = None
    response_topic: str | None = None

    @property
    def topics(self) -> tuple[str, str]:
        """JointState topics of commands and responses."""
        return self.command_topic or _COMMANDS, self.response_topic or _STATES

    def view(self, session: SessionView) -> SessionView:
        """View a session with commands and responses on the topics of the log contract.

        Args:
            session: The session.

        Returns:
            The view; the session itself where they are there already.

        Raises:
            MissingChannelError: If it has no topic of a name that was given.
        """
        names = dict(zip((_COMMANDS, _STATES), self.topics, strict=True))
        if all(usual == topic for usual, topic in names.items()):
            return session
        given = {
            usual: topic
            for usual, topic in names.items()
            if topic != usual or topic in session.channels
        }
        return session.view(rename=given)


@dataclass(frozen=True, kw_only=True)
class ClipOptions(_Options):
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
class OverlayOptions(_Options):
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
