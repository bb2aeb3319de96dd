"""Elements of SVG and HTML as text, everything in them escaped."""

from __future__ import annotations

from collections.abc import Iterable

from markupsafe import Markup, escape

from undulog.capture.common.console import plain


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
