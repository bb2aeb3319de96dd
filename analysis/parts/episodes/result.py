"""What is wrong with the episodes of a data set."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class EpisodeFault:
    """What is wrong with an episode.

    Attributes:
        episode: Its number in the data set.
        kind: ``offset``, ``gain``, ``delay``, ``frozen``, ``stand-still``, ``dropped``,
            ``doubled``, ``rate``, or ``missing``.
        joint: None where it is the whole episode's.
        size: Of an offset in the unit of the states; of a gain or a rate the factor to the other
            episodes'; of a delay in seconds; of frames their number; of what stands the motion that
            it should have followed.
        unit: Of the size; empty for a factor or a number.
        ci95: Interval of the size; None where there is none.
        times: How often the deviation is what sound episodes may have, in whose order the table is;
            None, and first, where the record shows the fault without a comparison.
        at_s: Where in the episode [s]; None for all of it.
        sentence: The same in words.
        not_decided: Another kind that explains as much; empty if none does.
    """

    episode: int
    kind: str
    joint: str | None
    size: float
    unit: str
    ci95: tuple[float, float] | None
    times: float | None
    at_s: float | None
    sentence: str
    not_decided: str = ""


@dataclass(frozen=True)
class EpisodesResult:
    """The table of a data set's episodes.

    Attributes:
        name: Of the data set.
        fps: Frames a second, as stated.
        unit: Of the angles, as far as the values show it.
        episodes: Number of episodes.
        frames: Number of frames.
        joints: Their names.
        lag_s: Lag that all episodes share, by joint [s].
        faults: Worst first.
        not_judged: Why not, by the number of the episode.
        leave_out: Numbers of the episodes that have a fault, in order.
        limits: What can't be seen in this data set, in sentences.
    """

    name: str
    fps: float
    unit: str
    episodes: int
    frames: int
    joints: tuple[str, ...]
    lag_s: tuple[float, ...]
    faults: tuple[EpisodeFault, ...]
    not_judged: dict[str, str]
    leave_out: tuple[int, ...]
    limits: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON has it."""
        return asdict(self)
