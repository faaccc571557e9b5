"""Disks that are full, directories that go away: one clear line, and what is on disk stays valid."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from test_resume import KilledError, arrays, assert_same, kill_after, settings

from rbfevo.errors import UserError
from rbfevo.files import clear_unfinished, write_whole
from rbfevo.runs import checkpoint, run


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def at_step(monkeypatch: pytest.MonkeyPatch, number: int, act: Callable[[], Any]) -> None:
    """Do something when the run has taken so many steps."""
    from rbfevo.runs.journal import Journal

    count, real = 0, Journal.record

    def record(self: Journal, records: Any) -> None:
        nonlocal count
        count += 1
        real(self, records)
        if count == number:
            act()

    monkeypatch.setattr(Journal, "record", record)


class FullDisk:
    """Every write to a file fails once this is `full`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full, real = False, os.fsync

        def fsync(descriptor: int) -> None:
            if self.full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            real(descriptor)

        monkeypatch.setattr(os, "fsync", fsync)


def test_a_disk_that_is_full_for_a_while_does_no_harm(tmp_path, monkeypatch, capsys):
    run.carry_out(settings("nsga2"), tmp_path / "calm")
    disk = FullDisk(monkeypatch)
    at_step(monkeypatch, 3, lambda: setattr(disk, "full", True))
    at_step(monkeypatch, 5, lambda: setattr(disk, "full", False))
    assert run.carry_out(settings("nsga2", quiet=False), tmp_path / "run") == 0
    assert_same(tmp_path / "run", tmp_path / "calm")
    assert capsys.readouterr().out.count("No space left on device") == 1


def test_a_full_disk_leaves_no_method_out(tmp_path, monkeypatch):
    run.carry_out(settings("panel"), tmp_path / "calm")
    monkeypatch.setattr("rbfevo.runs.journal.BUFFER", 10)
    disk = FullDisk(monkeypatch)
    at_step(monkeypatch, 2, lambda: setattr(disk, "full", True))
    at_step(monkeypatch, 6, lambda: setattr(disk, "full", False))
    assert run.carry_out(settings("panel"), tmp_path / "run") == 0
    assert_same(tmp_path / "run", tmp_path / "calm")


def test_a_run_that_broke_down_before_its_first_checkpoint_begins_anew(tmp_path, monkeypatch):
    run.carry_out(settings("nsga2"), tmp_path / "calm")

    def breaks() -> None:
        raise RuntimeError("a bug")

    with monkeypatch.context() as patch:
        at_step(patch, 3, breaks)
        with pytest.raises(RuntimeError, match="a bug"):
            run.carry_out(settings("nsga2", None), tmp_path / "run")
    assert arrays(tmp_path / "run")
    assert run.carry_out(settings("nsga2"), tmp_path / "run", resume=True) == 0
    assert_same(tmp_path / "run", tmp_path / "calm")


def test_a_disk_that_stays_full_is_one_line_and_the_run_goes_on_later(tmp_path, monkeypatch):
    run.carry_out(settings("nsga2"), tmp_path / "calm")
    with monkeypatch.context() as patch:
        disk = FullDisk(patch)
        at_step(patch, 4, lambda: setattr(disk, "full", True))
        with pytest.raises(UserError, match="No space left on device") as error:
            run.carry_out(settings("nsga2"), tmp_path / "run")
    assert "\n" not in str(error.value)
    assert int(checkpoint.load(tmp_path / "run")["progress"]["step"]) == 3
    assert run.carry_out(settings("nsga2"), tmp_path / "run", resume=True) == 0
    assert_same(tmp_path / "run", tmp_path / "calm")


def test_a_disk_that_is_full_at_the_end_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    run.carry_out(settings("cmaes"), tmp_path / "calm")
    with monkeypatch.context() as patch:
        disk = FullDisk(patch)
        patch.setattr(
            run.Run, "rescore", lambda self, centers: setattr(disk, "full", True) or self.full_evaluator(centers)
        )
        with pytest.raises(UserError, match="No space left on device"):
            run.carry_out(settings("cmaes"), tmp_path / "run")
    assert not (tmp_path / "run" / "setups.npz").exists()
    assert run.carry_out(settings("cmaes"), tmp_path / "run", resume=True) == 0
    assert_same(tmp_path / "run", tmp_path / "calm")


def test_a_directory_that_goes_away_is_one_line(tmp_path, monkeypatch):
    at_step(monkeypatch, 3, lambda: shutil.rmtree(tmp_path / "run"))
    with pytest.raises(UserError, match="cannot be written: No such file or directory") as error:
        run.carry_out(settings("nsga2"), tmp_path / "run")
    assert "\n" not in str(error.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_directory_that_becomes_read_only_is_one_line(tmp_path, monkeypatch):
    at_step(monkeypatch, 3, lambda: (tmp_path / "run").chmod(0o500))
    with pytest.raises(UserError, match="Permission denied"):
        run.carry_out(settings("nsga2"), tmp_path / "run")
    (tmp_path / "run").chmod(0o700)
    assert checkpoint.load(tmp_path / "run")["progress"]["step"] > 0


def test_a_place_that_refuses_every_write_is_one_line(tmp_path, monkeypatch):
    def refuse(*_: Any, **__: Any) -> Any:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("tempfile.mkstemp", refuse)
    with pytest.raises(UserError, match="Read-only file system"):
        run.carry_out(settings("nsga2"), tmp_path / "run")


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of 100 kB."""
    place = tmp_path / "small"
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(place)], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {done.stderr.strip()}")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=False)


def test_a_small_disk_runs_full(small_disk, monkeypatch):
    filler = small_disk / "filler"
    at_step(monkeypatch, 4, lambda: filler.write_bytes(bytes(shutil.disk_usage(small_disk).free)))
    with pytest.raises(UserError, match="No space left on device"):
        run.carry_out(settings("nsga2"), small_disk / "run")
    assert int(checkpoint.load(small_disk / "run")["progress"]["step"]) >= 3
    monkeypatch.undo()
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])
    filler.unlink()
    assert run.carry_out(settings("nsga2"), small_disk / "run", resume=True) == 0
    assert len(arrays(small_disk / "run")["method"])


def test_what_a_killed_writer_left_is_cleared_away(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        kill_after(patch, 3)
        with pytest.raises(KilledError):
            run.carry_out(settings("nsga2"), tmp_path)
    left = tmp_path / ".checkpoint.npz.abcd1234"
    left.write_bytes(b"half")
    mine = tmp_path / ".gitignore"
    mine.write_text("*")
    run.carry_out(settings("nsga2"), tmp_path, resume=True)
    assert not left.exists()
    assert mine.exists()


def test_only_unfinished_files_are_cleared_away(tmp_path):
    names = [".setups.npz.x1y2z3_4", ".note", "setups.npz", ".history.csv", ".lock", ".report.html.12345678"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    clear_unfinished(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([".note", "setups.npz", ".history.csv", ".lock"])


@pytest.mark.parametrize("moment", ["open", "write", "fsync", "replace"])
def test_a_file_is_whole_whenever_the_writer_dies(moment, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.npz"
    write_whole(path, b"old")

    class DiedError(BaseException):
        pass

    def die(*_: Any, **__: Any) -> Any:
        raise DiedError

    target = {"open": (os, "fdopen"), "write": (os, "fdopen"), "fsync": (os, "fsync"), "replace": (Path, "replace")}[
        moment
    ]
    monkeypatch.setattr(*target, die)
    with pytest.raises(DiedError):
        write_whole(path, b"new, and longer")
    assert path.read_bytes() == b"old"
