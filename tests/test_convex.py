"""Solids as convex pieces, against shapes whose pieces are known; how well pieces fill a solid."""

import itertools

import numpy as np
import pytest
import trimesh
from few import FEW
from hypothesis import given
from hypothesis import strategies as st
from manifold3d import Manifold
from shapes import box

from articugen.core.records import Mesh
from articugen.meshes import convex
from articugen.meshes.convex import agreement, apart, convex_pieces
from articugen.meshes.simpler import hull, united


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
    iou, cavities = agreement(pieces, mesh)
    assert (iou > 0.99, cavities) == (True, [])


def test_crossing_bars_are_two_pieces_not_three() -> None:
    mesh = meshed(trimesh.boolean.union([box((3.0, 0.5, 0.5)), box((0.5, 3.0, 0.5))]))
    pieces = convex_pieces(mesh)
    assert (len(pieces), agreement(pieces, mesh)[0] > 0.99) == (2, True)


def test_round_solids_have_few_corners_and_bent_ones_few_pieces() -> None:
    ball = meshed(trimesh.creation.icosphere(subdivisions=4))
    (piece,) = convex_pieces(ball)
    assert len(piece.vertices) <= 64
    assert agreement([piece], ball)[0] > 0.8
    ring = meshed(trimesh.creation.torus(1.0, 0.1))
    pieces = convex_pieces(ring)
    assert len(pieces) < 32
    assert all(len(piece.vertices) <= 64 for piece in pieces)
    assert agreement(pieces, ring)[0] > 0.93


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
    assert agreement([plain], plain) == (pytest.approx(1.0), [])
    (piece,) = convex_pieces(hollow)
    iou, cavities = agreement([piece], hollow)
    assert iou == pytest.approx(7 / 8)
    assert cavities == pytest.approx([0.075])


def test_what_hulls_hold_besides_counts_against_them() -> None:
    ell = meshed(
        trimesh.boolean.union([box((2.0, 1.0, 1.0)), box((1.0, 1.0, 1.0), (-0.5, 1.0, 0.0))])
    )
    assert agreement([hull(ell.vertices)], ell)[0] == pytest.approx(6 / 7)
    half = meshed(box((1.0, 1.0, 1.0), (0.5, 0.0, 0.0)))
    assert agreement([half], ell)[0] == pytest.approx(1 / 3)
    assert agreement([half, half], ell)[0] == pytest.approx(1 / 3)  # what two hold counts once


@pytest.mark.parametrize("thick", [1.0, 1e-2, 1e-4])
def test_a_disc_of_many_corners_keeps_its_volume_with_few(thick: float) -> None:
    disc = meshed(trimesh.creation.cylinder(1.0, thick, sections=400))
    (piece,) = convex_pieces(disc)
    assert len(piece.vertices) <= 64
    assert agreement([piece], disc)[0] > 0.99  # of 32 corners above and below: 0.9936


def test_a_mesh_that_is_not_watertight_is_its_hull_and_none_is_nothing() -> None:
    whole = box((1.0, 2.0, 3.0))
    open_one = Mesh(np.asarray(whole.vertices), np.asarray(whole.faces[1:], np.int32))
    (piece,) = convex_pieces(open_one)
    assert agreement([piece], meshed(whole)) == (pytest.approx(1.0), [])
    assert agreement([piece], open_one)[0] == 0.0
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert convex_pieces(nothing) == ()


def test_what_several_closed_meshes_are_is_cut_apart_into_them_first() -> None:
    """A tray whose walls run through its floor and past one another: five boards, five pieces, and
    no space counts twice."""
    low, at = (0.1, 2.0, 1.0), 0.95
    walls = [box(low, (at, 0, 0)), box(low, (-at, 0, 0))]
    walls += [box((2.0, 0.1, 1.0), (0, y, 0)) for y in (at, -at)]
    boards = [box((2.0, 2.0, 0.1), (0, 0, -0.45)), *walls]
    whole, closed = meshed(trimesh.boolean.union(boards)), [meshed(board) for board in boards]
    solids = apart(whole, closed)
    assert len(solids) == 5
    volumes = [trimesh.Trimesh(solid.vertices, solid.faces).volume for solid in solids]
    assert sum(volumes) == pytest.approx(trimesh.Trimesh(whole.vertices, whole.faces).volume)
    pieces = convex_pieces(*solids)
    assert (len(pieces), agreement(pieces, whole)[0]) == (5, pytest.approx(1.0))
    crossed = trimesh.util.concatenate(boards)  # as one mesh, which winds around some space twice
    assert len(apart(whole, [meshed(crossed)])) == 5


