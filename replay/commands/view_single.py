"""The command line's options of one session: which numbers, which tab, which topics."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..samples.content import Tab

if TYPE_CHECKING:
    from undulog.capture import SessionView

_COMMANDS = "/joint_commands"
_STATES = "/joint_states"


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
        command_topic: With one session: JointState topic of the commands, in a bag of another make.
        response_topic: With one session: JointState topic of the responses.
    """

    result: Annotated[list[Path] | None, Parameter(negative=())] = None
    tab: Tab | None = None
    command_topic: str | None = None
    response_topic: str | None = None

    @property
    def given(self) -> list[str]:
        """Options that were given, as they are typed."""
        said = [one.name for one in fields(self) if getattr(self, one.name) is not None]
        return [f"--{name.replace('_', '-')}" for name in said]

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
