"""Layout of help: paragraphs filled to the terminal's width, code between backticks styled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions
    from rich.text import Text


class HelpLayout:
    """Formatter for cyclopts; as for Markdown whose only marks are backticks and empty lines.

    Importing the parser of Markdown takes longer than all else of a help.
    """

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print a panel of commands or parameters."""
        from cyclopts.help import DefaultFormatter

        for entry in panel.entries:
            _fill(entry.description)
        DefaultFormatter()(console, options, panel)

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        """Print the line of the usage."""
        from cyclopts.help import DefaultFormatter

        DefaultFormatter().render_usage(console, options, usage)

    def render_description(self, console: Console, _: ConsoleOptions, description: Any) -> None:
        """Print the description of a command."""
        _fill(description)
        console.print(description)


def _fill(description: Any) -> None:
    """Lay out the plain text that an ``InlineText`` of cyclopts holds."""
    plain = getattr(getattr(description, "primary_renderable", None), "plain", None)
    if plain is not None:
        description.primary_renderable = filled(plain)


def filled(text: str) -> Text:
    """Return a text with a line for each paragraph and a style for code."""
    from rich.text import Text

    paragraphs = (" ".join(paragraph.split()) for paragraph in text.strip().split("\n\n"))
    styled = Text()
    for k, part in enumerate("\n\n".join(paragraphs).split("`")):
        styled.append(part, "markdown.code" if k % 2 else "")
    return styled
