"""Files of a run directory appear whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from rbfevo.errors import UserError
from rbfevo.runs import storage


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    for content in (b"first", b"second, longer"):
        storage.write_whole(path, content)
        assert path.read_bytes() == content
    assert [entry.name for entry in tmp_path.iterdir()] == ["summary.json"]


@pytest.mark.parametrize("broken", ["write", "fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "setups.npz"
    storage.write_whole(path, b"old")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if broken == "replace":
        monkeypatch.setattr(Path, "replace", full)
    elif broken == "fsync":
        monkeypatch.setattr(os, "fsync", full)
    else:
        real = os.fdopen
        monkeypatch.setattr(os, "fdopen", lambda descriptor, mode: Broken(real(descriptor, mode)))
    with pytest.raises(UserError, match=r"setups\.npz cannot be written: No space left on device"):
        storage.write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["setups.npz"]


class Broken:
    """A file on a full disk."""

    def __init__(self, file) -> None:
        self.file = file

    def __enter__(self) -> Broken:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def write(self, _: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_directory_that_is_gone_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^[^\n]*gone[^\n]*cannot be written: No such file or directory$"):
        storage.write_whole(tmp_path / "gone" / "history.csv", b"")


@pytest.mark.parametrize("name", storage.RESULTS)
def test_a_directory_with_any_result_is_refused(name: str, tmp_path: Path) -> None:
    storage.refuse_results(tmp_path)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(UserError, match="already holds results"):
        storage.refuse_results(tmp_path)


def test_archives_need_no_pickle(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    storage.write_whole(path, storage.npz({"method": np.array(["nsga2", "ols"]), "x": np.arange(3.0)}))
    with np.load(path, allow_pickle=False) as archive:
        assert archive["method"].tolist() == ["nsga2", "ols"]
        np.testing.assert_array_equal(archive["x"], [0.0, 1.0, 2.0])


def test_csv_keeps_every_digit_and_leaves_nan_empty() -> None:
    text = storage.csv_text(["a", "b"], [(1 / 3, float("nan")), (5e-324, 2)]).decode()
    assert text == f"a,b\n{1 / 3!r},\n5e-324,2\n"
