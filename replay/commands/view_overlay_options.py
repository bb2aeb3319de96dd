"""What the command line says of sessions side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Parameter


@dataclass(frozen=True, kw_only=True)
class BesideOptions:
    """What the command line says of sessions side by side; None is what it doesn't say.

    Attributes:
        align: With several sessions, what happens at once: the same `time` since each one's first
            sample (where nothing is said), the same time since the start of its `gait`, or the
            same `phase` of the gait.
        names: With several sessions: what they are called, with commas, e.g. `robot,twin`; the
            files' names where nothing is said.
        place: With several sessions: whether bodies are laid on the first one at the `start`
            (where nothing is said) or stay where each session's `world` has them.
    """

    align: Annotated[Literal["time", "gait", "phase"] | None, Parameter(name="--align")] = None
    names: Annotated[str | None, Parameter(name="--names")] = None
    place: Annotated[Literal["start", "world"] | None, Parameter(name="--place")] = None

    @property
    def given(self) -> list[str]:
        """Names of the options that were given."""
        named = {"align": self.align, "names": self.names, "place": self.place}
        return [f"--{name}" for name, value in named.items() if value is not None]
