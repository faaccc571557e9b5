"""The fast path against plain NumPy, the definition and many digits; degenerate setups; memory.

The contract (|dR| <= 1e-6 R + 1e-12, |dP| <= 1e-8) holds as far as float64 determines R and P at all. Phi carries a
rounding of eps, which turns its range by eps/R(Phi) and so moves P by as much, whatever computes it from there; and
Psi^-1 carries an error of eps cond(Psi), which moves R of a direct setup. Against many digits the bounds below say so.
"""

import functools
import os
import pathlib
import subprocess
import sys
import textwrap
import warnings

import numpy as np
import pytest
import torch
from designs import DESIGNS, EPS, KERNELS, PAIRS, Design, exact_scores, numpy_phi, numpy_scores
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from rbfevo.errors import UserError
from rbfevo.scoring import evaluator as evaluators
from rbfevo.scoring import sliced
from rbfevo.scoring.deformation import MANIPULATIONS
from rbfevo.scoring.evaluator import Evaluator, is_regular
from rbfevo.scoring.evolvability import Scores
from rbfevo.scoring.gram import fused_block
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland
from rbfevo.scoring.threads import results_of_slices

both = pytest.mark.parametrize("manipulation", MANIPULATIONS)
backends = pytest.mark.parametrize("backend", ["fused", "eager"])
pairs = pytest.mark.parametrize(("design", "kernel"), PAIRS)


@functools.cache
def built(design: str, k: int = 3, weighted: bool = True) -> Design:
    return DESIGNS[design](k=k, weighted=weighted)


@functools.cache
def small(design: str) -> Design:
    """A few dozen vertices, for many digits."""
    return DESIGNS[design](6, 7, k=1, weighted=True) if design == "plane" else DESIGNS[design](1, k=3, weighted=True)


@functools.cache
def numpys(design: str, kernel: str, manipulation: str, m: int, k: int, weighted: bool) -> np.ndarray:
    """R, P, V [6, 3] of six random setups by plain NumPy."""
    some = built(design, k, weighted)
    phi = KERNELS[design][kernel]
    return np.array([numpy_scores(some, phi, manipulation, setup) for setup in some.centers(6, m, seed=m)])


def evaluator(
    design: Design, kernel: Kernel, manipulation: str = "indirect", backend: str = "auto", **more
) -> Evaluator:
    return Evaluator(design.vertices, design.gradient, kernel, manipulation, design.weights, backend, **more)


def assert_contract(found: Scores, wanted: np.ndarray) -> None:
    """The contract with results: R, P and V [p, 3] as plain NumPy recomputes them."""
    R, P, V = (column.numpy() for column in found[:3])
    assert (np.abs(R - wanted[:, 0]) <= 1e-6 * wanted[:, 0] + 1e-12).all()
    assert (np.abs(P - wanted[:, 1]) <= 1e-8).all()
    np.testing.assert_array_equal(V, wanted[:, 2])


def assert_same(found: Scores, wanted: Scores, index: int | list[int] | slice = slice(None)) -> None:
    """Bit for bit."""
    for column, other in zip(found, wanted, strict=True):
        assert torch.equal(column[index], other)


# ------------------------------------------------------------------ agreement


@pairs
@both
@backends
@pytest.mark.parametrize("m", [1, 2, 25])
@pytest.mark.parametrize(("k", "weighted"), [(1, False), (1, True), (3, False), (3, True)])
def test_fast_path_is_numpys(
    design: str, kernel: str, manipulation: str, backend: str, m: int, k: int, weighted: bool
) -> None:
    some = built(design, k, weighted)
    fast = evaluator(some, KERNELS[design][kernel], manipulation, backend)
    found = fast(some.centers(6, m, seed=m))
    wanted = numpys(design, kernel, manipulation, m, k, weighted)
    assert fast.backend == backend
    assert not found.failed.any()
    assert_contract(found, wanted)
    # Far inside the contract, in fact: these setups are random, not adversarial.
    np.testing.assert_allclose(found.regularity.numpy(), wanted[:, 0], rtol=1e-7)
    np.testing.assert_allclose(found.improvement_potential.numpy(), wanted[:, 1], rtol=0.0, atol=1e-9)
    assert all(column.dtype == torch.float64 for column in found[:3])


