"""Bounded potential: against P, certified optima and finite differences; warm starts, degenerate setups, batches."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from designs import DESIGNS, KERNELS, PAIRS, Design, certified_potential, numpy_phi, scipy_potential
from scipy.spatial.distance import cdist
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.bounded_evaluator import BoundedEvaluator
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import evolvability
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.pnorm import Part, _Climb, norm
from rbfevo.scoring.representations import RBF, Representation
from rbfevo.scoring.symmetric import MirroredEvaluator

SMALL: dict[str, dict[str, Any]] = {"plane": {"nx": 14, "ny": 22}, "sphere": {"subdivisions": 2}}
MIRROR = Mirror.of_box(1, 0.0, np.full(3, -1.0), np.ones(3))


def design(name: str) -> Design:
    return DESIGNS[name](weighted=True, **SMALL[name])


def blend_of(X: np.ndarray) -> np.ndarray:
    """0 for the third of the vertices with the smallest x, rising to 1."""
    t = np.clip((X[:, 0] - np.quantile(X[:, 0], 0.33)) / 0.4, 0.0, 1.0)
    return t * t * (3 - 2 * t)


def potential(
    name: str, kernel: str, p: float = 16.0, held: bool = False, mirror: Mirror | None = None
) -> BoundedPotential:
    made = design(name)
    blend = torch.from_numpy(blend_of(made.vertices.numpy())) if held else None
    g = made.gradient if blend is None else torch.where(blend[:, None] > 0, made.gradient, 0.0)
    return BoundedPotential(made.vertices, g, KERNELS[name][kernel], p, made.weights, blend, mirror)


def maps(bounded: BoundedPotential, kernel: Kernel, C: np.ndarray) -> list[tuple[list[int], np.ndarray]]:
    """Components and their columns of U, written anew."""
    X, k = bounded.vertices.numpy(), bounded.a.shape[1]
    blend = 1.0 if bounded.blend is None else bounded.blend.numpy()[:, None]
    if bounded.mirror is None:
        return [(list(range(k)), blend * numpy_phi(kernel, cdist(X, C)))]
    image = C * (1, -1, 1)
    off = C[:, 1] != 0
    plus = numpy_phi(kernel, cdist(X, C)) + numpy_phi(kernel, cdist(X, image))
    minus = numpy_phi(kernel, cdist(X, C[off])) - numpy_phi(kernel, cdist(X, image[off]))
    return [([0, 2], blend * plus), ([1], blend * minus)]


def certified(bounded: BoundedPotential, columns: list[tuple[list[int], np.ndarray]]) -> float:
    """P_p of some columns of U, certain to 1e-9 since a displacement and forces bound it below and above."""
    below, above = certified_potential(columns, bounded.gradient.numpy(), bounded.u.numpy(), bounded.p)
    assert below <= above * (1 + 1e-13)
    assert above <= below * (1 + 1e-9)
    return below


def own_maps(bounded: BoundedPotential, C: np.ndarray) -> list[tuple[list[int], np.ndarray]]:
    """Components and their columns as the code rounds them, for setups that magnify the rounding of phi."""
    parts = bounded._columns(torch.from_numpy(C))
    blend = 1.0 if bounded.blend is None else bounded.blend.numpy()[:, None]
    X = bounded.vertices.numpy()
    return [(part.components, blend * part.representation.phi(X, part.setup.numpy())) for part in parts]


def setups(name: str, count: int, m: int, mirrored: bool = False) -> Tensor:
    C = design(name).centers(count, m, seed=5)
    if mirrored:
        C[..., 1] = C[..., 1].abs()
        C[:, -1, 1] = 0.0
    return C


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize(("name", "kernel"), PAIRS)
def test_for_p_2_it_is_improvement_potential(name: str, kernel: str, held: bool) -> None:
    bounded, C = potential(name, kernel, 2.0, held), setups(name, 4, 6)
    g = bounded.gradient / (bounded.u[:, None] * bounded.gradient.square()).sum().sqrt()
    Phi = RBF(KERNELS[name][kernel]).phi(bounded.vertices, C)
    Phi = Phi if bounded.blend is None else bounded.blend[:, None] * Phi
    _, expected, _ = evolvability(Phi, g, bounded.u)
    torch.testing.assert_close(bounded.values(C), expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(bounded.definition(C), expected, rtol=0, atol=1e-12)


def test_for_p_2_it_is_that_of_symmetric_setups_too() -> None:
    bounded, C = potential("sphere", "wendland 1", 2.0, mirror=MIRROR), setups("sphere", 4, 6, True)
    made = design("sphere")
    evaluate = MirroredEvaluator(
        made.vertices, made.gradient, KERNELS["sphere"]["wendland 1"], "direct", made.weights, mirror=MIRROR
    )
    torch.testing.assert_close(bounded.values(C), evaluate.definition(C).improvement_potential, rtol=0, atol=1e-12)


@pytest.mark.parametrize("case", ["plain", "held", "mirror", "held mirror"])
@pytest.mark.parametrize(("name", "kernel"), PAIRS)
def test_values_are_certified(name: str, kernel: str, case: str) -> None:
    mirrored = "mirror" in case
    if mirrored and name == "plane":
        pytest.skip("its wanted displacement is a height")
    bounded = potential(name, kernel, 16.0, "held" in case, MIRROR if mirrored else None)
    for m in (5, 12):
        C = setups(name, 3, m, mirrored)
        found, defined = bounded.values(C), bounded.definition(C)
        exact = bounded.values(C, gap=0.0)
        for i, one in enumerate(C.numpy()):
            expected = certified(bounded, maps(bounded, KERNELS[name][kernel], one))
            assert 0.0 < expected < 1.0
            assert float(defined[i]) == pytest.approx(expected, rel=1e-10)
            assert float(exact[i]) == pytest.approx(expected, rel=1e-9)
            assert -1e-6 <= float(found[i]) - expected <= 1e-10


@pytest.mark.parametrize("apart", [1e-3, 1e-5, 1e-7, 1e-10, 0.0])
@pytest.mark.parametrize("case", ["plain", "held", "mirror"])
@pytest.mark.parametrize(("name", "kernel"), PAIRS)
def test_nearly_coincident_centers_are_certified(name: str, kernel: str, case: str, apart: float) -> None:
    """To 1e-8; below a distance of 1e-7 the rounding of phi alone, magnified by its inverse, is more than that."""
    mirrored = case == "mirror"
    if mirrored and name == "plane":
        pytest.skip("its wanted displacement is a height")
    bounded = potential(name, kernel, 16.0, case == "held", MIRROR if mirrored else None)
    C = setups(name, 1, 12, mirrored)
    C[0, 1] = C[0, 0] + apart
    C[0, 3] = C[0, 2] - 2 * apart
    own = own_maps(bounded, C[0].numpy())
    expected = certified(bounded, own)
    assert float(bounded.definition(C)[0]) == pytest.approx(expected, rel=1e-8)
    assert float(bounded.values(C, gap=0.0)[0]) == pytest.approx(expected, rel=1e-8 if apart > 1e-8 else 1e-5)
    if not 0.0 < apart < 1e-7:
        anew = certified(bounded, maps(bounded, KERNELS[name][kernel], C[0].numpy()))
        assert anew == pytest.approx(expected, rel=1e-8)


def test_the_certificate_is_that_of_scipys_optimum() -> None:
    """Another method for the same number; the bounds do not meet where the displacement is not the best."""
    bounded, C = potential("sphere", "wendland 1"), setups("sphere", 2, 5)
    for one in C.numpy():
        columns = maps(bounded, KERNELS["sphere"]["wendland 1"], one)
        found = scipy_potential(columns, bounded.gradient.numpy(), bounded.u.numpy(), bounded.p)
        assert certified(bounded, columns) == pytest.approx(found, rel=1e-8)


@pytest.mark.parametrize("p", [2.5, 3.0, 6.5, 16.0, 64.0])
def test_other_norms(p: float) -> None:
    for mirror in (None, MIRROR):
        bounded, C = potential("sphere", "wendland 1", p, mirror=mirror), setups("sphere", 2, 5, mirror is not None)
        for i, one in enumerate(C.numpy()):
            expected = certified(bounded, maps(bounded, KERNELS["sphere"]["wendland 1"], one))
            assert float(bounded.definition(C)[i]) == pytest.approx(expected, rel=1e-10)
            assert float(bounded.values(C)[i]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("case", ["plain", "held", "mirror", "held mirror"])
@pytest.mark.parametrize(("name", "kernel"), PAIRS)
def test_gradients_are_those_of_finite_differences(name: str, kernel: str, case: str) -> None:
    mirrored = "mirror" in case
    if mirrored and name == "plane":
        pytest.skip("its wanted displacement is a height")
    bounded = potential(name, kernel, 16.0, "held" in case, MIRROR if mirrored else None)
    C = setups(name, 2, 5, mirrored)
    values, gradients = bounded.values_and_gradients(C)
    torch.testing.assert_close(values, bounded.values(C), rtol=0, atol=1e-6)
    h = 1e-5
    inner = range(C.shape[1] - mirrored)  # a center on the plane stays there: it moves along it alone
    places = [(i, j, c) for i in range(len(C)) for j in inner for c in range(C.shape[2])]
    places += [(i, C.shape[1] - 1, c) for i in range(len(C)) for c in (0, 2)] if mirrored else []
    moved = torch.stack([C[i].clone() for i, _, _ in places for _ in (0, 1)])
    for row, (_, j, c) in enumerate(places):
        moved[2 * row, j, c] += h
        moved[2 * row + 1, j, c] -= h
    there = bounded.values_and_gradients(moved)[0]
    by_differences = (there[0::2] - there[1::2]) / (2 * h)
    found = torch.stack([gradients[place] for place in places])
    torch.testing.assert_close(found, by_differences, rtol=1e-5, atol=1e-6 * float(found.abs().max()))
    if mirrored:
        assert not gradients[:, -1, 1].any()


@pytest.mark.parametrize(("name", "kernel"), PAIRS)
def test_a_warm_start_changes_passes_and_nothing_else(name: str, kernel: str) -> None:
    bounded, C = potential(name, kernel), setups(name, 4, 8)
    before = bounded.optima(C)
    near = C + 1e-3 * torch.randn(C.shape, generator=torch.Generator().manual_seed(0), dtype=C.dtype)
    cold, warm = bounded.optima(near, gradients=True), bounded.optima(near, before.near, gradients=True)
    torch.testing.assert_close(warm.values, cold.values, rtol=0, atol=1e-10)
    assert cold.gradients is not None
    assert warm.gradients is not None
    torch.testing.assert_close(warm.gradients, cold.gradients, rtol=1e-5, atol=2e-6 * float(cold.gradients.abs().max()))
    assert int(warm.passes.sum()) < 0.6 * int(cold.passes.sum())
    value = bounded.optima(near, before.near)
    assert int(value.passes.max()) <= 5
    torch.testing.assert_close(value.values, cold.values, rtol=0, atol=1e-6)
    bad = [before.near.flip(0), 1e200 * before.near, torch.full_like(before.near, torch.nan)]
    for factor in (-1.0, 0.0, 1e200, torch.nan):
        bad.append(before.near.clone())
        bad[-1][:, C[0].numel() :] *= factor
    for start in bad:
        torch.testing.assert_close(bounded.values(near, start), cold.values, rtol=0, atol=1e-6)


def test_a_start_remembers_centers_that_have_left_the_plane_of_symmetry() -> None:
    bounded, C = potential("sphere", "triharmonic", mirror=MIRROR), setups("sphere", 3, 8, True)
    near = bounded.optima(C).near
    moved = C.clone()
    moved[:, -1, 1] = 1e-3
    cold, warm = bounded.optima(moved), bounded.optima(moved, near)
    torch.testing.assert_close(warm.values, cold.values, rtol=0, atol=1e-6)
    assert int(bounded.optima(C, near).passes.max()) <= 2


@pytest.mark.parametrize("kernel", ["wendland 0.5", "triharmonic"])
def test_a_sample_of_the_vertices_saves_passes_and_nothing_else(kernel: str) -> None:
    made = DESIGNS["plane"](65, 65, weighted=True)
    bounded = BoundedPotential(made.vertices, made.gradient, KERNELS["plane"][kernel], 16.0, made.weights)
    assert bounded._sample is not None
    C = made.centers(3, 8)
    found, exact = bounded.optima(C), bounded.values(C, gap=0.0)
    bounded._sample = None
    plain = bounded.optima(C)
    torch.testing.assert_close(found.values, plain.values, rtol=0, atol=1e-6)
    torch.testing.assert_close(bounded.values(C, gap=0.0), exact, rtol=0, atol=1e-12)
    assert int(found.passes.sum()) < 0.7 * int(plain.passes.sum())
    for i, one in enumerate(C.numpy()):
        expected = certified(bounded, maps(bounded, KERNELS["plane"][kernel], one))
        assert float(exact[i]) == pytest.approx(expected, rel=1e-9)
        assert -1e-6 <= float(found.values[i]) - expected <= 1e-10


def climb_of(mirror: Mirror | None) -> tuple[_Climb, Tensor, Tensor]:
    """A problem of three components, its basis [n, 3, r] written out, and a displacement's coordinates."""
    bounded, C = potential("sphere", "wendland 1", mirror=mirror), setups("sphere", 1, 6, mirror is not None)
    parts, pieces = [], []
    for part in bounded._columns(C[0]):
        found = bounded._basis(part)
        assert found is not None
        basis, back = found
        torch.testing.assert_close(basis, bounded._phi(part, slice(None)) @ back, rtol=0, atol=1e-12)
        gram = basis.mT @ (bounded.u[:, None] * basis)
        torch.testing.assert_close(gram, torch.eye(len(gram), dtype=gram.dtype), rtol=0, atol=1e-10)
        parts.append(Part(part.components, basis))
        for c in part.components:
            wide = torch.zeros(len(basis), 3, basis.shape[1], dtype=basis.dtype)
            wide[:, c] = basis
            pieces.append(wide)
    climb = _Climb(parts, bounded.u, 3)
    climb.linear = climb.pulled(bounded.a.mT)
    return climb, torch.cat(pieces, 2), climb.linear


