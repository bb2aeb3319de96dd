"""Description files that ship with the code, found by name; others by path."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from .errors import Fault, FaultyFileError, UsageError
from .input_file import is_file, read_input
from .strict_table import listed


@dataclass(frozen=True)
class Description:
    """The text of a description and where it comes from.

    Attributes:
        text: The TOML text.
        source: For messages.
        folder: Where its companions lie.
    """

    text: str
    source: Path
    folder: Traversable


@dataclass(frozen=True)
class Shelf:
    """One kind of description.

    Attributes:
        kind: What it is called in messages, e.g. ``robot``.
        package: The package that ships them.
        folder: The folder in that package.
        error: Raised for a file that is no text.
    """

    kind: str
    package: str
    folder: str
    error: type[FaultyFileError]

    def names(self) -> tuple[str, ...]:
        """Names of the shipped ones, sorted."""
        entries = (Path(entry.name) for entry in self._place().iterdir())
        return tuple(sorted(entry.stem for entry in entries if entry.suffix == ".toml"))

    def read(self, name_or_path: str | Path) -> Description:
        """Read a shipped description by name, or a file by path.

        Args:
            name_or_path: One of :meth:`names`, or the path of a TOML file.

        Returns:
            Its text.

        Raises:
            UsageError: If there is none of that name.
            InputFileError: If it is a path, and the file isn't there or can't be read.
            FaultyFileError: If the file is not UTF-8 (the shelf's own kind of it).
        """
        if str(name_or_path) in self.names():
            place = self._place()
            text = (place / f"{name_or_path}.toml").read_text(encoding="utf-8")
            return Description(text, Path(f"{name_or_path}.toml"), place)
        path = Path(name_or_path)
        is_path = bool(path.suffix) or len(path.parts) > 1
        if not is_path and not is_file(path):
            near = listed(self.names(), str(name_or_path))
            raise UsageError(f"no {self.kind} {str(name_or_path)!r}: not a file, nor one of {near}")
        try:
            return Description(read_input(path).decode("utf-8"), path, path.parent)
        except UnicodeDecodeError as error:
            fault = Fault(f"byte {error.start}", "not UTF-8", "TOML is UTF-8 text")
            raise self.error(path, [fault]) from error

    def _place(self) -> Traversable:
        return resources.files(self.package) / self.folder
