"""Start the worker: `python -P __main__.py KIND FILE`, by its path."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

PACKAGE = Path(__file__).resolve().parents[2]


def enter() -> None:
    """Make `rbfevo.meshes.worker` importable without what `rbfevo/meshes/__init__.py` imports.

    That would take longer than to import VTK, for each file anew; and rbfevo need not be where Python looks for it.
    """
    for name, directory in (("rbfevo", PACKAGE), ("rbfevo.meshes", PACKAGE / "meshes")):
        package = ModuleType(name)
        package.__path__ = [str(directory)]
        sys.modules[name] = package


if __name__ == "__main__":
    enter()
    from rbfevo.meshes.worker.serve import serve

    serve(sys.argv[1], Path(sys.argv[2]))
