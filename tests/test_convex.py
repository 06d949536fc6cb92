"""Solids as convex pieces, against shapes whose pieces are known; how well pieces fill a solid."""

import numpy as np
import pytest
import trimesh
from shapes import box

from articugen.core.records import Mesh
from articugen.meshes.convex import agreement, convex_pieces
from articugen.meshes.simpler import hull


def meshed(solid: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces, np.int32))


def carcass(wall: float, shelves: int) -> Mesh:
    """A cabinet of 1 x 1 x 2 that is open towards +x, with shelves all the way to the front."""
    rooms = shelves + 1
    height = (2.0 - wall * (rooms + 1)) / rooms
    spaces = [
        box(
            (1.0, 1 - 2 * wall, height), (wall, 0.0, -1.0 + wall + height / 2 + k * (height + wall))
        )
        for k in range(rooms)
    ]
    return meshed(trimesh.boolean.difference([box((1.0, 1.0, 2.0)), *spaces]))


@pytest.mark.parametrize("wall", [0.1, 0.006])
@pytest.mark.parametrize("shelves", [0, 3])
def test_a_carcass_is_its_boards(wall: float, shelves: int) -> None:
    mesh = carcass(wall, shelves)
    pieces = convex_pieces(mesh)
    assert len(pieces) == 5 + shelves
    iou, cavities = agreement(mesh, pieces)
    assert (iou > 0.99, cavities) == (True, [])


def test_crossing_bars_are_two_pieces_not_three() -> None:
    mesh = meshed(trimesh.boolean.union([box((3.0, 0.5, 0.5)), box((0.5, 3.0, 0.5))]))
    pieces = convex_pieces(mesh)
    assert (len(pieces), agreement(mesh, pieces)[0] > 0.99) == (2, True)


def test_round_solids_have_few_corners_and_bent_ones_few_pieces() -> None:
    ball = meshed(trimesh.creation.icosphere(subdivisions=4))
    (piece,) = convex_pieces(ball)
    assert len(piece.vertices) <= 64
    assert agreement(ball, [piece])[0] > 0.8
    ring = meshed(trimesh.creation.torus(1.0, 0.1))
    pieces = convex_pieces(ring)
    assert len(pieces) < 32
    assert all(len(piece.vertices) <= 64 for piece in pieces)
    assert agreement(ring, pieces)[0] > 0.93


def test_pieces_are_convex_the_same_each_time_and_at_any_size() -> None:
    mesh = carcass(0.05, 1)
    pieces, again = convex_pieces(mesh), convex_pieces(mesh)
    small = convex_pieces(Mesh(np.asarray(mesh.vertices) / 1024, mesh.faces))
    assert len(pieces) == len(again) == len(small)
    for one, other in zip(pieces, again, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.faces, other.faces)
        solid = trimesh.Trimesh(one.vertices, one.faces)
        assert solid.volume == pytest.approx(solid.convex_hull.volume, rel=1e-9)
        assert solid.area_faces.min() > 1e-9 * solid.area


def test_pieces_fill_what_a_solid_encloses_and_that_is_stated() -> None:
    plain, inner = meshed(box((0.3, 2.0, 1.0))), meshed(box((0.15, 1.0, 0.5)))
    every = np.concatenate([plain.vertices, inner.vertices])
    hollow = Mesh(every, np.concatenate([plain.faces, inner.faces[:, ::-1] + len(plain.vertices)]))
    assert agreement(plain, [plain]) == (pytest.approx(1.0), [])
    (piece,) = convex_pieces(hollow)
    iou, cavities = agreement(hollow, [piece])
    assert iou == pytest.approx(7 / 8)
    assert cavities == pytest.approx([0.075])


def test_what_hulls_hold_besides_counts_against_them() -> None:
    ell = meshed(
        trimesh.boolean.union([box((2.0, 1.0, 1.0)), box((1.0, 1.0, 1.0), (-0.5, 1.0, 0.0))])
    )
    assert agreement(ell, [hull(ell.vertices)])[0] == pytest.approx(6 / 7)
    half = meshed(box((1.0, 1.0, 1.0), (0.5, 0.0, 0.0)))
    assert agreement(ell, [half])[0] == pytest.approx(1 / 3)
    assert agreement(ell, [half, half])[0] == pytest.approx(1 / 3)  # what two hold counts once


@pytest.mark.parametrize("thick", [1.0, 1e-2, 1e-4])
def test_a_disc_of_many_corners_keeps_its_volume_with_few(thick: float) -> None:
    disc = meshed(trimesh.creation.cylinder(1.0, thick, sections=400))
    (piece,) = convex_pieces(disc)
    assert len(piece.vertices) <= 64
    assert agreement(disc, [piece])[0] > 0.99  # of 32 corners above and below: 0.9936


def test_a_mesh_that_is_not_watertight_is_its_hull_and_none_is_nothing() -> None:
    whole = box((1.0, 2.0, 3.0))
    open_one = Mesh(np.asarray(whole.vertices), np.asarray(whole.faces[1:], np.int32))
    (piece,) = convex_pieces(open_one)
    assert agreement(meshed(whole), [piece]) == (pytest.approx(1.0), [])
    assert agreement(open_one, [piece])[0] == 0.0
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert convex_pieces(nothing) == ()