@pairs
@both
@backends
def test_fast_path_is_the_definition(design: str, kernel: str, manipulation: str, backend: str) -> None:
    some = built(design)
    fast = evaluator(some, KERNELS[design][kernel], manipulation, backend)
    centers = some.centers(3, 15, seed=5)
    found, wanted = fast(centers), fast.definition(centers)
    assert_contract(found, torch.stack(wanted[:3], dim=1).numpy())
    assert torch.equal(found.failed, wanted.failed)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
@both
@backends
def test_a_batch_is_a_loop(shape: tuple[int, ...], manipulation: str, backend: str) -> None:
    some = built("sphere")
    fast = evaluator(some, Wendland(1.0), manipulation, backend)
    centers = some.centers(*shape, 7)
    found = fast(centers)
    assert found.regularity.shape == found.failed.shape == shape
    assert found.objectives.shape == (*shape, 2)
    for i, setup in enumerate(centers.reshape(-1, 7, 3)):
        assert_same(Scores(*(column.reshape(-1) for column in found)), fast(setup), i)
    assert fast.definition(centers).regularity.shape == shape


@pairs
@backends
def test_potential_and_variability_are_the_same_for_both_manipulations(design: str, kernel: str, backend: str) -> None:
    some, phi = built(design), KERNELS[design][kernel]
    centers = some.centers(10, 25, seed=8)
    indirect, direct = (evaluator(some, phi, manipulation, backend)(centers) for manipulation in MANIPULATIONS)
    assert (indirect.improvement_potential - direct.improvement_potential).abs().max() <= 1e-8
    assert torch.equal(indirect.variability, direct.variability)
    assert (indirect.regularity != direct.regularity).all()


@pytest.mark.parametrize("kernel", [ThinPlate(), Cubic()], ids=["plane", "sphere"])
@both
@backends
def test_a_hundred_triharmonic_centers(kernel: Kernel, manipulation: str, backend: str) -> None:
    # The case in which every setup takes more than one pass.
    some = built("plane" if isinstance(kernel, ThinPlate) else "sphere", 1, False)
    centers = some.centers(3, 100, seed=4)
    fast = evaluator(some, kernel, manipulation, backend)
    found = fast(centers)
    assert fast.further_passes > 0
    assert fast.factorizations == 0
    assert_contract(found, np.array([numpy_scores(some, kernel, manipulation, setup) for setup in centers]))


@pairs
@both
def test_blocks_and_threads_change_no_score(design: str, kernel: str, manipulation: str) -> None:
    some, phi = built(design), KERNELS[design][kernel]
    centers = some.centers(9, 8, seed=2)
    reference = evaluator(some, phi, manipulation)(centers)
    for threads in (1, 2):
        torch.set_num_threads(threads)
        assert_same(evaluator(some, phi, manipulation)(centers), reference)
        for block in (100, 999, 10**6):
            found = evaluator(some, phi, manipulation, block=block)(centers)
            torch.testing.assert_close(found.regularity, reference.regularity, rtol=1e-8, atol=0.0)
            torch.testing.assert_close(
                found.improvement_potential, reference.improvement_potential, rtol=0.0, atol=1e-10
            )


@pytest.mark.parametrize("unit", [1e-3, 1e3, 2.0**-10, 2.0**10])
@both
@backends
@pytest.mark.parametrize("name", ["wendland", "cubic"])
def test_units_do_not_matter(unit: float, manipulation: str, backend: str, name: str) -> None:
    some = built("sphere")
    centers = some.centers(4, 12, seed=6)
    scores = []
    for scale in (1.0, unit):
        phi = Wendland(scale) if name == "wendland" else Cubic()
        scaled = Design(some.vertices * scale, some.gradient, some.weights)
        scores.append(evaluator(scaled, phi, manipulation, backend)(centers * scale))
    tolerance = 1e-13 if unit in (2.0**-10, 2.0**10) else 1e-8
    torch.testing.assert_close(scores[1].regularity, scores[0].regularity, rtol=tolerance, atol=0.0)
    torch.testing.assert_close(
        scores[1].improvement_potential, scores[0].improvement_potential, rtol=0.0, atol=tolerance
    )
    assert torch.equal(scores[1].variability, scores[0].variability)


