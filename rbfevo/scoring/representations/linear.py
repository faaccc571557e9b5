"""Radial basis functions with a linear polynomial: the usual morph, under which linear deformations are exact.

u(x) = sum_j lambda_j phi(|c_j - x|) + a_0 + a . x, where sum_j lambda_j q(c_j) = 0 for each linear q (Wendland,
Scattered Data Approximation, 2005, section 8.5). With E [m, t] the values at the centers of linear functions e that are
orthonormal there, a setup of m centers has m parameters w: E E^T w is what the polynomial takes at the centers, and
lambda = (I - E E^T) w.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.namespaces import namespace
from rbfevo.scoring.kernels import Kernel, kernel_of
from rbfevo.scoring.representations.rbf import RBF, Image
from rbfevo.scoring.representations.representation import Pull, Reduced, Space

if TYPE_CHECKING:
    from torch import Tensor

    from rbfevo.scenarios.scenario import Scenario

EPS = float(np.finfo(float).eps)


class Linear(NamedTuple):
    """Linear functions: 1, if `constant`, and (x_a - origin_a) / length along some axes.

    Origin and length change no deformation: they keep the numbers well conditioned.
    """

    axes: tuple[int, ...]
    origin: tuple[float, ...]
    length: float
    constant: bool = True

    @property
    def terms(self) -> int:
        """t."""
        return len(self.axes) + self.constant

    def __call__(self, points: Any) -> list[Any]:
        """Their values [*pop, q] at points [*pop, q, d]."""
        ones = [points[..., 0] * 0.0 + 1.0] if self.constant else []
        return ones + [(points[..., axis] - self.origin[axis]) / self.length for axis in self.axes]

    def pull(self, gradient: Tensor, dimension: int) -> Tensor:
        """The gradient [*pop, q, d] in points of a function whose gradient in the values there is [*pop, q, t]."""
        found = gradient.new_zeros(*gradient.shape[:-1], dimension)
        for column, axis in enumerate(self.axes, start=int(self.constant)):
            found[..., axis] = gradient[..., column] / self.length
        return found


class LinearRBF(RBF):
    """RBFs with a linear polynomial: B(x) = phi(x) (I - E E^T) + e(x) E^T [m], U = B (indirect), B B(C)^-1 (direct).

    The direct U is that of the saddle-point system: each center moves by its own parameters, and a linear displacement
    of all centers is one of the whole design. R and P of both depend on no origin of the coordinates, and those of
    a compact kernel on no unit of length. Setups whose centers lie in a plane (on the plane: on a line) have no
    columns but NaN, and fail.

    Args:
        kernel: phi; linear: the linear functions; image: as for `RBF`.
    """

    plain = False
    fails_where = "its centers lie in a plane (of a planar design: on a line), so they determine no linear polynomial"

    def __init__(self, kernel: Kernel, linear: Linear, image: Image | None = None) -> None:
        super().__init__(kernel, image)
        self.linear = linear

    def phi(self, points: Any, setups: Any) -> Any:
        """B [*pop, q, m] at points [q, d] or [*pop, q, d]."""
        plain = super().phi(points, setups)
        E, e = self._orthonormal(setups, self.linear(points))
        return plain + _product(e - _product(plain, E), E.swapaxes(-1, -2))

    def _orthonormal(self, setups: Any, values: list[Any]) -> tuple[Any, Any]:
        """E [*pop, m, t] at the centers and e [*pop, q, t] elsewhere, of linear functions whose `values` there are [q].

        By Gram and Schmidt, twice; NaN where the functions are linearly dependent at the centers.
        """
        at: list[Any] = []
        there: list[Any] = []
        for own, value in zip(self.linear(setups), values, strict=True):
            size = _norm(own)
            for _ in range(2):
                for E, e in zip(at, there, strict=True):
                    share = (E * own).sum(-1)[..., None]
                    own, value = own - share * E, value - share * e
            left = _norm(own)
            left = namespace(left).where(left > setups.shape[-2] * EPS * size, left, np.nan)
            at.append(own / left)
            there.append(value / left)
        return _stacked(at), _stacked(there)

    def spec(self) -> dict[str, Any]:
        """The kernel and the linear functions; planes of symmetry are the run's."""
        target = f"{LinearRBF.__module__}.{LinearRBF.__qualname__}"
        axes, origin, length, _ = self.linear
        linear = {"axes": list(axes), "origin": list(origin), "length": length}
        return {"target": target, "kernel": self.kernel.spec(), "linear": linear}

    @classmethod
    def of_spec(cls, **numbers: Any) -> LinearRBF:
        """With the kernel that `kernel` describes, and the linear functions that `linear` does."""
        linear = numbers["linear"]
        axes, origin = tuple(map(int, linear["axes"])), tuple(map(float, linear["origin"]))
        return cls(kernel_of(numbers["kernel"]), Linear(axes, origin, float(linear["length"])))

    @property
    def placed_by(self) -> RBF:
        """The RBFs alone: each of their columns belongs to one center."""
        return RBF(self.kernel, self.image)

    def space(self, scenario: Scenario, centers: int) -> Space:
        """As of RBFs.

        Raises:
            UserError: for fewer centers than determine a linear function, or a flat design.
        """
        fewest = self.linear.terms - (scenario.mirror is not None)
        if centers < fewest:
            raise UserError(f"centers={centers}: representation.polynomial=linear needs at least {fewest} centers here")
        extent = (scenario.vertices.amax(0) - scenario.vertices.amin(0)).tolist()
        for name in ("xyz"[axis] for axis in self.linear.axes if extent[axis] == 0.0):
            raise UserError(
                f"representation.polynomial=linear: the design is flat along {name}, where no polynomial is "
                f"determined; set scenario.planar={name}, or leave the polynomial out"
            )
        return super().space(scenario, centers)

    def refuse(self, setups: Tensor, dimension: int) -> None:
        """Raise UserError unless setups are [*pop, m, d], with enough centers to determine a linear function."""
        super().refuse(setups, dimension)
        if setups.shape[-2] < self.linear.terms:
            least = f"at least {self.linear.terms} centers"
            raise UserError(f"representation.polynomial=linear needs {least}, not {setups.shape[-2]}")

    def reduce(self, setups: Tensor, factor: Tensor, manipulation: str) -> Reduced:
        """B(C)^-T T, whose singular values are those of B B(C)^-1, and B(C)^-1."""
        import torch

        from rbfevo.scoring.evolvability import singular
        from rbfevo.scoring.matrices import all_finite, solve

        if manipulation == "indirect":
            return super().reduce(setups, factor, manipulation)
        at = self.psi(setups)
        identity = torch.eye(at.shape[-1], dtype=at.dtype, device=at.device).expand_as(at)
        inverse, reduced = solve(at, identity), solve(at.mT, factor)
        lost = singular(at, inverse) | ~all_finite(inverse)
        lost = (lost | ~all_finite(reduced))[:, None, None]
        return Reduced(torch.where(lost, identity, reduced), torch.where(lost, identity, inverse), lost[:, 0, 0])

    def pull(self, points: Tensor, setups: Tensor, gradient: Tensor) -> Tensor:
        """That of the RBFs, from (I - E E^T) times the gradient, and what comes through the linear functions."""
        E, inverse = self._inverse(setups)
        values = _stacked(self.linear(points))
        dH = -_product(gradient, super().phi(points, setups))
        dinverse = _product(gradient, values.expand(len(setups), -1, -1)).mT  # in Q^+ [p, t, m]
        dQ = _outside(E, _product(dH + dH.mT, inverse.mT) + _product(dinverse.mT, _product(inverse, inverse.mT)))
        dQ = dQ - _product(inverse.mT, _product(dinverse, inverse.mT))
        return super().pull(points, setups, _outside(E, gradient)) + self.linear.pull(dQ, setups.shape[-1])

    def pull_reduction(self, setups: Tensor, through: Pull) -> Tensor:
        """With W = B(C)^-1, sigma changes by -v_i^T dB(C) z_i; B(C)^T = (I - H) Psi + H, H = E E^T."""
        E, inverse = self._inverse(setups)
        gradient = -_product(through.reduced, through.scaled.mT)  # in B(C)^T
        dH = gradient - _product(gradient, super().phi(setups, setups))
        dQ = _outside(E, _product(dH + dH.mT, inverse.mT))
        return self.pull_psi(setups, _outside(E, gradient)) + self.linear.pull(dQ, setups.shape[-1])

    def _inverse(self, setups: Tensor) -> tuple[Tensor, Tensor]:
        """E [p, m, t], and Q^+ = R^-1 E^T [p, t, m] of the linear functions at the centers, Q = E R."""
        import torch

        identity = torch.eye(self.linear.terms, dtype=setups.dtype, device=setups.device)
        E, R = self._orthonormal(setups, list(identity))
        return E, _product(R, E.mT)

    def symmetric(self, mirror: Mirror) -> tuple[LinearRBF, LinearRBF]:
        """Along the plane 1 and the coordinates along it, across it the distance from it."""
        axes, origin, length, _ = self.linear
        along = Linear(tuple(axis for axis in axes if axis != mirror.axis), origin, length)
        at = tuple(mirror.at if axis == mirror.axis else value for axis, value in enumerate(origin))
        across = Linear((mirror.axis,), at, length, constant=False)
        return (
            LinearRBF(self.kernel, along, Image(mirror, 1.0)),
            LinearRBF(self.kernel, across, Image(mirror, -1.0)),
        )

    def coefficients(self, setup: Array, weights: Array) -> tuple[Array, Array]:
        """The weights lambda [m, k] of the RBFs that weights w [m, k] of a setup [m, d] make, and the polynomial.

        The polynomial [1 + d, k] has the factors of 1 and of each coordinate, those without a linear function being 0.
        """
        E, inverse = self._orthonormal(setup, list(np.eye(self.linear.terms)))
        along = E.T @ weights
        polynomial, factors = np.zeros((1 + setup.shape[1], weights.shape[1])), inverse @ along
        for factor, axis in zip(factors[int(self.linear.constant) :], self.linear.axes, strict=True):
            polynomial[1 + axis] = factor / self.linear.length
            polynomial[0] -= polynomial[1 + axis] * self.linear.origin[axis]
        if self.linear.constant:
            polynomial[0] += factors[0]
        return weights - E @ along, polynomial


