"""One formula for NumPy and torch: the module whose functions take an array, without importing torch."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np


def namespace(array: Any) -> Any:
    """NumPy for its arrays and for numbers, torch for tensors."""
    return np if isinstance(array, np.ndarray | np.generic | float | int) else sys.modules["torch"]


def copied(array: Any) -> Any:
    """A copy of an array or of a tensor."""
    return array.copy() if isinstance(array, np.ndarray) else array.clone()
