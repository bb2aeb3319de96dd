"""Databases of SQLite by other programs, opened so that they can't run what is in them.

A view, a virtual table, a computed column, an index on an expression or a check is a program inside
the file, and a row of it may be as large and take as long as it likes. Only plain tables are read.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Generator, Iterable
from contextlib import closing, contextmanager
from pathlib import Path

_LEAST_LENGTH = 1 << 20
"""Bytes that a value may have in a small file."""


_CHECK = re.compile(r"\bcheck\b", re.IGNORECASE)


class DatabaseError(ValueError):
    """A database that is not what it should be."""


@contextmanager
def open_database(
    path: Path, tables: Iterable[str], *, immutable: bool = True
) -> Generator[sqlite3.Connection]:
    """Open a database to be read.

    Args:
        tables: Tables that it must have, and that are plain.
        immutable: Whether to read the file alone, without the changes that a program which was
            killed left beside it.

    Yields:
        The connection; texts that are not UTF-8 are read with replacements.

    Raises:
        DatabaseError: If a table is missing or is no plain one.
        sqlite3.Error: If it is damaged.
    """
    name = f"{path.absolute().as_uri()}?mode=ro&immutable={int(immutable)}"
    with closing(sqlite3.connect(name, uri=True)) as base:
        base.text_factory = _readable
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(path.stat().st_size, _LEAST_LENGTH))
        base.execute("PRAGMA trusted_schema = OFF")
        for table in tables:
            _check_plain(base, table)
        yield base


def table_names(base: sqlite3.Connection) -> set[str]:
    """Return the names of the tables that are stored in the file."""
    rows = base.execute(
        "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"
    )
    return {str(name) for (name,) in rows}


def check_pages(base: sqlite3.Connection) -> None:
    """Read all pages: those that are part of two trees, or of themselves, have no end.

    Raises:
        DatabaseError: If one is damaged.
    """
    (verdict,) = base.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise DatabaseError(" ".join(str(verdict).split())[:200])


def _check_plain(base: sqlite3.Connection, table: str) -> None:
    if table not in table_names(base):
        raise DatabaseError(f"it has no table {table}")
    columns = base.execute("SELECT hidden FROM pragma_table_xinfo(?)", (table,))
    if any(hidden for (hidden,) in columns):
        raise DatabaseError(f"table {table} has computed columns")
    statements = base.execute(
        "SELECT sql FROM sqlite_master WHERE tbl_name = ? COLLATE NOCASE", (table,)
    )
    if any(_CHECK.search(str(sql)) for (sql,) in statements):
        raise DatabaseError(f"table {table} has a check to be computed")
    indices = base.execute("SELECT name, partial FROM pragma_index_list(?)", (table,)).fetchall()
    for index, partial in indices:
        places = base.execute("SELECT cid FROM pragma_index_xinfo(?)", (index,))
        if partial or any(place == -2 for (place,) in places):  # an expression
            raise DatabaseError(f"table {table} has an index that is computed")


def _readable(data: bytes) -> str:
    return data.decode("utf-8", "replace")
