"""What a representation of deformations is: how a setup makes the columns of U, and where setups can be searched."""

from __future__ import annotations

import abc
import dataclasses
import importlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from rbfevo.scenarios.scenario import Scenario


class Reduced(NamedTuple):
    """What a manipulation makes of Phi = Q T^T, as U = Phi W: the factor T^T W, transposed, and W itself.

    Attributes:
        factor: [p, m, r] W^T T; weights: [p, r, m] W, or None for the identity.
        singular: [p] where W does not exist; factor and weights are the identity there.
    """

    factor: Tensor
    weights: Tensor | None
    singular: Tensor


class Pull(NamedTuple):
    """A gradient in log sigma on its way through W: d log sigma_i = ... + u_i^T Phi dW v_i / sigma_i.

    Attributes:
        scaled: [p, m, m] right singular vectors v_i of U, each times the gradient in log sigma_i.
        reduced: [p, r, m] Z = W V.
    """

    scaled: Tensor
    reduced: Tensor


@dataclasses.dataclass(frozen=True)
class Space:
    """Where the setups of one run are searched.

    Attributes:
        lower, upper: corners of the box, of the shape of one setup.
        sample: (count, generator) -> that many random setups.
        place: points of the box -> setups: what symmetry and fixed regions make of them.
        pull: (points, gradient in their setups) -> gradient in the points.
        points: setups that `place` has made -> points that it makes them of.
    """

    lower: Tensor
    upper: Tensor
    sample: Callable[[int, torch.Generator], Tensor]
    place: Callable[[Tensor], Tensor]
    pull: Callable[[Tensor, Tensor], Tensor]
    points: Callable[[Tensor], Tensor] = lambda setups: setups


