"""Options for the topics of commands and responses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cyclopts import Parameter

from ..log.messages import COMMAND_TOPIC, RESPONSE_TOPIC

if TYPE_CHECKING:
    from ..log.read.session_view import SessionView

# Cyclopts parses the whole file of a class for its help: a short file.


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CommandTopic:
    """Where the commands are.

    Attributes:
        command_topic: Topic of the commands: of JointStates or JointTrajectories,
            `TOPIC.reference` of a controller state, or `TOPIC:JOINT,JOINT,...` of a
            Float64MultiArray.
    """

    command_topic: str = COMMAND_TOPIC


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class JointTopicOptions(CommandTopic):
    """Where commands and responses are; by default found by type if those topics are missing.

    Attributes:
        response_topic: Topic of the responses: of JointStates or DynamicJointStates, or
            `TOPIC.feedback` of a controller state.
    """

    response_topic: str = RESPONSE_TOPIC

    @property
    def names(self) -> tuple[str, str]:
        """Topics of commands and responses."""
        return self.command_topic, self.response_topic

    def view(self, session: SessionView) -> SessionView:
        """View a session with its joints on the topics of the log contract."""
        return session.with_joints(*self.names)


CONTRACT = JointTopicOptions()
