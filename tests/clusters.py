"""A SLURM of two nodes on this machine (scripts/slurm), for tests; without SLURM they skip."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "slurm"
PROGRAMS = ("slurmctld", "slurmd", "munged", "sbatch")
ENDED = {"COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "OUT_OF_MEMORY", "NODE_FAIL"}


def missing() -> str | None:
    """Why there can be no SLURM here; None if there can."""
    path = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    absent = [name for name in PROGRAMS if shutil.which(name, path=path) is None]
    return f"SLURM is not installed: there is no {', '.join(absent)}" if absent else None


class Cluster:
    """The SLURM in a directory of its own."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.processes: list[subprocess.Popen[bytes]] = []  # that end with it
        names = [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
        paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
        self.environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("SLURM_", "RBFEVO_"))},
            "PATH": os.pathsep.join(names),
            "PYTHONPATH": os.pathsep.join(path for path in paths if path),
            "OMP_NUM_THREADS": "1",
        }

    def command(self, *words: str) -> list[str]:
        """What runs a command with this SLURM."""
        return [str(SCRIPT), "run", str(self.place), *words]

    def ask(self, *words: str, cwd: Path = ROOT) -> str:
        """The output of a command of SLURM's."""
        done = subprocess.run(
            self.command(*words), cwd=cwd, env=self.environment, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def start(self) -> None:
        """Start it, or what has died of it."""
        done = subprocess.run([SCRIPT, "start", self.place], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr

    def stop(self) -> None:
        """Cancel its jobs and stop it."""
        done = subprocess.run([SCRIPT, "stop", self.place], capture_output=True, text=True, timeout=180)
        assert done.returncode == 0, done.stderr

    def kill_controller(self) -> None:
        """Kill slurmctld, as a power cut does."""
        os.kill(int((self.place / "slurmctld.pid").read_text()), signal.SIGKILL)

    def cut_power(self, node: str) -> None:
        """Kill a node and all jobs, and tell SLURM that the node is down, which it notices itself after minutes."""
        own, processes = f"SLURM_CONF={self.place / 'slurm.conf'}", [int((self.place / f"{node}.pid").read_text())]
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                environment = (path / "environ").read_bytes().decode(errors="replace").split("\0")
                of_job = any(line.startswith("SLURM_JOB_ID=") for line in environment)
                if own in environment and (of_job or (path / "cmdline").read_bytes().startswith(b"slurmstepd")):
                    processes.append(int(path.name))
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        self.ask("scontrol", "update", f"NodeName={node}", "State=down", "Reason=test")

    def start_node(self, node: str) -> None:
        """Start a node again that has failed; SLURM then takes it back."""
        (self.place / f"{node}.pid").unlink(missing_ok=True)
        self.start()

    def states(self) -> dict[str, str]:
        """The states of all jobs, by their ids, such as 12 or 12_3."""
        lines = self.ask("squeue", "--noheader", "--array", "--states=all", "--format=%i %T").splitlines()
        return dict(line.split() for line in lines)

    def submit(self, *words: str, cwd: Path) -> str:
        """Hand a batch script to sbatch; the job's id."""
        return self.ask("sbatch", "--parsable", *words, cwd=cwd).strip()

    def start_again_now(self, job: str) -> None:
        """Wait until a job is back in the queue, and take back the two minutes that SLURM lets it wait there."""

        def delayed() -> bool:
            return "BeginTime" in self.ask("squeue", "--noheader", f"--jobs={job}", "--states=pending", "--format=%r")

        def released() -> bool:
            if delayed():
                self.ask("scontrol", "update", f"JobId={job}", "StartTime=now")
                time.sleep(3)  # as long as the job's last processes are ending, SLURM sets the time anew
            return not delayed()

        until(delayed, f"job {job} is in the queue again")
        until(released, f"job {job} need not wait")


@contextlib.contextmanager
def running() -> Iterator[Cluster]:
    """A SLURM that runs meanwhile; the test skips where there can be none."""
    reason = missing()
    if reason is not None:
        pytest.skip(reason)
    with tempfile.TemporaryDirectory(prefix="slurm-") as name:  # short: it holds sockets
        cluster = Cluster(Path(name))
        try:
            cluster.start()
            yield cluster
        finally:
            for process in cluster.processes:
                process.kill()
                process.wait()
            cluster.stop()


def until(holds: Callable[[], bool], what: str, seconds: float = 300) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"not within {seconds:.0f} s: {what}"
        time.sleep(0.2)
