"""What is known of a session beside its samples: its numbers, and modules that tests name."""

from __future__ import annotations

from dataclasses import dataclass

from undulog.analysis.results.analysis import Analysis
from undulog.analysis.session.cycles import CycleMaps


@dataclass(frozen=True)
class Named:
    """A module that a test names.

    Attributes:
        joint: Its joint.
        why: What is said of it, without a stop.
    """

    joint: str
    why: str


@dataclass(frozen=True)
class Layer:
    """What is known of a session beside its samples.

    Attributes:
        analysis: Its numbers, or None.
        steady: Cycles of its steady gait, where no phase was logged and they were computed now.
        named: Modules that tests name, each once.
        notes: Where it is from and what is missing, a sentence each.
    """

    analysis: Analysis | None
    steady: CycleMaps | None = None
    named: tuple[Named, ...] = ()
    notes: tuple[str, ...] = ()

    def with_numbers(self, computed: Layer) -> Layer:
        """Put numbers to what results say without them.

        Args:
            computed: The session's analysis, or a note why there is none.

        Returns:
            Both.
        """
        notes = (*self.notes, *computed.notes)
        return Layer(computed.analysis, computed.steady, self.named, notes)
