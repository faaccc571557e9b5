"""`python -m rbfevo`: configuration in, run directory out."""

from __future__ import annotations

import os
import shutil
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
CONF = next(path for path in (Path(__file__).parent / "conf", Path(__file__).parents[1] / "conf") if path.is_dir())


def job(config: DictConfig) -> None:
    """One job of Hydra's: never raises, so that one failed job does not end a sweep; leaves its exit code behind."""
    from rbfevo.config import check
    from rbfevo.run import carry_out

    directory = Path(HydraConfig.get().runtime.output_dir)
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
        where = f"{directory.name}: " if HydraConfig.get().mode == RunMode.MULTIRUN else ""
        print(f"rbfevo: {where}{' '.join(message.split())}", file=sys.stderr)
    Path(os.environ[STATUS], uuid.uuid4().hex).write_text(str(code))
    if code in (130, 143):
        raise KeyboardInterrupt  # whoever interrupts a sweep means all of it


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
        codes = [int(path.read_text()) for path in Path(status).iterdir()]
    stops = [code for code in codes if code in (130, 143)]
    return stops[0] if stops else 130 if interrupted else max(codes, default=0)


if __name__ == "__main__":
    sys.exit(main())
