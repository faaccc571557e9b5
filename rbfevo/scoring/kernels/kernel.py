"""What a radial basis function is: one formula, for NumPy and torch, and the numbers that it takes."""

from __future__ import annotations

import abc
import importlib
from typing import Any

from rbfevo.errors import UserError


class Kernel(abc.ABC):
    """A radial basis function phi of the distance (paper, section 3), free of torch.

    `phi` and `slope` take arrays of NumPy or tensors of torch, of any shape, and return the same kind. `kernel(r)` is
    `kernel.phi(r)`.

    A kernel of one's own is a subclass in one file, with the name of a function or of itself as `_target_` of a yaml in
    `conf/kernel`. That target is called with the dimension, the scenario's default support radius and the diagonal of
    its box, and with the keys of the yaml.

    Attributes:
        name: as on the command line.
        support: support radius in model units, or None for a kernel that reaches everywhere.
        positive_definite: whether Psi is positive definite for distinct centers.
        page: the formula by which `report.html` works out what a setup leaves (KERNELS in `page/js/2-reach.js`); None
            where it knows none.
    """

    name: str = ""
    support: float | None = None
    positive_definite: bool = False
    page: str | None = None

    @abc.abstractmethod
    def phi(self, r: Any) -> Any:
        """phi(r), elementwise for distances r >= 0."""

    @abc.abstractmethod
    def slope(self, r: Any) -> Any:
        """phi'(r)/r, elementwise: times the vector c - x it is the gradient of phi(|c - x|) in c.

        Where that product has the limit 0 at r = 0 although the slope itself has none, `slope(0)` is 0.
        """

    def numbers(self) -> dict[str, float]:
        """The arguments that make the same kernel again."""
        return {} if self.support is None else {"support": self.support}

    def spec(self) -> dict[str, Any]:
        """What a reader rebuilds the kernel from: its class and its numbers."""
        return {"target": f"{type(self).__module__}.{type(self).__qualname__}", **self.numbers()}

    def __call__(self, r: Any) -> Any:
        return self.phi(r)


def kernel_of(spec: dict[str, Any]) -> Kernel:
    """The kernel that `Kernel.spec` describes.

    Raises:
        UserError: if its class cannot be imported, or does not make a kernel of these numbers.
    """
    target, numbers = str(spec.get("target")), {key: value for key, value in spec.items() if key != "target"}
    module, _, name = target.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
        made = found(**numbers) if isinstance(found, type) and issubclass(found, Kernel) else None
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise UserError(f"the kernel {target} of this run cannot be imported ({error}); install its package") from None
    if made is None:
        raise UserError(f"{target} is not a kernel")
    return made
