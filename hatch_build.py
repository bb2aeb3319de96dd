"""Check, before anything is built, that the package has its four folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class LinkCheck(BuildHookInterface[Any]):
    """In the repository ``undulog/`` links to the folders beside it; an sdist has them inside."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        """Raise FileNotFoundError if a folder is missing."""
        for name in ("analysis", "capture", "replay", "sim"):
            if not Path(self.root, "undulog", name).is_dir():
                raise FileNotFoundError(
                    f"undulog/{name} is not a folder: this copy of the source has lost its "
                    "symbolic links. Clone with `git -c core.symlinks=true clone`, or build from "
                    "the source archive (sdist), which has none."
                )
