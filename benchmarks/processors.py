"""Simulates other processors by environment variables: instruction sets, and the code paths that MKL selects.

ATEN_CPU_CAPABILITY selects the code of PyTorch's own loops, NUMBA_CPU_NAME that of numba, MKL_ENABLE_INSTRUCTIONS and
MKL_CBWR that of MKL. On processors that are not Intel's MKL takes other code paths, whose results depend on the
alignment of arrays. No setting selects these, but a small preloaded library can replace MKL's own check.
"""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import torch

LEVELS = ("DEFAULT", "AVX2", "AVX512")  # torch's names of processor capabilities, in ascending order
ANSWERS = "int mkl_serv_intel_cpu(void){{return {0};}} int mkl_serv_intel_cpu_true(void){{return {0};}}"
CHECK = "mkl_serv_intel_cpu_true"


class Processor(NamedTuple):
    """A simulated processor.

    Attributes:
        name: in the table.
        level: the capability that the real processor needs, one of `LEVELS`.
        torch, mkl, numba: the values of ATEN_CPU_CAPABILITY, of one of MKL's settings, and of NUMBA_CPU_NAME; "" for
            the default of the real processor.
        maker: the maker that MKL detects, "intel" or "another"; "" for that of the real processor.
    """

    name: str
    level: str
    torch: str
    mkl: str
    numba: str
    maker: str = ""


PROCESSORS = (
    Processor("this one", "DEFAULT", "", "", ""),
    Processor("Intel's, AVX-512", "AVX512", "avx512", "MKL_ENABLE_INSTRUCTIONS=AVX512", "x86-64-v4", "intel"),
    Processor("Intel's, AVX2", "AVX2", "avx2", "MKL_ENABLE_INSTRUCTIONS=AVX2", "x86-64-v3", "intel"),
    Processor("Intel's, SSE4.2", "DEFAULT", "default", "MKL_ENABLE_INSTRUCTIONS=SSE4_2", "x86-64-v2", "intel"),
    Processor("AVX-512, MKL compatible", "AVX512", "avx512", "MKL_CBWR=COMPATIBLE", "x86-64-v4"),
    Processor("AVX2, MKL reproducible", "AVX2", "avx2", "MKL_CBWR=AVX2", "x86-64-v3"),
    Processor("oldest, MKL compatible", "DEFAULT", "default", "MKL_CBWR=COMPATIBLE", "x86-64-v2"),
    Processor("another maker's, AVX-512", "AVX512", "avx512", "", "x86-64-v4", "another"),
    Processor("another maker's, AVX2", "AVX2", "avx2", "", "x86-64-v3", "another"),
    Processor("another maker's, SSE4.2", "DEFAULT", "default", "", "x86-64-v2", "another"),
)
SHORT = ("Intel's, AVX2", "oldest, MKL compatible", "another maker's, AVX2")


def missing(processor: Processor) -> str:
    """The reason why a processor cannot be simulated here; empty if it can."""
    if platform.machine() not in ("x86_64", "AMD64") and processor.name != "this one":
        return f"this machine is {platform.machine()}"
    real = torch.backends.cpu.get_cpu_capability()
    if real in LEVELS and LEVELS.index(processor.level) > LEVELS.index(real):
        return f"this processor has no {processor.level}"
    if processor.maker:
        if shutil.which("cc") is None:
            return "there is no C compiler"
        try:
            getattr(ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libtorch_cpu.so")), CHECK)
        except (OSError, AttributeError):
            return "this torch has no MKL whose check can be replaced"
    return ""


def environment(processor: Processor, directory: Path) -> dict[str, str]:
    """The environment variables that simulate a processor; compiled code is kept in `directory`.

    Raises:
        subprocess.CalledProcessError: if the C compiler fails.
    """
    slug = "".join(letter if letter.isalnum() else "-" for letter in processor.name)
    found = {"NUMBA_CACHE_DIR": str(directory / "numba" / slug)}
    if processor.torch:
        found["ATEN_CPU_CAPABILITY"] = processor.torch
    if processor.numba:
        found["NUMBA_CPU_NAME"] = processor.numba
        found["NUMBA_CPU_FEATURES"] = ""
    if processor.mkl:
        name, _, value = processor.mkl.partition("=")
        found[name] = value
    if processor.maker:
        source, library = directory / f"{slug}.c", directory / f"{slug}.so"
        source.write_text(ANSWERS.format(int(processor.maker == "intel")) + "\n")
        subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
        found["LD_PRELOAD"] = str(library)
    return found