class Representation(abc.ABC):
    """How a setup makes U [n, m] of X' = X + U P: U = Phi W, with one row of Phi a vertex and W by the manipulation.

    A setup is an array of `dims` dimensions: centers [m, d], or a genotype [D]. `phi` takes arrays of NumPy or tensors
    of torch. A representation of one's own is a subclass in one file, with the name of a function (scenario, kernel,
    centers, keys of the yaml) that makes it as `_target_` of a yaml in `conf/representation`. What it does not offer
    (None, or a manipulation that is not listed) is refused in one line where it is asked for.

    Attributes:
        name: as on the command line.
        dims: dimensions of one setup.
        manipulations: those that it offers.
        shape: of one setup, or None where any number of centers will do.
        fails_where: why a setup of finite numbers has no scores.
        block: vertices at a time on the CPU, where there are no fused kernels.
    """

    name: str = ""
    dims: int = 1
    manipulations: tuple[str, ...] = ("indirect",)
    shape: tuple[int, ...] | None = None
    fails_where: str = "its columns are not finite"
    block: int = 1024

    @abc.abstractmethod
    def phi(self, points: Any, setups: Any) -> Any:
        """Phi [*pop, q, r] at points [q, d] of setups [*pop, *setup]."""

    @abc.abstractmethod
    def columns(self, setups: Any) -> int:
        """r, the columns of Phi."""

    @abc.abstractmethod
    def spec(self) -> dict[str, Any]:
        """Plain numbers and text: `target` is the class, the others are what its `of_spec` takes; not `name`."""

    @property
    def narrows(self) -> bool:
        """Whether W may have a rank below the columns of Phi, so that P and V depend on the manipulation."""
        return False

    def for_run(self, scenario: Scenario, manipulation: str) -> Representation:
        """The representation of a run, with what it takes from its scenario and manipulation."""
        return self

    def parameters(self, setups: Any) -> int:
        """m, the columns of U: those of Phi, unless a manipulation has fewer."""
        return self.columns(setups)

    def notes(self) -> dict[str, str]:
        """Facts for the log of a run and its summary, by title."""
        return {}

    def doubts(self, scenario: Scenario) -> list[str]:
        """A line for each reason to doubt results on a scenario."""
        return []

    def jumps(self, points: Any, setups: Any) -> Any | None:
        """Labels [*pop, q] of points: between different ones displacements of a setup jump; None for none."""
        return None

    def refuse_search(self, method: str) -> None:  # noqa: B027 - most can be searched
        """Raise UserError if a method cannot search the setups of this run."""

    @classmethod
    def of_spec(cls, **numbers: Any) -> Representation:
        """The representation that `spec` describes, without torch."""
        return cls(**numbers)

    def space(self, scenario: Scenario, centers: int) -> Space:
        """Where setups of `centers` columns are searched on a scenario.

        Raises:
            UserError: if the representation cannot be searched there.
        """
        raise UserError(f"representation={self.name} cannot be searched")

    def refuse(self, setups: Tensor, dimension: int) -> None:
        """Raise UserError if setups [*pop, *setup] do not fit points with `dimension` coordinates."""
        if self.shape is None or tuple(setups.shape[-self.dims :]) != self.shape:
            raise UserError(f"setups of representation={self.name} have the shape {self.shape}, not {setups.shape}")

    def handles(self, setups: Any) -> Any | None:
        """Where the control points [*pop, h, d] sit, for pictures and export; None where there are none."""
        return None

    def weights(self, setups: Any) -> Any | None:
        """W [*pop, r, m] of the run's manipulation, where parameters are displacements of the handles; None: identity.

        Raises:
            UserError: if the control points cannot be moved one by one.
        """
        raise UserError(f"the control points of representation={self.name} cannot be moved one by one")

    def places(self, setups: Any) -> Any | None:
        """Where the control points [*pop, r, d] of the columns of Phi sit, or None."""
        return None

    def reduce(self, setups: Tensor, factor: Tensor, manipulation: str) -> Reduced:
        """W of setups [p, *setup] under a manipulation, applied to the lower triangular factor T [p, r, r] of Phi."""
        import torch

        return Reduced(factor, None, torch.zeros(len(setups), dtype=torch.bool, device=factor.device))

    def matrix(self, phi: Tensor, setup: Tensor, manipulation: str) -> Tensor | None:
        """U [n, m] of one setup by definition, from its Phi [n, r]; None where W does not exist."""
        return phi

    def pull(self, points: Tensor, setups: Tensor, gradient: Tensor) -> Tensor | None:
        """Gradient [p, *setup] of a function whose gradient in Phi^T is [p, r, q]; None without a closed form."""
        return None

    def pull_weights(self, setups: Tensor, gradient: Tensor) -> Tensor | None:
        """Gradient [p, *setup] of a function whose gradient in W is [p, r, m], where `narrows`; None without."""
        return None

    def pull_reduction(self, setups: Tensor, through: Pull) -> Tensor | None:
        """Gradient [p, *setup] of what reaches sigma through W; None without a closed form."""
        return None

    def symmetric(self, mirror: Mirror) -> tuple[Representation, Representation] | None:
        """The columns for components along a plane of symmetry and for the one across it, or None."""
        return None

    def given(self, files: Sequence[str], scenario: Scenario) -> Tensor | None:
        """Setups [p, *setup] of files that somebody has made; None where files hold centers.

        Raises:
            UserError: if a file cannot be used.
        """
        return None

    def candidates(self) -> Tensor | None:
        """The places [c, d] that heuristics pick centers from; None for a grid over the box."""
        return None

    def refuse_places(self, method: str) -> NoReturn:
        """Raise UserError: why a heuristic cannot place centers one by one.

        Raises:
            UserError: always.
        """
        raise UserError(f"method={method} places centers one by one, and representation={self.name} has none")

    def off_plane(self) -> Tensor | None:
        """Which columns along a plane of symmetry [m] have one across it; None where setups are centers, by place."""
        return None

    def assemble(self, centers: Tensor) -> Tensor | None:
        """Setups [*pop, *setup] of centers [*pop, m, d] that a heuristic has placed; None where they are no setup."""
        return None

    @property
    def placed_by(self) -> Representation:
        """The representation in which heuristics place centers one by one, of which setups are then assembled."""
        return self

    def atoms(self, points: Tensor) -> Callable[[Tensor], Tensor] | None:
        """The map from candidate centers [c, d] to their columns [n, c], for heuristics that place them; or None."""
        return None


def with_own_columns(make: Any) -> Any:
    """Mark a function of a yaml whose settings say how many columns there are; without `centers=` it gets 0."""
    vars(make)["brings"] = True
    return make


def representation_of(spec: dict[str, Any]) -> Representation:
    """The representation that `Representation.spec` describes.

    Raises:
        UserError: if its class cannot be imported, or does not take these numbers.
    """
    target, numbers = (
        str(spec.get("target")),
        {key: value for key, value in spec.items() if key not in ("target", "name")},
    )
    module, _, name = target.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
        if isinstance(found, type) and issubclass(found, Representation):
            return found.of_spec(**numbers)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"the representation {target} of this run cannot be imported ({reason}); install it") from None
    raise UserError(f"{target} is not a representation")
