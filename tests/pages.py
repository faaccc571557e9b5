"""The commands of the documentation's pages, carried out."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def blocks(page: str) -> list[str]:
    """The blocks of shell commands of a page of docs/."""
    return re.findall(r"```sh\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)


def carried_out(block: str, where: Path) -> str:
    """Run a block in a directory where `python` and the examples are those of here; what it prints."""
    (where / "bin").mkdir()
    (where / "bin" / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    (where / "bin" / "python").chmod(0o755)
    (where / "examples").symlink_to(ROOT / "examples")
    path = os.pathsep.join([str(where / "bin"), os.environ["PATH"]])
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PATH": path, "OMP_NUM_THREADS": "1"}
    if Path("/usr/share/openfoam").is_dir():
        environment.setdefault("WM_PROJECT_DIR", "/usr/share/openfoam")
    command = ["bash", "-c", block]
    done = subprocess.run(command, cwd=where, env=environment, capture_output=True, text=True, timeout=900)
    assert "rbfevo" not in done.stderr, done.stderr
    return done.stdout