def test_closed_meshes_are_united_but_where_corners_meet_or_colours_would_be_lost() -> None:
    low, high = meshed(box((0.25, 0.5, 0.5))), meshed(box((0.5, 0.25, 0.25)))
    both = united([low, high])
    assert both is not None
    solid = trimesh.Trimesh(both.vertices, both.faces)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(0.0625 + 0.03125 - 0.015625)
    beside = meshed(box((0.25, 0.5, 0.5), (0.25 + 1e-9, 0.0, 0.0)))  # touches but for rounding
    wide = united([low, beside])
    assert wide is not None
    assert len(np.unique(wide.vertices[:, 0])) == 3  # and no wall is left between
    assert trimesh.Trimesh(wide.vertices, wide.faces).body_count == 1
    at_an_edge = meshed(box((0.25, 0.5, 0.5), (0.25, 0.5, 0.0)))
    assert united([low, at_an_edge]) is None
    grey = np.full((12, 3), 90, np.uint8)
    two = grey.copy()
    two[0] = 20
    assert united([Mesh(low.vertices, low.faces, grey), high]) is not None
    assert united([Mesh(low.vertices, low.faces, two), high]) is None


def test_closed_meshes_that_are_not_all_of_a_solid_are_none_of_it() -> None:
    whole, one = carcass(0.1, 1), meshed(box((1.0, 1.0, 0.1), (0.0, 0.0, 0.95)))
    assert apart(whole, [one]) == apart(whole, []) == (whole,)
    open_one = Mesh(one.vertices, one.faces[1:])
    assert apart(one, [open_one]) == (one,)
    assert apart(one, [one] * (convex._SOLIDS + 1)) == (one,)


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.01, 0.5))
@FEW
def test_pieces_are_joined_as_if_every_pair_was_measured(seed: int, share: float) -> None:
    """Bounds only put off what need not be measured: the cheapest pair is joined, again and
    again."""
    pieces = [_piece(low, high) for low, high in boards(np.random.default_rng(seed))]
    spare = share * sum(piece.volume for piece in pieces)
    joined = convex._joined(pieces, spare)
    assert sorted(hull.volume() for hull in joined) == pytest.approx(
        sorted(hull.volume() for hull in joined_naively(pieces, spare)), abs=1e-12
    )


def boards(rng: np.random.Generator, count: int = 8) -> list[tuple[np.ndarray, np.ndarray]]:
    """Boxes that a cube is cut into, again and again, without two of them, and with gaps."""
    boxes = [(np.zeros(3), np.ones(3))]
    while len(boxes) < count:
        low, high = boxes.pop(rng.integers(len(boxes)))
        axis, at = rng.integers(3), rng.uniform(0.2, 0.8)
        middle = low[axis] + at * (high - low)[axis]
        boxes += [(low, np.where(np.arange(3) == axis, middle, high))]
        boxes += [(np.where(np.arange(3) == axis, middle, low), high)]
    return [(low, low + rng.uniform(0.8, 1.0, 3) * (high - low)) for low, high in boxes[2:]]


def joined_naively(pieces: list, spare: float) -> list[Manifold]:
    hulls = [(piece.hull, [k], piece.excess) for k, piece in enumerate(pieces)]
    while True:
        best, cheapest = None, spare
        for one, other in itertools.combinations(hulls, 2):
            hull, both = Manifold.batch_hull([one[0], other[0]]), one[1] + other[1]
            volume = sum(pieces[k].volume for k in both)
            among = [pieces[k].solid for k in range(len(pieces)) if k not in both]
            excess = hull.volume() - volume - sum((hull ^ solid).volume() for solid in among)
            more = max(excess, 0.0) - one[2] - other[2]
            if hull.volume() < 2.0 * volume and more <= cheapest:
                best, cheapest = (one, other, (hull, both, max(excess, 0.0))), more
        if best is None:
            return [hull for hull, _, _ in hulls]
        spare -= max(cheapest, 0.0)
        hulls = [hull for hull in hulls if hull is not best[0] and hull is not best[1]] + [best[2]]


def _piece(low: np.ndarray, high: np.ndarray) -> convex._Piece:
    solid = Manifold.cube(high - low).translate(low)
    return convex._Piece(solid, solid.hull(), solid.volume(), 0.0)
