"""ROS 2 bags in SQLite: ``.db3``.

A database is a program too: a view or a computed column may run for ever and make GiB of nothing.
So only tables of plain columns are read, messages are of bounded length, and the steps of SQLite
are counted.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from ..base.errors import ReadError
from .recordings import MAX_MESSAGES, Bag, counted_topics
from .unpacking import allowance

TABLES = ("topics", "messages")

MAX_LENGTH = 10**9
"""Bytes of the longest message, SQLite's own limit; none is longer than its file."""

MAX_TOPICS = 10_000
"""More are not read."""

STEPS, STEPS_PER_BYTE, STEPS_COUNTED = 1_000_000, 5, 10_000
"""Steps that SQLite may take: so many, and so many per byte of the file; and between two counts.
To count and to sort the messages takes about 30 steps for each, which has 20 bytes at least."""


@contextmanager
def open_sqlite(path: Path) -> Iterator[Bag]:
    """Open a bag in SQLite.

    Raises
    ------
    ReadError
        Where its topics and messages are not plain tables, or where to read it takes more than a
        file of its size can need.
    """
    size = path.stat().st_size
    # An address, since only that can say that the file does not change; as_uri quotes the path.
    address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(address, uri=True)) as database:
        database.text_factory = lambda text: text.decode(errors="replace")
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(size, MAX_LENGTH))
        database.execute("PRAGMA trusted_schema=OFF")
        with _counted_steps(size, database):
            _check_tables(database)
            topics = database.execute(
                f"SELECT id, {_text('name')}, {_text('type')} FROM topics LIMIT ?", [MAX_TOPICS + 1]
            ).fetchall()
            counts = dict(
                database.execute(
                    "SELECT topic_id, count(*) FROM messages GROUP BY topic_id LIMIT ?",
                    [MAX_TOPICS + 1],
                )
            )
            if max(len(topics), len(counts)) > MAX_TOPICS or sum(counts.values()) > MAX_MESSAGES:
                raise ReadError(
                    f"has {sum(counts.values()):,} messages and {len(topics):,} topics, up to "
                    f"{MAX_MESSAGES:,} and {MAX_TOPICS:,} are read; 'ros2 bag convert' splits it"
                )

            def messages(name: str, kind: str) -> Iterator[tuple[int, bytes, str]]:
                own = [number for number, *key in topics if key == [name, kind]]
                # Only what is short is sorted; the messages are fetched one by one.
                rows = database.execute(
                    "SELECT rowid, timestamp FROM messages "
                    f"WHERE topic_id IN ({','.join('?' * len(own))}) ORDER BY timestamp, rowid",
                    own,
                ).fetchall()
                spend = allowance(size)
                for row, stamp in rows:
                    found = database.execute("SELECT data FROM messages WHERE rowid = ?", [row])
                    data = bytes(found.fetchone()[0])
                    spend(len(data))
                    yield stamp, data, "cdr"

            yield Bag(
                counted_topics(
                    (name, kind, counts.get(number, 0)) for number, name, kind in topics
                ),
                messages,
            )


def _text(column: str) -> str:
    """Take the text of a column, whatever is in it: SQLite lets any value be of any type."""
    return f"substr(CAST(coalesce({column}, '') AS TEXT), 1, 1000)"


def _check_tables(database: sqlite3.Connection) -> None:
    """Refuse topics or messages that are computed when they are read."""
    for name in TABLES:
        # SQLite goes by this text and not by the type that stands beside it.
        found = database.execute(
            "SELECT sql FROM sqlite_master WHERE lower(name) = ? LIMIT 1", [name]
        ).fetchone()
        if found is None:
            raise ReadError(f"is a database without the table {name}, expected a bag")
        hidden = [row[6] for row in database.execute(f"PRAGMA table_xinfo({name})")]
        if not re.match(r"CREATE\s+TABLE\s", str(found[0]), re.IGNORECASE) or any(hidden):
            raise ReadError(
                f"{name} is not a table of plain columns but computed when it is read, which no "
                "recorder writes"
            )


@contextmanager
def _counted_steps(size: int, database: sqlite3.Connection) -> Iterator[None]:
    """Stop SQLite where it takes more steps than a file of that size can need, and by Ctrl-C."""
    left = (STEPS + STEPS_PER_BYTE * size) // STEPS_COUNTED

    def is_over() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    database.set_progress_handler(is_over, STEPS_COUNTED)
    try:
        yield
    except sqlite3.OperationalError as error:
        if "interrupted" not in str(error):
            raise
        if left >= 0:  # by what was raised while it counted, which sqlite3 swallows
            raise KeyboardInterrupt from None
        raise ReadError(
            f"to read it takes more steps than a database of {size:,} bytes can need: it is "
            "damaged, or computes what it holds"
        ) from None
