"""Remarks on an analysis: warnings, notes, refusals, and what leads the answer.

Whoever computes something takes a function of one sentence (:data:`.Warn`). A plain sentence is a
warning. A :class:`Lacking` is a warning that stands first; a :class:`Note` changes nothing that a
reader does: an optional topic that was not recorded, a figure that does not apply.
"""

from __future__ import annotations

from collections.abc import Iterable


class Lacking(str):
    """What the session was recorded for is null: there is no gait, no command, no response."""

    __slots__ = ()


class Leading(Lacking):
    """A :class:`Lacking` that the answer begins with: the record itself can't show it."""

    __slots__ = ()


class Refusal(Leading):
    """A :class:`Leading` for which no response of any kind can be told from the record."""

    __slots__ = ()


class Note(str):
    """A fact; nothing that the result states is doubtful for it."""

    __slots__ = ()


class Remarks:
    """Collects sentences, each once."""

    def __init__(self) -> None:
        """Start empty."""
        self._sentences: dict[str, str] = {}

    def __call__(self, sentence: str) -> None:
        """Take a sentence.

        Args:
            sentence: Plain, a :class:`Lacking` or a :class:`Note`.
        """
        self._sentences.setdefault(sentence, sentence)

    def warnings(self, of_the_file: Iterable[str] = ()) -> tuple[str, ...]:
        """Return the warnings, worst first.

        Args:
            of_the_file: What the session's file lacks: it comes after what is null.

        Returns:
            One sentence each.
        """
        every = self._sentences.values()
        lacking = [sentence for sentence in every if isinstance(sentence, Lacking)]
        others = [sentence for sentence in every if not isinstance(sentence, (Lacking, Note))]
        return tuple(map(str, dict.fromkeys([*lacking, *of_the_file, *others])))

    @property
    def leading(self) -> tuple[str, ...]:
        """What the answer begins with; refusals alone if there are any."""
        kind = Refusal if self.refused else Leading
        return tuple(
            str(sentence) for sentence in self._sentences.values() if isinstance(sentence, kind)
        )

    @property
    def refused(self) -> bool:
        """Whether there is a :class:`Refusal`."""
        return any(isinstance(sentence, Refusal) for sentence in self._sentences.values())

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes, in the order in which they came."""
        return tuple(
            str(sentence) for sentence in self._sentences.values() if isinstance(sentence, Note)
        )