# ------------------------------------------------------------------ conditioning


def near_duplicates(design: str, delta: float) -> torch.Tensor:
    """Three setups [3, 4, d] whose last two centers lie `delta` apart."""
    centers = small(design).centers(3, 4, seed=3)
    centers[:, 3] = centers[:, 2]
    centers[:, 3, 0] += delta
    return centers


@functools.cache
def exacts(design: str, kernel: str, manipulation: str, delta: float) -> np.ndarray:
    phi, centers = KERNELS[design][kernel], near_duplicates(design, delta)
    return np.array([exact_scores(small(design), phi, manipulation, setup) for setup in centers])


SMALL_PAIRS = [pair for pair in PAIRS if pair != ("plane", "wendland 0.25")]  # which reaches too few of 42 vertices


@pytest.mark.parametrize(("design", "kernel"), SMALL_PAIRS)
@both
@pytest.mark.parametrize("delta", [1e-3, 1e-5, 1e-7, 1e-9, 1e-12])
@pytest.mark.parametrize("path", ["fused", "eager", "definition"])
def test_near_duplicates_against_many_digits(
    design: str, kernel: str, manipulation: str, delta: float, path: str
) -> None:
    some, phi = small(design), KERNELS[design][kernel]
    centers = near_duplicates(design, delta)
    fast = evaluator(some, phi, manipulation, "eager" if path == "definition" else path)
    found = fast.definition(centers) if path == "definition" else fast(centers)
    R, P = found.regularity.numpy(), found.improvement_potential.numpy()
    exact = exacts(design, kernel, manipulation, delta)
    of_Phi = exacts(design, kernel, "indirect", delta)[:, 0]
    assert not found.failed.any()
    assert (of_Phi > 0).all()
    assert (found.variability == 4 / len(some.vertices)).all()
    assert (np.abs(P - exact[:, 1]) <= 1e-8 + EPS / of_Phi).all()
    if delta >= 1e-5:
        assert (np.abs(P - exact[:, 1]) <= 1e-8).all()
    if manipulation == "indirect":
        assert (np.abs(R - exact[:, 0]) <= 1e-6 * exact[:, 0] + 1e-12).all()
        return
    for setup, regularity, wanted in zip(centers.numpy(), R, exact[:, 0], strict=True):
        with np.errstate(all="ignore"):
            condition = np.linalg.cond(numpy_phi(phi, cdist(setup, setup)), 1)
        if condition > 1.0 / (4 * EPS):
            assert regularity == 0.0
        else:
            assert abs(regularity - wanted) <= (1e-6 + 4 * EPS * condition) * wanted + 1e-12
    assert (R > 0.0).all() or delta <= 1e-7


@pytest.mark.parametrize(("design", "kernel"), SMALL_PAIRS)
@both
@backends
def test_ordinary_setups_against_many_digits(design: str, kernel: str, manipulation: str, backend: str) -> None:
    some, phi = small(design), KERNELS[design][kernel]
    centers = some.centers(2, 4, seed=11)
    found = evaluator(some, phi, manipulation, backend)(centers)
    exact = np.array([exact_scores(some, phi, manipulation, setup) for setup in centers])
    np.testing.assert_allclose(found.regularity.numpy(), exact[:, 0], rtol=1e-9)
    np.testing.assert_allclose(found.improvement_potential.numpy(), exact[:, 1], rtol=0.0, atol=1e-10)


@pairs
@backends
@pytest.mark.parametrize("delta", [1e-4, 1e-6, 1e-8, 1e-10])
def test_near_duplicates_among_many_centers(design: str, kernel: str, backend: str, delta: float) -> None:
    some, phi = built(design), KERNELS[design][kernel]
    centers = some.centers(2, 10, seed=9)
    centers[:, 7] = centers[:, 1]
    centers[:, 7, 1] += delta
    found = evaluator(some, phi, "indirect", backend)(centers)
    wanted = np.array([numpy_scores(some, phi, "indirect", setup) for setup in centers])
    assert (np.abs(found.regularity.numpy() - wanted[:, 0]) <= 1e-6 * wanted[:, 0] + 1e-12).all()
    assert (np.abs(found.improvement_potential.numpy() - wanted[:, 1]) <= 1e-8 + EPS / wanted[:, 0]).all()
    np.testing.assert_array_equal(found.variability.numpy(), wanted[:, 2])


