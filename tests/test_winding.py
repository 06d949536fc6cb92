"""The winding number about closed pieces, against shapes of which every point is known."""

import numpy as np
import pytest
import trimesh

from articugen.core.records import LabelledMesh
from articugen.fusion import solidify
from articugen.fusion.winding import ClosedPieces, closed_pieces, surely_inside
from articugen.meshes.bvh import tree_of
from tests.shapes import Convex, box, labelled, rotated


def of(mesh: LabelledMesh, piece: np.ndarray | None = None) -> ClosedPieces:
    piece = solidify.closed_piece(mesh) if piece is None else piece
    found = closed_pieces(mesh, piece, tree_of(mesh.vertices[mesh.faces]))
    assert found is not None
    return found


def points(count: int = 20_000) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3))


RING = trimesh.creation.torus(0.2, 0.05)

SHAPES = {
    "turned box": lambda: [rotated(box((0.6, 0.5, 0.3)), 0.5, (1, 2, 3))],
    "box along the axes": lambda: [box((0.5, 0.5, 0.5))],
    "boxes that meet, cross and lie in each other": lambda: [
        box((0.4, 0.2, 0.2), (-0.1, 0, 0)),
        box((0.4, 0.2, 0.2), (0.3, 0, 0)),
        box((0.2, 0.6, 0.1)),
        box((0.05, 0.05, 0.05)),
    ],
    "many thin bars": lambda: [
        box((0.9, 0.01, 0.01), (0, y, 0)) for y in np.linspace(-0.4, 0.4, 30)
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_inside_is_what_the_shapes_hold(name):
    meshes = SHAPES[name]()
    asked = np.concatenate([points(), 0.3 * points(2000), np.round(points(2000) * 40) / 40])
    exact = Convex.of(*meshes).inside(asked)
    sure = surely_inside(asked, of(labelled(*meshes)))
    assert not (sure & ~exact).any()
    on_faces = slice(-2000, None)  # of a lattice that runs along faces: little is sure there
    missed = exact & ~sure
    missed[on_faces] = False
    assert not missed.any()


def test_a_sphere_of_many_faces():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    asked = points()
    sure = surely_inside(asked, of(labelled(sphere)))
    radius = np.linalg.norm(asked, axis=1)
    assert sure[radius < 0.398].all()  # rays along edges included: another is sent
    assert not sure[radius > 0.4].any()


def test_a_cavity_is_not_inside_and_an_open_shell_says_nothing():
    shell = trimesh.util.concatenate([box((0.8, 0.8, 0.8)), box((0.6, 0.6, 0.6))])
    inner = slice(12, 24)
    shell.faces[inner] = shell.faces[inner, ::-1]
    mesh = labelled(shell)
    inside = surely_inside(points(), of(mesh, np.arange(24) // 12))
    most = np.abs(points()).max(axis=1)
    np.testing.assert_array_equal(inside, (most < 0.4) & (most > 0.3))
    open_box = box((0.8, 0.8, 0.8))
    open_box.update_faces(np.arange(12) != 3)
    mesh = labelled(open_box)
    tree = tree_of(mesh.vertices[mesh.faces])
    assert closed_pieces(mesh, solidify.closed_piece(mesh), tree) is None


@pytest.mark.parametrize("name", SHAPES)
def test_planes_say_what_rays_say_and_more(name):
    boxes = SHAPES[name]()
    found = of(labelled(*boxes, RING))
    assert 1 <= len(found.piece) <= len(boxes)  # all but the torus, and those that touch
    by_rays = found._replace(skip=found.skip[:0], others=found.every)
    corners = np.concatenate([piece.vertices for piece in boxes])
    asked = np.concatenate([points(), *(corners + far for far in (0, 3e-6, -3e-6, 3e-5, -3e-5))])
    sure, rays = surely_inside(asked, found), surely_inside(asked, by_rays)
    assert not (rays & ~sure).any()
    more = asked[sure & ~rays]  # close to the short edge of a long face rays are in doubt
    assert Convex.of(*boxes).inside(more).all()
    assert len(more) < 100
