"""Notebooks of the manual, run anew, as its pages: `python docs/notebook_page.py [NOTEBOOK]`.

Cells are run here as a notebook runs them, in one namespace and with the value of a last expression
shown, so the manual needs no kernel and no packages besides those of the project.
"""

import ast
import json
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

NOTEBOOK = Path(__file__).parent / "notebook.ipynb"
GALLERY = sorted((Path(__file__).parent / "gallery").glob("*.ipynb"))
"""Worked examples, which make their own data."""


def executed_page(notebook: Path = NOTEBOOK) -> str:
    """Run a notebook.

    Args:
        notebook: The file, format 4.

    Returns:
        MyST Markdown: text, code, and what each cell printed and showed.

    Raises:
        Exception: Whatever a cell raises.
    """
    namespace: dict[str, Any] = {"__name__": "__main__"}
    parts: list[str] = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        printed, value = run_cell(source, namespace)
        parts.append(f"```python\n{source}\n```")
        if printed:
            parts.append(f"```text\n{printed.rstrip()}\n```")
        if value is not None:
            parts.append(_shown(value))
    link = f"{{download}}`The notebook itself <{notebook.name}>`"
    return "\n\n".join([*parts, link]) + "\n"


def run_cell(source: str, namespace: dict[str, Any]) -> tuple[str, Any]:
    """Run one cell.

    Args:
        source: Its code.
        namespace: Of all cells; changed.

    Returns:
        What it printed, and the value of its last line if that is an expression.
    """
    tree = ast.parse(source)
    last = tree.body[-1] if tree.body else None
    value = None
    with redirect_stdout(StringIO()) as printed:
        if isinstance(last, ast.Expr):
            tree.body.pop()
        exec(compile(tree, "<cell>", "exec"), namespace)  # noqa: S102  our own notebook
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), namespace)  # noqa: S307
    return printed.getvalue(), value


def _shown(value: Any) -> str:
    html = getattr(value, "_repr_html_", None)
    if html is None:
        return f"```text\n{value!r}\n```"
    return f'````{{raw}} html\n<div class="output">{html()}</div>\n````'


if __name__ == "__main__":
    print(executed_page(*map(Path, sys.argv[1:2])))