@pytest.mark.parametrize("mirror", [None, MIRROR])
def test_the_curvature_is_the_sum_over_the_vertices_that_count(mirror: Mirror | None) -> None:
    climb, A, z = climb_of(mirror)
    d, kept = climb.displaced(z), torch.arange(0, A.shape[0], 3)
    torch.testing.assert_close(d.mT, A @ z, rtol=0, atol=1e-12)
    weight, stretch = climb.u[kept] ** 2, climb.u[kept] + 1.0
    local = weight[:, None, None] * torch.eye(3, dtype=z.dtype)
    local = local + torch.einsum("n,cn,en->nce", stretch, d[:, kept], d[:, kept])
    expected = torch.einsum("ncr,nce,nes->rs", A[kept], local, A[kept])
    torch.testing.assert_close(climb._curvature(d[:, kept], kept, weight, stretch), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("mirror", [None, MIRROR])
@pytest.mark.parametrize("faint", [1e-8, 1e-4, 1e-2])
def test_a_step_bounds_the_gain_and_leaves_out_faint_vertices(faint: float, mirror: Mirror | None) -> None:
    climb, _, z = climb_of(mirror)
    best, _ = climb.climbed(z, 16.0, 0.0, [4.0, 8.0, *[16.0] * 60], 1e-3, 1e-20)
    gain, bounds = climb.ratio(best, 16.0), []
    noise = torch.randn(len(best), generator=torch.Generator().manual_seed(0), dtype=best.dtype)
    for size in (3e-3, 1e-3, 3e-4, 0.0):
        z = best + size * best.norm() * noise / noise.norm()
        d = climb.displaced(z)
        length = norm(d, climb.u, 16.0)
        after, _, decrement, bound = climb._pass(z / length, d / length, 16.0, faint, True)
        assert bound >= gain * (1 - 1e-12)
        assert decrement <= 1e-2
        assert climb.ratio(z, 16.0) <= climb.ratio(after, 16.0) * (1 + 1e-12)
        assert climb.ratio(after, 16.0) <= gain * (1 + 1e-12)
        bounds.append(bound / gain - 1)
    assert bounds[0] > bounds[2]
    assert bounds[2] <= 1e-3


def test_degenerate_setups_leave_the_others_alone() -> None:
    bounded, C = potential("sphere", "wendland 0.5"), setups("sphere", 6, 5)
    plain = bounded.optima(C, gradients=True)
    broken = C.clone()
    broken[0, 0, 0] = torch.nan
    broken[1, 2, 1] = torch.inf
    broken[2] += 100.0  # nothing in reach
    broken[3, 1] = broken[3, 0]  # rank 4
    broken[4, 0] += 100.0  # one center without a vertex in reach
    found = bounded.optima(broken, gradients=True)
    assert found.values[:2].isnan().all()
    assert float(found.values[2]) == 0.0
    assert plain.gradients is not None
    assert found.gradients is not None
    assert torch.isfinite(found.gradients).all()
    assert not found.gradients[:3].any()
    for row, kept in ((3, [0, 2, 3, 4]), (4, [1, 2, 3, 4])):
        alone = bounded.values(broken[row : row + 1, kept])
        torch.testing.assert_close(found.values[row : row + 1], alone, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.values[5], plain.values[5], rtol=0, atol=0)
    torch.testing.assert_close(found.gradients[5], plain.gradients[5], rtol=0, atol=0)
    alone = bounded.optima(C[3:4], gradients=True)
    torch.testing.assert_close(alone.values[0], plain.values[3], rtol=0, atol=0)
    defined = bounded.definition(broken)
    assert defined[:2].isnan().all()
    torch.testing.assert_close(defined[2:], found.values[2:], rtol=0, atol=1e-6)


def test_threads_change_nothing() -> None:
    bounded, C = potential("sphere", "triharmonic"), setups("sphere", 9, 5)
    found = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(bounded.optima(C, gradients=True))
    finally:
        torch.set_num_threads(before)
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_size_of_g_and_of_weights_do_not_matter() -> None:
    made, C = design("sphere"), setups("sphere", 3, 5)
    kernel = KERNELS["sphere"]["wendland 1"]
    plain = BoundedPotential(made.vertices, made.gradient, kernel, 16.0, made.weights).values(C)
    scaled = BoundedPotential(made.vertices, 1e-90 * made.gradient, kernel, 16.0, 1e3 * made.weights).values(C)
    torch.testing.assert_close(scaled, plain, rtol=1e-9, atol=0)


def test_a_wanted_displacement_within_reach_has_potential_one() -> None:
    made, C = design("sphere"), setups("sphere", 1, 5)
    phi = RBF(KERNELS["sphere"]["wendland 1"]).phi(made.vertices, C[0])
    d = phi @ torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    g = d * d.square().sum(1, keepdim=True) ** 7  # the dual of d
    bounded = BoundedPotential(made.vertices, g, KERNELS["sphere"]["wendland 1"], 16.0, made.weights)
    assert float(bounded.values(C)[0]) == pytest.approx(1.0, abs=1e-6)


class Waves(Representation):
    """A representation without closed forms: sin(D_j x)."""

    name, dims, shape = "waves", 1, (4,)

    def phi(self, points: Any, setups: Any) -> Any:
        return (setups[..., None, :] * points[:, :1]).sin()

    def columns(self, setups: Any) -> int:
        return 4

    def spec(self) -> dict[str, Any]:
        return {"target": "nowhere"}


def test_other_representations_get_gradients_by_autograd() -> None:
    made = design("sphere")
    bounded = BoundedPotential(made.vertices, made.gradient, Waves(), 16.0, made.weights)
    D = torch.tensor([[1.0, 2.0, 3.1, 4.5]], dtype=torch.float64)
    _, gradients = bounded.values_and_gradients(D)
    steps = 1e-5 * torch.eye(4, dtype=torch.float64)
    ahead, behind = bounded.values_and_gradients(D + steps)[0], bounded.values_and_gradients(D - steps)[0]
    torch.testing.assert_close(gradients[0], (ahead - behind) / 2e-5, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("p", [1.0, 1.99, math.inf, math.nan])
def test_a_norm_below_2_is_refused(p: float) -> None:
    with pytest.raises(UserError, match=r"criterion.norm=.*: give a number of at least 2"):
        potential("plane", "triharmonic", p)


def test_coarse_evaluators_exist_for_both_manipulations() -> None:
    """P_p is that of the span: what the evaluator scores directly or indirectly is one number."""
    made, C = design("plane"), setups("plane", 3, 4)
    scores = [
        Evaluator(made.vertices, made.gradient, KERNELS["plane"]["wendland 0.5"], manipulation, made.weights)(C)
        for manipulation in ("indirect", "direct")
    ]
    bounded = potential("plane", "wendland 0.5", 2.0).values(C)
    for found in scores:
        torch.testing.assert_close(found.improvement_potential, bounded, rtol=0, atol=1e-9)


@pytest.mark.parametrize("mirror", [None, MIRROR])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_the_evaluator_of_bounded_potential_has_its_gradients(manipulation: str, mirror: Mirror | None) -> None:
    bounded, made = potential("sphere", "wendland 1", mirror=mirror), design("sphere")
    parts = (made.vertices, made.gradient, KERNELS["sphere"]["wendland 1"], manipulation, made.weights)
    plain = Evaluator(*parts) if mirror is None else MirroredEvaluator(*parts, mirror=mirror)
    evaluate = BoundedEvaluator(plain, bounded)
    centers = setups("sphere", 2, 4, mirror is not None)
    scores, spectrum = evaluate(centers), evaluate.spectrum(centers)
    torch.testing.assert_close(spectrum.potential, bounded.values(centers), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(scores.regularity, plain(centers).regularity, rtol=0, atol=0)
    gradient, h = spectrum.backward(torch.zeros_like(spectrum.sigma), torch.ones_like(spectrum.potential)), 1e-5
    for axis in range(3):
        ahead, behind = centers.clone(), centers.clone()
        ahead[:, 1, axis] += h
        behind[:, 1, axis] -= h
        slope = (bounded.definition(ahead) - bounded.definition(behind)) / (2 * h)
        torch.testing.assert_close(gradient[:, 1, axis], slope, rtol=1e-4, atol=1e-7)
