"""Boxes of free-form deformation that somebody has placed, as genotypes: from exports and files of other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.names import existing_home
from rbfevo.scenarios.lattices import LatticeFile, read_lattice
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.representations import bsplines
from rbfevo.scoring.representations.lattice import Lattice

if TYPE_CHECKING:
    from rbfevo.scoring.representations.ffd import FFD

NEAR = 1e-6  # of the diagonal of a box: files of other programs round


def read_box(path: str, representation: FFD, scenario: Scenario) -> Array:
    """The genotype [D] of the box in a file, for the lattice of a representation.

    Raises:
        UserError: if the file cannot be read, its box is none of this lattice, or no vertex of the design lies in it.
    """
    place = existing_home(path)
    try:
        if place.is_dir() or place.suffix == ".npz":
            genotype = _exported(place, representation)
        elif representation.picked is not None:
            raise UserError("it has a whole lattice, of which centers= takes a part; leave centers= out")
        else:
            genotype = of_lattice(read_lattice(place), representation.lattice)
        return _on_scenario(genotype, representation, scenario)
    except UserError as error:
        text = str(error)
        raise UserError(text if text.startswith(str(place)) else f"{path}: {text}") from None


def _exported(place: Path, representation: FFD) -> Array:
    """The genotype of an export of rbfevo.

    Raises:
        UserError: if it is none of this lattice.
    """
    file = place / "setup.npz" if place.is_dir() else place
    if place.is_dir() and (place / "setups.npz").is_file():
        raise UserError(f"this is a run, with many setups; export one: python -m rbfevo.export {place} --pick knee")
    try:
        with np.load(file, allow_pickle=False) as archive:
            spec, genotype = json.loads(archive["representation_spec"].item()), archive["genotype"]
    except FileNotFoundError:
        raise UserError("this directory has no setup.npz, so it is no export of rbfevo") from None
    except KeyError:
        raise UserError("its setup is none of representation=ffd") from None
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"cannot be read: damaged? ({' '.join(str(error).split())})") from None
    own: dict[str, Any] = representation.spec()
    for key in ("lattice", "degree", "turn", "knots", "still", "picked"):
        if spec.get(key) != own[key]:
            raise UserError(f"its {key} is {spec.get(key)}, and that of the run {own[key]}")
    return np.array(genotype, dtype=np.float64)


def of_lattice(found: LatticeFile, lattice: Lattice) -> Array:
    """The genotype [D] of a lattice in space.

    Raises:
        UserError: if it has other numbers of control points, is not rectangular, or is turned as the run has it not.
    """
    d, counts = lattice.dimension, lattice.counts
    whole = (*counts, *[1] * (3 - d))
    shown = " x ".join(map(str, counts))
    places = found.places
    if found.counts is None:
        if len(places) != np.prod(whole):
            raise UserError(f"it has {len(places)} points, and the lattice {shown} of the run {np.prod(whole)}")
        places = places.reshape(*whole[::-1], 3).transpose(2, 1, 0, 3)
    elif found.counts != whole:
        other = " x ".join(map(str, found.counts))
        raise UserError(f"its lattice is {other}, and representation.lattice={list(counts)}")
    if d == 2 and places[..., 2].any():
        raise UserError("its points have a coordinate z, and the scenario has two dimensions")
    places = places[..., 0, :2] if d == 2 else places
    first = places[(0,) * d]
    sides = np.stack([places[tuple(-1 if axis == other else 0 for other in range(d))] - first for axis in range(d)])
    lengths = np.linalg.norm(sides, axis=1)
    if not lengths.min() > NEAR * lengths.max():
        raise UserError("its box is flat")
    genotype = np.zeros(lattice.size)
    genotype[:d], genotype[d : 2 * d] = first + sides.sum(axis=0) / 2.0, lengths / 2.0
    axes = sides / lengths[:, None]  # a row each
    if lattice.turn is not None:
        a, b = lattice.turned
        genotype[2 * d] = np.arctan2(axes[a, b], axes[a, a])
    corners_only = found.counts is not None and found.places.shape[:3] == (2, 2, 2)
    if lattice.knots:
        begin = lattice.first_knot
        for axis, (k, p, n) in enumerate(zip(lattice.inner, lattice.degrees, counts, strict=True)):
            knots = bsplines.uniform(n, p)
            if not corners_only:
                row = places[tuple(slice(None) if axis == other else 0 for other in range(d))] - first
                knots = bsplines.of_greville(row @ axes[axis] / lengths[axis], p)
            genotype[begin : begin + k] = knots
            begin += k
    expected = lattice.places(genotype)
    if corners_only:
        ends = (slice(None, None, n - 1) for n in counts)
        expected = expected[(*ends, slice(None))]
    away = float(np.abs(expected - places).max())
    if away > NEAR * float(np.linalg.norm(lengths)):
        turn = "" if lattice.turn is None else f", turned about {'xyz'[lattice.turn]} at most"
        raise UserError(
            f"its control points are up to {away:.3g} away from those of an undeformed box{turn}, with the degrees "
            f"{list(lattice.degrees)}; set representation.degree and representation.turn as the file has them"
        )
    return genotype


def _on_scenario(genotype: Array, representation: FFD, scenario: Scenario) -> Array:
    """The genotype, exactly symmetric where the design is.

    Raises:
        UserError: if the box is not symmetric where it should be, or holds no vertex.
    """
    lattice, mirror = representation.lattice, scenario.mirror
    size = lattice.size + (representation.picked or 0)
    if genotype.shape != (size,):
        raise UserError(f"its setup has {genotype.size} numbers, and one of the run {size}")
    if mirror is not None:
        axis = mirror.axis
        away = abs(genotype[axis] - mirror.at)
        if away > NEAR * float(np.linalg.norm(genotype[lattice.dimension : 2 * lattice.dimension])):
            raise UserError(
                f"its centre is {away:.3g} away from the symmetry plane {'xyz'[axis]} = {mirror.at:g}: give a box that "
                "is symmetric about it"
            )
        genotype[axis] = mirror.at
    inside = lattice.local(scenario.vertices.cpu().numpy(), genotype)[1]
    if not inside.any():
        raise UserError("no vertex of the design lies in its box")
    return genotype