# ------------------------------------------------------------------ degenerate setups

TROUBLES = ("nan", "infinite", "minus infinite", "overflowing", "duplicate", "out of reach", "far", "collapsed")


def spoil(centers: torch.Tensor, trouble: str, position: int) -> None:
    """Spoil the setup [m, d] in place at one of its centers."""
    other = (position + 1) % len(centers)
    match trouble:
        case "nan":
            centers[position, 0] = torch.nan
        case "infinite":
            centers[position, 1] = torch.inf
        case "minus infinite":
            centers[position] = -torch.inf
        case "overflowing":
            centers[position] = 1e300
        case "duplicate":
            centers[position] = centers[other]
        case "out of reach":
            centers[position] = 30.0
        case "far":
            centers[position] = -1e60
        case "collapsed":
            centers[:] = centers[position].clone()


@pytest.mark.parametrize(
    ("design", "kernel"), [("plane", "wendland 0.5"), ("plane", "triharmonic"), ("sphere", "triharmonic")]
)
@both
@backends
def test_spoilt_setups_leave_the_others_alone(design: str, kernel: str, manipulation: str, backend: str) -> None:
    some, phi, m, p = built(design), KERNELS[design][kernel], 6, 4
    fast = evaluator(some, phi, manipulation, backend)
    sound = some.centers(p, m, seed=12)
    alone = fast(sound)
    for trouble in TROUBLES:
        for position in range(p):
            centers = torch.cat([sound[:position], some.centers(1, m, seed=13), sound[position:]])
            spoil(centers[position], trouble, position % m)
            found = fast(centers)
            others = [i for i in range(p + 1) if i != position]
            assert_same(found, alone, others)
            assert not alone.failed.any()
            wanted = fast.definition(centers[position])
            for column, value in zip(found, wanted, strict=True):
                assert torch.isfinite(column.double()).all()
                assert column[position].item() == pytest.approx(value.item(), rel=1e-6, abs=1e-8)
            fails = trouble in ("nan", "infinite", "minus infinite") or (trouble == "overflowing" and not phi.support)
            assert bool(found.failed[position]) == fails
            if fails:
                assert [float(column[position]) for column in found[:3]] == [0.0, 0.0, 0.0]


@pairs
@both
@backends
@pytest.mark.parametrize("threads", [1, 2])
def test_scores_do_not_depend_on_the_neighbours(
    design: str, kernel: str, manipulation: str, backend: str, threads: int
) -> None:
    some = built(design)
    fast = evaluator(some, KERNELS[design][kernel], manipulation, backend)
    centers = some.centers(4, 25, seed=14)
    torch.set_num_threads(threads)
    together = fast(centers)
    for index in ([0], [3], [1, 2], [1, 2, 3], [2, 0, 3]):
        assert_same(together, fast(centers[index]), index)


@both
@backends
@pytest.mark.parametrize("position", range(5))
def test_every_center_in_turn(manipulation: str, backend: str, position: int) -> None:
    some = built("plane")
    fast = evaluator(some, Wendland(0.25), manipulation, backend)
    centers = some.centers(5, seed=1)
    others = fast(torch.cat([centers[:position], centers[position + 1 :]]))

    # (a) not finite: failed.
    for value in (torch.nan, torch.inf):
        broken = centers.clone()
        broken[position, position % 2] = value
        found = fast(broken)
        assert [float(column) for column in found] == [0.0, 0.0, 0.0, 1.0]

    # (b) rank below m: R = 0, and P and V are those of the centers that are left.
    for trouble in ("duplicate", "out of reach"):
        broken = centers.clone()
        spoil(broken, trouble, position)
        found = fast(broken)
        wanted = others if trouble == "out of reach" else fast.definition(broken)
        assert found.regularity == 0.0
        assert found.variability.item() == 4 / len(some.vertices)
        assert found.improvement_potential.item() == pytest.approx(wanted.improvement_potential.item(), abs=1e-10)
        assert found.improvement_potential.item() == pytest.approx(
            numpy_scores(some, Wendland(0.25), manipulation, broken)[1], abs=1e-10
        )
        assert not found.failed


