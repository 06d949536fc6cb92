"""Features thinner than a pixel: the field is that of exact rays, not of pixel centres."""

import tracemalloc

import numpy as np
import pytest
import trimesh

from articugen.core.arrays import Indices
from articugen.core.recipe import Recipe
from articugen.core.records import LabelledMesh
from articugen.fusion.reachable import touched
from articugen.fusion.thin import NOTHING, ThinVoxels, thin_voxels
from articugen.instance.preparing import own_solid, solid_part
from articugen.meshes.bvh import tree_of
from tests.shapes import Convex, box, labelled, rotated, towards_cameras

RECIPE = Recipe(name="test")
THIN = 0.6 / 256  # thinner free-standing plates count as sheets


def comb(gap: float, thickness: float) -> list[trimesh.Trimesh]:
    """Upright plates on a base."""
    at = np.arange(-0.3, 0.3, gap + thickness)
    return [
        box((0.8, 0.6, 0.05), (0, 0, -0.2)),
        *(box((thickness, 0.5, 0.2), (x, 0, -0.075)) for x in at),
    ]


@pytest.mark.parametrize(("gap", "thickness"), [(0.05, THIN), (THIN, 0.05)], ids=["bars", "slits"])
def test_bars_and_slits_thinner_than_a_pixel_are_as_exact_rays_have_them(gap, thickness):
    pieces = [rotated(piece, 0.5, (1, 2, 3)) for piece in comb(gap, thickness)]
    part = solid_part(labelled(trimesh.util.concatenate(pieces)), RECIPE)
    field = own_solid(part, RECIPE).field
    rng = np.random.default_rng(0)
    turned = trimesh.transformations.rotation_matrix(0.5, (1, 2, 3))
    local = rng.uniform((-0.3, -0.25, -0.175), (0.3, 0.25, 0.03), (20_000, 3))
    pitch = gap + thickness
    nearest = -0.3 + pitch * np.round((local[:, 0] + 0.3) / pitch)
    middle = nearest if gap > thickness else nearest + pitch / 2
    local[:, 0] = middle + THIN * rng.uniform(-0.6, 0.6, len(local))
    points = local @ turned[:3, :3].T
    solid = Convex.of(*pieces)
    exact = solid.seen_free(points, towards_cameras(field.maps.views)) & ~solid.inside(points)
    found = field.is_free(points)
    assert 0.1 < exact.mean() < 0.9
    assert np.mean(found == exact) >= 0.9995


def marked_voxels(marked: ThinVoxels) -> Indices:
    """(n, 3) the lattice's numbers of those that are marked."""
    return np.argwhere(np.unpackbits(marked.bits, axis=2, bitorder="little")) + marked.first


def test_only_what_is_slender_is_marked() -> None:
    thick = labelled(box((0.5, 0.4, 0.3)))
    plate = labelled(box((0.5, 0.4, 0.3), (0, 0, -0.2)), box((0.3, 0.3, 0.004), (0, 0, 0.2)))
    trees = [tree_of(m.vertices[m.faces]) for m in (thick, plate)]
    assert thin_voxels(thick, 1 / 128, trees[0]) is NOTHING
    marked = marked_voxels(thin_voxels(plate, 1 / 128, trees[1])) / 128 - 0.5
    assert len(marked) > 1000
    assert np.all(np.abs(marked[:, 2] - 0.2) < 2 / 128)
    assert np.all(np.abs(marked[:, :2]) < 0.16)


@pytest.mark.parametrize("size", [1.0, 1 / 200, 1 / 2000])
def test_marks_take_little_memory_however_small_the_part(size: float) -> None:
    """A button 1/200 of the object wide: a lattice over the whole cube would take 134 GB."""
    key = [box((0.5, 0.4, 0.002)), box((0.3, 0.3, 0.2), (0, 0, -0.101))]
    for piece in key:
        piece.apply_scale(size)
        piece.apply_translation((0.3, -0.4, 0.2))
    mesh = labelled(trimesh.util.concatenate(key))
    tree = tree_of(mesh.vertices[mesh.faces])
    tracemalloc.start()
    found = thin_voxels(mesh, size / 256, tree)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(marked_voxels(found)) > 1000
    assert peak < 20e6
    assert found.bits.nbytes < 5e6


def test_marks_are_those_of_a_lattice_over_the_whole_cube() -> None:
    """However few of its voxels are kept; and finer views than memory allows get wider voxels."""
    plate = labelled(rotated(box((0.5, 0.3, 0.001), (0.1, 0.1, 0.2)), 0.4, (1, 2, 3)))
    tree = tree_of(plate.vertices[plate.faces])
    areas = trimesh.triangles.area(plate.vertices[plate.faces])
    broad = LabelledMesh(
        plate.vertices, plate.faces[areas > 0.05], plate.part_of_face[areas > 0.05]
    )
    assert len(broad.faces) == 4
    assert np.array_equal(
        marked_voxels(thin_voxels(plate, 1 / 96, tree)), np.argwhere(touched(broad, 96))
    )
    fine = thin_voxels(plate, 1 / 900, tree)
    assert 300 < np.ptp(marked_voxels(fine), axis=0).max() < 320
