"""Names of joints in one message, each of them once.

Nothing in a JointState or a trajectory forbids two joints with one name, and descriptions that were
copied have them. Whoever looks a joint up by its name would get one of the two. So the second one
is read as ``NAME (2)``, the third as ``NAME (3)``: each keeps its values, and a
reader of the log gets a warning.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def distinct_names(names: Sequence[str]) -> tuple[str, ...]:
    """Number the names that are there already.

    Args:
        names: Of a message, m of them.

    Returns:
        The names, m of them, no two alike.
    """
    given = set(names)
    if len(given) == len(names):
        return tuple(names)
    result: dict[str, None] = {}
    numbers: dict[str, int] = {}
    for name in names:
        distinct, number = name, numbers.get(name, 1)
        while distinct in result or (number > 1 and distinct in given):
            number += 1
            distinct = f"{name} ({number})"
        numbers[name] = number
        result[distinct] = None
    return tuple(result)


def several_of_one_name(names: Sequence[str]) -> dict[str, list[str]]:
    """Find the joints that :func:`distinct_names` has numbered.

    Args:
        names: Distinct names.

    Returns:
        Name in the message to the names that its further joints have here.
    """
    there = set(names)
    result: dict[str, list[str]] = {}
    for name in names:
        first, _, number = name.rpartition(" (")
        if first in there and number.removesuffix(")").isdigit():
            result.setdefault(first, []).append(name)
    return result


def one_name_sentences(lists: Iterable[Sequence[str]]) -> list[str]:
    """Say what is read where several joints have one name.

    Args:
        lists: Distinct names, by list of joints of one topic.

    Returns:
        A clause for each such name, e.g. ``2 joints are named yaw3: the second is read as
        yaw3 (2)``.
    """
    every: dict[str, dict[str, None]] = {}
    for names in lists:
        for name, further in several_of_one_name(names).items():
            every.setdefault(name, {}).update(dict.fromkeys(further))
    return [
        f"{len(further) + 1} joints are named {name}: "
        f"{'the second is' if len(further) == 1 else 'the others are'} read as {', '.join(further)}"
        for name, further in every.items()
    ]
