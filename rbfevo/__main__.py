"""`python -m rbfevo`: configuration in, run directory out."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import traceback
import uuid
from collections.abc import Sequence
from pathlib import Path

# Hydra prints several lines and exits with 1 for its own errors unless it is told to raise them.
os.environ["HYDRA_FULL_ERROR"] = "1"

import hydra
import hydra.errors
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rbfevo import overrides
from rbfevo.errors import UserError

STATUS = "RBFEVO_STATUS"  # a directory in which every job of a sweep leaves its exit code; jobs may be other processes
SWEEP = "sweep"  # in that directory: where the sweep is, and whether it is quiet
CONF = next(path for path in (Path(__file__).parent / "conf", Path(__file__).parents[1] / "conf") if path.is_dir())


def job(config: DictConfig) -> None:
    """One job of Hydra's: never raises, so that one failed job does not end a sweep; leaves its exit code behind."""
    from rbfevo.config import check
    from rbfevo.run import carry_out

    hydra_config = HydraConfig.get()
    directory, swept = Path(hydra_config.runtime.output_dir), hydra_config.mode == RunMode.MULTIRUN
    if swept and config.get("figures") is True:
        place = Path(hydra_config.runtime.cwd, hydra_config.sweep.dir)
        Path(os.environ[STATUS], SWEEP).write_text(json.dumps([str(place), config.get("quiet") is True]))
    message = ""
    try:
        code = carry_out(check(config), directory)
    except UserError as error:
        code, message = 2, str(error)
    except KeyboardInterrupt:
        code, message = 130, "interrupted"
    except Exception as error:
        traceback.print_exc()
        code, message = 1, f"{type(error).__name__}: {error}"
    if code == 2 and sorted(path.name for path in directory.glob("*")) == [".hydra"]:
        shutil.rmtree(directory, ignore_errors=True)  # a mistake leaves no directory behind
    if message:
        where = f"{directory.name}: " if swept else ""
        print(f"rbfevo: {where}{' '.join(message.split())}", file=sys.stderr)
    Path(os.environ[STATUS], uuid.uuid4().hex).write_text(str(code))
    if code in (130, 143):
        raise KeyboardInterrupt  # whoever interrupts a sweep means all of it


def collected(directory: str, quiet: bool) -> None:
    """Make the tables and the page of a sweep, in a process of its own; what goes wrong there is one line."""
    try:
        command = [sys.executable, "-m", "rbfevo.collect", directory]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600)
    except (OSError, subprocess.SubprocessError) as error:
        print(f"rbfevo: the sweep was not collected: {' '.join(str(error).split())}", file=sys.stderr)
        return
    print("" if quiet else done.stdout, end="", flush=True)
    print(done.stderr if done.returncode in (0, 2) else done.stderr[-500:], end="", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 for a user's mistake, 130, 143, or 1."""
    words = overrides.quoted(sys.argv[1:] if arguments is None else arguments)
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:6], use_cache=True, replace=True)
    interrupted = False
    with tempfile.TemporaryDirectory(prefix="rbfevo-") as status:
        os.environ[STATUS] = status
        sys.argv = ["rbfevo", *words]
        try:
            overrides.look_over(words)
            hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(job)()
        except KeyboardInterrupt:
            interrupted = True
        except UserError as error:
            print(f"rbfevo: {error}", file=sys.stderr)
            return 2
        except (hydra.errors.HydraException, OmegaConfBaseException, OSError) as error:
            print(f"rbfevo: {overrides.explain(error, words, CONF)}", file=sys.stderr)
            return 2
        codes = [int(path.read_text()) for path in Path(status).iterdir() if path.name != SWEEP]
        stops = [code for code in codes if code in (130, 143)]
        if Path(status, SWEEP).exists() and not (stops or interrupted) and 0 in codes:
            collected(*json.loads(Path(status, SWEEP).read_text()))
    return stops[0] if stops else 130 if interrupted else max(codes, default=0)


if __name__ == "__main__":
    sys.exit(main())
