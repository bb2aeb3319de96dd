"""The pages of the manual that are made from the code, written when Sphinx begins.

``.venv/bin/python docs/reference_pages.py`` also writes the JSON Schemas of the results, which
ship with the package: ``make schemas``.
"""

import json
import os
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from result_schemas import RESULTS, result_schema

import undulog

REFERENCE = Path(__file__).parent / "reference"
SCHEMAS = Path(__file__).parents[1] / "analysis/results/schemas"


def write_pages() -> None:
    """Write the pages of the command line and of the results."""
    (REFERENCE / "command-line.md").write_text(command_line_page())
    for name in RESULTS:
        (REFERENCE / f"result-{name}.md").write_text(result_page(result_schema(name)))


def command_line_page() -> str:
    """Return the help of every command, as the terminal shows it."""
    os.environ["COLUMNS"] = "84"
    parts = [
        "# Command line",
        "",
        (
            "One command, `undulog`. Exit codes: 0 done, 1 the work failed (also: a file that "
            "isn't there), 2 wrong usage (also: a name that nothing has). Nothing is overwritten "
            "without `--force`; Ctrl-C and SIGTERM leave a readable file. Bars of progress go to "
            "stderr, and only on a terminal."
        ),
        "",
    ]
    for verb in undulog.VERBS:
        shown = StringIO()
        with redirect_stdout(shown):
            undulog.run([*verb.split(), "--help"])
        parts += [f"## {verb}", "", "```text", shown.getvalue().rstrip(), "```", ""]
    return "\n".join(parts)


def result_page(schema: dict[str, Any]) -> str:
    """Return the keys of a result and of the records in it, as tables."""
    name = schema["$id"].split(":")[-2]
    command = schema["title"].removeprefix("What ").partition(" prints")[0]
    file = f"../../analysis/results/schemas/{schema_file(schema)}"
    link = f"{{download}}`The JSON Schema <{file}>`, `{schema['$id']}`."
    parts = [f"# The {name}", "", f"What `{command}` prints. {link}", "", *_table(schema, name)]
    for kind, record in schema["$defs"].items():
        parts += ["", f"({_anchor(name, kind)})=", "", f"**{kind}.** {record['description']}", ""]
        parts += _table(record, name)
    return "\n".join(parts) + "\n"


def schema_file(schema: dict[str, Any]) -> str:
    """Return the name of a schema's file, with its version."""
    _, _, name, version = schema["$id"].split(":")
    return f"{name}.{version}.json"


def _table(record: dict[str, Any], page: str) -> list[str]:
    rows = [
        f"| `{key}` | {_kind(schema, page)} | {_cell(schema.get('description', ''))} |"
        for key, schema in record["properties"].items()
    ]
    return ["| key | type | what |", "|---|---|---|", *rows]


def _cell(text: str) -> str:
    return text.replace("|", r"\|").replace("*", r"\*").replace("_", r"\_")


def _kind(schema: dict[str, Any], page: str) -> str:
    """Return the type of a value in a few words."""
    if "$ref" in schema:
        kind = schema["$ref"].rpartition("/")[2]
        return f"[{kind}](#{_anchor(page, kind)})"
    if "anyOf" in schema:
        return " or ".join(_kind(choice, page) for choice in schema["anyOf"])
    if "enum" in schema:
        return "one of " + ", ".join(f"`{value}`" for value in schema["enum"])
    names = schema.get("type", "any")
    first, *rest = [names] if isinstance(names, str) else names
    if "items" in schema and "maxItems" in schema:
        first = f"{schema['maxItems']} of {_kind(schema['items'], page)}"
    elif "items" in schema:
        first = f"list of {_kind(schema['items'], page)}"
    elif "prefixItems" in schema:
        first = f"[{', '.join(_kind(entry, page) for entry in schema['prefixItems'])}]"
    elif first == "object" and schema.get("additionalProperties"):
        first = f"by name: {_kind(schema['additionalProperties'], page)}"
    return " or ".join([first, *rest])


def _anchor(page: str, kind: str) -> str:
    return f"{page}-{kind}".lower()


def main() -> None:
    """Write the schemas that ship with the package."""
    for name in RESULTS:
        schema = result_schema(name)
        file = SCHEMAS / schema_file(schema)
        file.write_text(json.dumps(schema, indent=1) + "\n")
        print(file)


if __name__ == "__main__":
    main()
