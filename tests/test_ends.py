"""Where material ends, against closed forms and the exact solids of bundled objects."""

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import articugen as ag
from articugen import fusion
from articugen.core.geometry import apply, points_on_triangles, rotation_about, transform
from articugen.core.recipe import Recipe, ViewSettings
from articugen.core.records import LabelledMesh
from articugen.inspection.check.faces import Soup
from articugen.instance.articulation import forward_kinematics
from articugen.instance.preparing import own_solid, pose, solid_part
from articugen.procedural.truth import truth_of
from tests.shapes import box, iou, labelled

RECIPE = Recipe(name="ends", views=ViewSettings(count=40, resolution=128))


def union_distance(points, ends):
    """The signed distance of the union of boxes (n, 2, 3): the space between all their planes is
    cells, each of them solid or free."""
    planes = [np.unique([-9.0, 9.0, *ends[:, :, axis].ravel()]) for axis in range(3)]
    cells = np.array([
        np.transpose(sides) for sides in product(*map(pairwise, planes))
    ])  # fmt: skip
    middle = cells.mean(axis=1)[:, None]
    solid = ((middle > ends[:, 0]) & (middle < ends[:, 1])).all(axis=2).any(axis=1)
    beyond = np.maximum(cells[:, 0, None] - points, points - cells[:, 1, None])
    far = np.linalg.norm(np.maximum(beyond, 0.0), axis=2)
    return far[solid].min(axis=0) - far[~solid].min(axis=0)


SIDES = st.tuples(st.integers(-3, 1), st.integers(1, 3)).map(lambda a: (a[0], min(a[0] + a[1], 3)))
BOX = st.tuples(SIDES, SIDES, SIDES)
CUBE = ((-3, 1), (-3, 1), (-3, 1))


@settings(max_examples=15, deadline=None)
@given(BOX, BOX, BOX, st.booleans(), st.integers(0, 3))
@example(CUBE, ((-1, 3), (-1, 3), (-1, 3)), CUBE, False, 1)  # overlapping
@example(CUBE, ((1, 3), (-2, 0), (-2, 0)), CUBE, False, 1)  # touching
@example(CUBE, ((1, 3), (-2, 0), (-2, 0)), CUBE, True, 0)  # touching, of two parts
@example(CUBE, ((-2, 0), (-2, 0), (-2, 0)), CUBE, True, 2)  # one in the other
def test_distances_of_boxes_are_those_of_their_union(a, b, c, two_parts, turn):
    ends = np.array([a, b, c], float).transpose(0, 2, 1) / 10.0
    boxes = [box(high - low, (high + low) / 2.0) for low, high in ends]
    if two_parts:
        mesh = labelled(boxes[0] + boxes[2], boxes[1])
        slide = np.array([0.1, 0.0, 0.0])
    else:
        mesh, slide = labelled(sum(boxes[1:], boxes[0])), np.zeros(3)
    ends[1] += slide
    solids = [solid_part(mesh.part(k), RECIPE) for k in range(1 + two_parts)]
    own = [own_solid(solid, RECIPE) for solid in solids]
    still = np.tile(np.eye(4), (len(own), 1, 1))
    T = transform(rotation_about((0.0, 0.6, 0.8), 0.4 * turn))
    motion = np.stack([T, T @ transform(translation=slide)])[: len(own)]
    alone = fusion.PosedSolids(own, still, RECIPE.fusion)
    bare = fusion.own_ends(LabelledMesh.joined([solid.mesh for solid in solids]), alone)
    tree = fusion.posed_ends(bare, fusion.PosedSolids(own, motion, RECIPE.fusion))
    points = np.random.default_rng(0).uniform(-0.35, 0.35, (500, 3))
    found = fusion.distances(apply(T, points), tree, np.eye(4)[None], 9.0)
    np.testing.assert_allclose(found, np.abs(union_distance(points, ends)), atol=1e-6)


def exact(p, state):
    """What says which points, unit frame, the exact solids of a bundled object hold."""
    thick = p.recipe.fusion.sheet_thickness * p.unit.scale
    truth = truth_of(p.obj.category, p.obj.object_id, sheet_thickness=thick)
    placed = forward_kinematics(p.obj, p.states[state]).T_world_link
    T = {link.name: T for link, T in zip(p.obj.links, placed, strict=True)}
    return lambda points: truth.holds(points * p.unit.scale + p.unit.center, T).any(axis=1)


@pytest.mark.parametrize("name", ["drawer_0001", "drawer_0002", "oven_0000"])
def test_the_ends_of_bundled_objects_are_those_of_their_exact_solids(name):
    category, state = name.rpartition("_")[0], 2
    asking = {"extends": "category", "sampling": {"signed_distance": 0.1}}
    p = ag.Maker(ag.load("procedural", name, category=category), asking).prepared
    assert p.extras.ends is not None
    fields = pose(p, state)[1]
    tree = fusion.posed_ends(p.extras.ends, fields.material)
    solid = exact(p, state)
    rng = np.random.default_rng(0)
    corners = tree.triangles[:, 4:13].reshape(-1, 3, 3).astype(float)
    points, face = points_on_triangles(corners, 20_000, rng=rng)
    beside = 1e-5 * tree.triangles[face, :3]
    assert (solid(points - beside) & ~solid(points + beside)).mean() > 0.9999
    inside, outside = rng.uniform(-0.45, 0.45, (2, 20_000, 3))
    differ = solid(inside) & ~solid(outside)
    inside, outside = inside[differ], outside[differ]
    for _ in range(40):
        middle = (inside + outside) / 2.0
        there = solid(middle)[:, None]
        inside, outside = np.where(there, middle, inside), np.where(there, outside, middle)
    far = fusion.distances(inside, tree, np.eye(4)[None], 1.0)
    assert (far < 1e-6).mean() > 0.999


def test_the_mesh_of_an_open_drawer_is_its_material_and_nothing_is_amiss_with_it(tmp_path):
    maker = ag.Maker(ag.load("procedural", "drawer_0001"))
    made = maker.at({joint.name: joint.upper for joint in maker.joints})
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (10_000, 3))
    true = exact(made._prepared, made._index)(points)
    meshes = {of: made.mesh(128, of) for of in ("material", "visible")}
    alike = {of: iou(Soup(labelled(m)).winds_around(points), true) for of, m in meshes.items()}
    assert alike["material"] > 0.98
    assert alike["visible"] < 0.7  # the walls in mid-air
    meshes["material"].export(tmp_path / "drawer.ply")
    (model,) = ag.check(tmp_path / "drawer.ply", jobs=0).models
    assert model.findings == ()
    assert (model.parts[0].open_edges, model.parts[0].crowded_edges) == (0, 0)
