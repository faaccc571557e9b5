"""Names for NumPy arrays in signatures."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
Ints = NDArray[Any]
Points = Array
Triangles = Ints