@backends
@both
def test_nothing_in_reach(backend: str, manipulation: str) -> None:
    some = built("plane")
    found = evaluator(some, Wendland(0.25), manipulation, backend)(some.centers(2, 4) + 50.0)
    for column in found:
        assert torch.equal(column, torch.zeros_like(column))


@backends
def test_singular_psi(backend: str) -> None:
    # (c) r^2 log r is 0 at distances 0 and 1, r^3 at 0: R = 0, and P and V are those of Phi.
    plane, sphere = built("plane"), built("sphere")
    apart = torch.tensor([[0.25, 0.5], [0.25, 1.5]], dtype=torch.float64)
    for some, phi, centers in (
        (plane, ThinPlate(), apart),
        (plane, ThinPlate(), plane.centers(1)),
        (sphere, Cubic(), sphere.centers(1)),
    ):
        indirect, direct = (evaluator(some, phi, manipulation, backend)(centers) for manipulation in MANIPULATIONS)
        assert direct.regularity == 0.0 < indirect.regularity
        assert direct.variability.item() == indirect.variability.item() == len(centers) / len(some.vertices)
        assert direct.improvement_potential.item() == pytest.approx(indirect.improvement_potential.item(), abs=1e-12)
        assert not direct.failed


@backends
def test_one_wendland_center_is_regular(backend: str) -> None:
    some = built("plane")
    for manipulation in MANIPULATIONS:
        found = evaluator(some, Wendland(0.5), manipulation, backend)(some.centers(1))
        assert found.regularity.item() == pytest.approx(1.0, abs=1e-15)
        assert found.variability.item() == 1 / len(some.vertices)


@both
@backends
def test_as_many_centers_as_vertices(manipulation: str, backend: str) -> None:
    some = DESIGNS["plane"](3, 3)
    fast = evaluator(some, Wendland(1.5), manipulation, backend)
    found = fast(some.vertices)
    assert found.improvement_potential.item() == pytest.approx(1.0, abs=1e-12)
    assert found.variability == 1.0
    if manipulation == "direct":  # U is the identity
        assert found.regularity.item() == pytest.approx(1.0, abs=1e-12)
    else:
        assert found.regularity.item() == pytest.approx(
            numpy_scores(some, Wendland(1.5), manipulation, some.vertices)[0], rel=1e-9
        )
    with pytest.raises(UserError, match="10 centers are more than the design's 9 vertices"):
        fast(some.centers(10))


@backends
@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 0, 2), ()])
def test_shapes_that_do_not_fit(backend: str, shape: tuple[int, ...]) -> None:
    fast = evaluator(built("plane"), Wendland(0.5), "indirect", backend)
    with pytest.raises(UserError, match=r"centers must have shape \[\*pop, m, 2\]"):
        fast(torch.zeros(shape, dtype=torch.float64))


@backends
def test_empty_population_and_single_precision(backend: str) -> None:
    some = built("plane")
    fast = evaluator(some, Wendland(0.5), "direct", backend)
    assert fast(some.centers(0, 5)).objectives.shape == (0, 2)
    centers = some.centers(3, 5).float()
    assert_same(fast(centers), fast(centers.double()))


@backends
@both
def test_centers_are_left_as_they_were(backend: str, manipulation: str) -> None:
    some = built("plane")
    centers = some.centers(4, 5)
    centers[2, 1, 0] = torch.nan
    copy = centers.clone()
    evaluator(some, Wendland(0.5), manipulation, backend)(centers)
    assert torch.equal(centers.nan_to_num(7.0), copy.nan_to_num(7.0))


@backends
def test_counters(backend: str) -> None:
    some = built("plane")
    fast = evaluator(some, Wendland(0.5), "indirect", backend)
    centers = some.centers(2, 5, 6)
    fast(centers)
    assert (fast.evaluations, fast.failed_evaluations) == (10, 0)
    assert (fast.further_passes, fast.factorizations) == (0, 0)
    centers[0, 1, 0, 0], centers[1, 3, 5, 1] = torch.nan, torch.inf
    centers[1, 4, 2] = centers[1, 4, 3]
    centers[0, 0, 2] = 30.0
    fast(centers)
    assert (fast.evaluations, fast.failed_evaluations) == (20, 2)
    assert (fast.further_passes, fast.factorizations) == (1, 1)