def linear_functions(scenario: Scenario) -> Linear:
    """1 and the coordinates in which a scenario's designs move; in a planar run not the one across its plane."""
    lower, upper = scenario.lower.tolist(), scenario.upper.tolist()
    across = None if scenario.planar is None else scenario.planar.axis
    axes = tuple(axis for axis in range(len(lower)) if axis != across)
    origin = tuple(0.5 * (low + high) for low, high in zip(lower, upper, strict=True))
    return Linear(axes, origin, max(high - low for low, high in zip(lower, upper, strict=True)))


def _norm(values: Any) -> Any:
    """[*pop, 1] of [*pop, m]."""
    return (values * values).sum(-1)[..., None] ** 0.5


def _stacked(columns: list[Any]) -> Any:
    return namespace(columns[0]).stack(columns, -1)


def _product(A: Any, B: Any) -> Any:
    """A B of matrices [*pop, ., .]; in torch each by itself, whatever its neighbours are."""
    if isinstance(A, np.ndarray):
        return A @ B
    from rbfevo.scoring.matrices import product

    found = product(A.reshape(-1, *A.shape[-2:]), B.reshape(-1, *B.shape[-2:]))
    return found.reshape(*A.shape[:-1], B.shape[-1])


def _outside(E: Tensor, gradient: Tensor) -> Tensor:
    """(I - E E^T) times a matrix [p, m, c]."""
    return gradient - _product(E, _product(E.mT, gradient))
