"""Sentences of results as the page sets them: units stay with their numbers, powers are raised."""

from __future__ import annotations

import re
from collections.abc import Iterable

from markupsafe import Markup, escape

from undulog.capture.common.console import plain

from ...results import formats


def element(name: str, *children: object, **attributes: object) -> Markup:
    """One element.

    Args:
        name: Of the element.
        children: Elements, or text, which is escaped.
        attributes: By name; ``class_`` is ``class``, other underscores are hyphens; what is None
            is left out, numbers keep two decimals.

    Returns:
        The element as text.
    """
    told = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(_value(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{name}{told}>{joined(children)}</{name}>")  # noqa: S704  escaped here


def joined(children: Iterable[object]) -> Markup:
    """Elements and text, one behind the other.

    Args:
        children: Elements, or text, which is escaped.

    Returns:
        The text.
    """
    return Markup("").join(
        child if isinstance(child, Markup) else escape(plain(str(child))) for child in children
    )


def _value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.2f}".rstrip("0").rstrip(".")
    return plain(str(value))


NO_BREAK = "\N{NO-BREAK SPACE}"

_UNIT = re.compile(r"(?<=\d) (?=(?:%|Hz|J|s|rad|mm|N m|kB)(?![\w]))")
_P = re.compile(r"\bp ([<=]) ")
_INVERSE = "\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ONE}"


def typeset(text: str) -> str:
    """Plain text for a paragraph.

    Args:
        text: From a log or a result.

    Returns:
        The same words; no line ends between a number and its unit, and ``H^-1`` is raised.
    """
    known = _UNIT.sub(NO_BREAK, plain(text).replace("^-1", _INVERSE))
    return _P.sub(rf"p{NO_BREAK}\1{NO_BREAK}", known)


def sentence(text: str) -> str:
    """A sentence from a log or a result.

    Args:
        text: With or without a capital and a full stop.

    Returns:
        With both, typeset.
    """
    return typeset(formats.sentence(text))


def softer(text: str) -> Markup:
    """Set the intervals of a sentence smaller, so that the sentence is read first.

    Args:
        text: Intervals in square brackets.

    Returns:
        Markup, escaped.
    """
    escaped = str(escape(typeset(text)))
    parts: list[str] = []
    rest = escaped
    while (start := rest.find("[")) >= 0 and (stop := rest.find("]", start)) >= 0:
        parts += [rest[:start], '<span class="ci">', rest[start : stop + 1], "</span>"]
        rest = rest[stop + 1 :]
    return Markup("".join([*parts, rest]))  # noqa: S704  escaped above


def cut(text: str, most: int = 130) -> str:
    """The beginning of a long sentence.

    Args:
        text: Any.
        most: Characters kept at most.

    Returns:
        Up to a whole word, with an ellipsis where something is left out.
    """
    if len(text) <= most:
        return text
    return text[:most].rpartition(" ")[0] + " \N{HORIZONTAL ELLIPSIS}"


def digits(value: float) -> str:
    """A number of any size with two digits.

    Args:
        value: Any unit.

    Returns:
        For example ``0.026`` or ``3.4e−9``.
    """
    return f"{value:.2g}".replace("-", formats.MINUS)
