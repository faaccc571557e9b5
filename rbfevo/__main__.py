"""`python -m rbfevo`: carry out one run or a sweep."""

from __future__ import annotations

from collections.abc import Sequence

from rbfevo.commands import parsers


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 for a user's mistake, 130, 143, or 1."""

    def launched() -> int:
        from rbfevo.commands.launch import launch  # with Hydra, which takes a while: Ctrl-C is one line meanwhile

        return launch(arguments)

    return parsers.outcome("rbfevo", launched)


if __name__ == "__main__":
    parsers.start(main)
