"""Markdown paragraphs and tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence


def prose(text: str) -> str:
    """A paragraph on one line, without the line breaks and indentation of the source code."""
    return " ".join(text.split())


def table(names: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """The lines of a table."""
    yield f"| {' | '.join(names)} |"
    yield "|---" * len(names) + "|"
    for row in rows:
        yield f"| {' | '.join(str(cell) for cell in row)} |"