center = st.one_of(
    st.tuples(st.just("box"), st.integers(0, 50)),
    st.tuples(st.just("vertex"), st.integers(0, 50)),
    st.tuples(st.just("again"), st.integers(0, 50)),
    st.tuples(st.just("value"), st.sampled_from([torch.nan, torch.inf, 1e300, -1e60, 1e8, 40.0, 0.0])),
)


@given(recipe=st.lists(st.lists(center, min_size=4, max_size=4), min_size=1, max_size=4), sphere=st.booleans())
@settings(max_examples=60)
@both
@backends
@pytest.mark.parametrize("compact", [True, False])
def test_never_raises_and_agrees_with_the_definition(
    recipe: list, sphere: bool, manipulation: str, backend: str, compact: bool
) -> None:
    some = small("sphere" if sphere else "plane")
    d = some.vertices.shape[1]
    fast = evaluator(some, Wendland(1.0) if compact else (Cubic() if sphere else ThinPlate()), manipulation, backend)
    box = some.centers(51, seed=3)
    setups = []
    for row in recipe:
        points: list[torch.Tensor] = []
        for kind, value in row:
            if kind == "value":
                points.append(torch.full((d,), value, dtype=torch.float64))
            elif kind == "again" and points:
                points.append(points[value % len(points)])
            else:
                points.append((some.vertices if kind == "vertex" else box)[value % 42])
        setups.append(torch.stack(points))
    centers = torch.stack(setups)
    found, wanted = fast(centers), fast.definition(centers)
    assert torch.equal(found.failed, wanted.failed)
    assert torch.equal(found.variability, wanted.variability)
    torch.testing.assert_close(found.regularity, wanted.regularity, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found.improvement_potential, wanted.improvement_potential, rtol=0.0, atol=1e-8)


# ------------------------------------------------------------------ memory

