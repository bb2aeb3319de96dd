"""A part of the analysis of a session, and the order in which parts are measured.

A part names the parts whose results it reads; the order of all follows from that. Of parts that
could be next, the one that is listed first is, so that the order, and that of the warnings, is the
same in each run. A part that reads a result which it doesn't name is an error: no order is hidden.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from undulog.capture.common.errors import UsageError

if TYPE_CHECKING:
    from ..common.remarks import Remarks
    from ..signals.session_signals import Signals
    from .shown import Shown

R = TypeVar("R")


@dataclass(frozen=True)
class Part(Generic[R]):
    """A part of the analysis.

    Attributes:
        name: By which others name it; once in an analysis.
        measure: Returns its result; takes the session's signals, the results of the parts that it
            names, and where remarks go.
        needs: Names of the parts whose results it reads; they are measured with it.
        reads: Names of further parts whose results it reads where they are measured.
        of_commands: Whether it reads the commands' samples, which are held until the last part
            that does.
        result: Frozen dataclass of its result, where that has a key of the part's name in the JSON;
            the measurement may then be None as well.
        show: Returns the tables and figures of such a result.
    """

    name: str
    measure: Callable[[Signals, Results, Remarks], R]
    needs: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    of_commands: bool = False
    result: type[R] | None = None
    show: Callable[[R], Shown] | None = None


@dataclass(frozen=True)
class Results:
    """Results of parts, as far as one part may read them.

    Attributes:
        values: By the part's name.
        readable: Names that may be read; None for all.
        reader: Name of the part that reads, for errors.
    """

    values: Mapping[str, object] = field(default_factory=dict[str, object])
    readable: Collection[str] | None = None
    reader: str = ""

    def __getitem__(self, part: Part[R]) -> R:
        """Return the result of a part.

        Raises:
            KeyError: If the part wasn't measured, or isn't named by the part that reads.
        """
        if self.readable is not None and part.name not in self.readable:
            raise KeyError(f"part {self.reader!r} reads {part.name!r}: name it in its 'needs'")
        return cast("R", self.values[part.name])

    def get(self, part: Part[R], default: R) -> R:
        """Return the result of a part, or a default where it wasn't measured."""
        return self[part] if part.name in self.values else default


def in_order(parts: Iterable[Part[Any]], chosen: Collection[str] | None = None) -> list[Part[Any]]:
    """Return parts in the order in which they are measured.

    Args:
        parts: All parts, each name once.
        chosen: Names of those to measure, with all that they need; None for all.

    Returns:
        Each after all that it reads; otherwise in the order of ``parts``.

    Raises:
        UsageError: If a name comes twice, isn't there, or parts need each other in a circle.
    """
    listed = list(parts)
    by_name = {part.name: part for part in listed}
    if len(by_name) < len(listed):
        names = [part.name for part in listed]
        twice = sorted({name for name in names if names.count(name) > 1})
        raise UsageError(f"parts of the analysis have one name: {', '.join(twice)}")
    needed = _with_needs(by_name, by_name if chosen is None else chosen)
    sorter: TopologicalSorter[str] = TopologicalSorter()
    for part in listed:
        if part.name in needed:
            sorter.add(part.name, *(n for n in (*part.needs, *part.reads) if n in needed))
    try:
        sorter.prepare()
    except CycleError as error:
        circle = " -> ".join(cast("list[str]", error.args[1]))
        raise UsageError(f"parts of the analysis need each other in a circle: {circle}") from None
    rank = {part.name: k for k, part in enumerate(listed)}
    ready: list[int] = []
    order: list[Part[Any]] = []
    while sorter.is_active():
        for name in sorter.get_ready():
            heapq.heappush(ready, rank[name])
        part = listed[heapq.heappop(ready)]
        order.append(part)
        sorter.done(part.name)
    return order


def _with_needs(by_name: Mapping[str, Part[Any]], chosen: Iterable[str]) -> set[str]:
    """Return some names with all that their parts need."""
    needed: set[str] = set()
    open_names = [(name, "the choice of parts") for name in chosen]
    while open_names:
        name, reader = open_names.pop()
        if name not in by_name:
            raise UsageError(f"{reader} needs the part {name!r}, which isn't there")
        if name not in needed:
            needed.add(name)
            open_names += [(need, f"part {name!r}") for need in by_name[name].needs]
    return needed


def measure(parts: Sequence[Part[Any]], signals: Signals, remarks: Remarks) -> Results:
    """Measure parts one after the other; what only one of them needed of memory is released.

    Args:
        parts: In their order.

    Returns:
        The results of all.
    """
    values: dict[str, object] = {}
    last = max((k for k, part in enumerate(parts) if part.of_commands), default=-1)
    for k, part in enumerate(parts):
        readable = Results(values, {*part.needs, *part.reads}, part.name)
        values[part.name] = part.measure(signals, readable, remarks)
        signals.release(commands=k == last)
    return Results(values)
