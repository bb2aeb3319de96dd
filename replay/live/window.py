"""The last seconds of a recording that goes on: what a derived quantity is computed from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray

from ..draw.scene.motion import HeadPath
from ..samples.sampling import ordered
from ..samples.tracks import Columns, Track
from .decode import Batch

KEPT_NS = 2_000_000_000
"""How much is kept [ns]."""
PATIENCE_NS = 250_000_000
"""How long a quantity that has gone silent holds up those computed from it [ns]."""


class Window:
    """Samples of the last seconds."""

    def __init__(self) -> None:
        """Start empty."""
        self.head: HeadPath | None = None
        self.ranges: dict[str, tuple[IntArray, FloatArray]] = {}
        self._tracks: dict[tuple[str, str], dict[str, Track]] = {}
        self._newest_ns = 0

    @property
    def columns(self) -> Columns:
        """All JointState columns."""
        return {key: tuple(tracks.values()) for key, tracks in self._tracks.items()}

    def tracks(self, topic: str, field: str = "position") -> tuple[Track, ...]:
        """One column.

        Args:
            topic: E.g. ``/joint_states``.
            field: ``position``, ``velocity`` or ``effort``.

        Returns:
            A track a joint; none where nothing has come.
        """
        return tuple(self._tracks.get((topic, field), {}).values())

    def add(self, batch: Batch) -> None:
        """Take new samples, and forget the oldest.

        Args:
            batch: The new samples.
        """
        for key, tracks in batch.columns.items():
            own = self._tracks.setdefault(key, {})
            for track in tracks:
                old = own.get(track.name)
                kept = None if old is None else (old.t_ns, old.values)
                own[track.name] = Track(track.name, *_grown(kept, track.t_ns, track.values))
        for topic, (t_ns, values) in batch.ranges.items():
            self.ranges[topic] = _grown(self.ranges.get(topic), t_ns, values)
        if batch.head is not None:
            self.head = _joined(self.head, batch.head)
        ends = [one.t_ns[-1] for tracks in batch.columns.values() for one in tracks]
        self._newest_ns = max([self._newest_ns, *map(int, ends)])

    def ready_ns(self, inputs: Iterable[Sequence[Track]], *others: IntArray) -> int:
        """Until when something can be computed that needs all of its inputs.

        Args:
            inputs: Tracks that it is computed from.
            others: Times of further inputs [ns].

        Returns:
            The earliest of the inputs' last times, but no more than the patience before the newest
            sample of all [ns].
        """
        ends = [int(track.t_ns[-1]) for tracks in inputs for track in tracks if track.t_ns.size]
        ends += [int(t_ns[-1]) for t_ns in others if t_ns.size]
        return max(min(ends, default=0), self._newest_ns - PATIENCE_NS)


class Fresh:
    """Remembers up to where something has been drawn."""

    def __init__(self) -> None:
        """Nothing has been drawn."""
        self._until_ns: dict[str, int] = {}

    def rows(self, name: str, t_ns: IntArray, upto_ns: int | None = None) -> slice:
        """Which samples are new; they count as drawn from now on.

        Args:
            name: What they are of.
            t_ns: Their times [ns], ascending, shape (n,).
            upto_ns: The last time that can be drawn [ns]; None for all.

        Returns:
            The new rows.
        """
        start = int(np.searchsorted(t_ns, self._until_ns.get(name, -1), side="right"))
        stop = t_ns.size
        if upto_ns is not None:
            stop = int(np.searchsorted(t_ns, upto_ns, side="right"))
        if stop > start:
            self._until_ns[name] = int(t_ns[stop - 1])
        return slice(start, max(start, stop))

    def tracks(
        self, name: str, tracks: Iterable[Track], upto_ns: int | None = None
    ) -> tuple[Track, ...]:
        """The new samples of tracks.

        Args:
            name: What they are of.
            tracks: The tracks.
            upto_ns: The last time that can be drawn [ns]; None for all.

        Returns:
            Those that have new samples, with these only.
        """
        found: list[Track] = []
        for track in tracks:
            rows = self.rows(f"{name}/{track.name}", track.t_ns, upto_ns)
            if rows.stop > rows.start:
                found.append(Track(track.name, track.t_ns[rows], track.values[rows]))
        return tuple(found)


def _grown(
    old: tuple[IntArray, FloatArray] | None, t_ns: IntArray, values: FloatArray
) -> tuple[IntArray, FloatArray]:
    """New samples after those of the last seconds before them."""
    if old is None or not t_ns.size:
        return (t_ns, values) if old is None else old
    first = int(np.searchsorted(old[0], int(t_ns[0]) - KEPT_NS))
    return ordered(np.concatenate([old[0][first:], t_ns]), np.concatenate([old[1][first:], values]))


def _joined(old: HeadPath | None, new: HeadPath) -> HeadPath:
    kept = None
    if old is not None:
        kept = old.t_ns, np.concatenate([old.position, old.quaternion], axis=1)
    pose = np.concatenate([new.position, new.quaternion], axis=1)
    t_ns, pose = _grown(kept, new.t_ns, pose)
    return HeadPath(t_ns, pose[:, :3], pose[:, 3:], tracked=True)