MEMORY = """
    import re, sys, torch
    from rbfevo.scoring.evaluator import Evaluator
    from rbfevo.scoring.kernels import ThinPlate, Wendland

    def status(field):  # kB
        return int(re.search(field + r":\\s+(\\d+)", open("/proc/self/status").read()).group(1))

    torch.set_num_threads(1)
    backend, manipulation = sys.argv[1:]
    x, y = torch.linspace(0, 1, 150, dtype=torch.float64), torch.linspace(0, 2, 150, dtype=torch.float64)
    vertices = torch.stack([x.repeat(150), y.repeat_interleave(150)], dim=1)
    gradient = torch.sin(3 * vertices[:, :1])
    gradient = gradient / gradient.norm()
    generator = torch.Generator().manual_seed(0)
    centers = torch.rand(200, 25, 2, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 2.0]).double()
    centers[::20, 3] = centers[::20, 4]
    kernels = (Wendland(0.5), ThinPlate()) if backend == "fused" else (Wendland(0.5),)
    evaluators = [Evaluator(vertices, gradient, k, manipulation, backend=backend) for k in kernels]
    for evaluator in evaluators:
        evaluator(centers[:2])  # libraries and compiled code
    open("/proc/self/clear_refs", "w").write("5")  # the peak starts anew
    before = status("VmRSS")
    for evaluator in evaluators:
        scores = evaluator(centers)
        assert not scores.failed.any() and evaluator.factorizations >= 10
    print((status("VmHWM") - before) / 1024)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the peak of memory from /proc")
@pytest.mark.parametrize(("backend", "manipulation"), [("fused", "direct"), ("eager", "indirect")])
def test_scoring_needs_little_memory(backend: str, manipulation: str) -> None:
    # One stored U of all 200 setups would be 900 MB.
    command = [sys.executable, "-c", textwrap.dedent(MEMORY), backend, manipulation]
    environment = os.environ | {"PYTHONPATH": str(pathlib.Path(__file__).parents[1])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 0.0 <= float(done.stdout) < 200.0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_a_gpu_scores_host_centers_and_is_waited_for_once_a_pass(design: str, kernel: str, manipulation: str) -> None:
    mesh, phi = DESIGNS[design](), KERNELS[design][kernel]
    evaluate = Evaluator(mesh.vertices.cuda(), mesh.gradient.cuda(), phi, manipulation, mesh.weights.cuda())
    exact = Evaluator(mesh.vertices, mesh.gradient, phi, manipulation, mesh.weights)
    centers = mesh.centers(50, 20)
    evaluate(centers)
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            found = evaluate(centers)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert 1 <= len([w for w in waits if "synchroniz" in str(w.message)]) <= 4
    assert not found.regularity.is_cuda
    expected = exact(centers)
    torch.testing.assert_close(found.regularity, expected.regularity, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found.improvement_potential, expected.improvement_potential, rtol=0, atol=1e-8)


def test_bounds_decide_most_of_what_singular_values_would(monkeypatch: pytest.MonkeyPatch) -> None:
    m, least = 12, 3e-5
    ratios = torch.tensor([0.5, 2e-3, 3.1e-5, 2.9e-5, 1e-6, 1e-12], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    Q = torch.linalg.qr(torch.randn(len(ratios), m, m, generator=generator, dtype=torch.float64))[0]
    spread = torch.linspace(0.0, 1.0, m, dtype=torch.float64)
    L = torch.linalg.qr((ratios[:, None] ** spread)[:, :, None] * Q.mT)[1].mT
    sigma, looked = torch.linalg.svdvals(L), []
    monkeypatch.setattr(evaluators, "singular_values", lambda A: looked.append(len(A)) or torch.linalg.svdvals(A))
    assert is_regular(L, least).tolist() == (sigma[:, -1] > least * sigma[:, 0]).tolist() == [True] * 3 + [False] * 3
    assert looked == [2]


@pytest.mark.parametrize("threads", [1, 2])
@both
def test_slices_of_a_population_change_nothing(
    manipulation: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = built("plane")
    centers = some.centers(11, 9, seed=2)
    centers[4, 2] = centers[4, 1]
    centers[7] = torch.nan
    slopes = torch.randn(11, 10, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def found() -> tuple[list[torch.Tensor], list[int]]:
        fast = evaluator(some, ThinPlate(), manipulation)
        spectrum = fast.spectrum(centers)
        gradient = spectrum.backward(slopes[:, :9], slopes[:, 9])
        attributes = (spectrum.sigma, spectrum.regularity, spectrum.potential, spectrum.potentials, spectrum.regular)
        counters = [fast.evaluations, fast.failed_evaluations, fast.gradients, fast.further_passes, fast.factorizations]
        return [*fast(centers), *attributes, spectrum.improvable, spectrum.centers, gradient], counters

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        whole, counted = found()
        monkeypatch.setattr(sliced, "BYTES", 3 * 8 * 9 * 9)  # three setups a slice
        slices, again = found()
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(whole, slices, strict=True))
    assert counted == again
    assert counted[:3] == [11, 1, 11]
    assert counted[3] > 0


@pytest.mark.parametrize(("count", "most", "threads", "sizes"), [
    (10, 10, 2, [10]), (10, 9, 2, [5, 5]), (10, 4, 2, [4, 4, 2]), (10, 4, 1, [4, 4, 2]), (10, 9, 1, [9, 1]),
    (0, 3, 2, [0]),
])  # fmt: skip
def test_slices_make_up_the_whole_in_order(count: int, most: int, threads: int, sizes: list[int]) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        found = results_of_slices(lambda rows: rows, count, most)
    finally:
        torch.set_num_threads(before)
    assert [rows.stop - rows.start for rows in found] == sizes
    assert [i for rows in found for i in range(count)[rows]] == list(range(count))


def test_blocks_are_small_where_a_kernel_reaches_little() -> None:
    coarse, fine = built("plane").vertices, torch.rand(5000, 2, generator=torch.Generator().manual_seed(0)).double()
    sizes = [fused_block(points, support) for points in (coarse, fine) for support in (0.0, 0.1, 0.45, 2.0)]
    assert sizes[:2] == [1024, 256]
    assert sizes[3:] == [1024, 1024, 512, 512, 1024]
