"""What only some recipes ask for: distances, sharp edges, images, collisions."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import changed, edited, put
from scipy.spatial import cKDTree

import articugen as ag
from articugen import fusion
from articugen.core.errors import RejectedInstance
from articugen.core.geometry import invert_rigid, rotation_about, transform
from articugen.core.records import FREE, dequantize
from articugen.instance.sampling import SurfacePoints
from articugen.instance.sharp import sharp_edges, sharp_points
from articugen.meshes.bvh import joined_trees, tree_of
from articugen.rendering.images import images
from articugen.rendering.views import plain_pinhole_views
from articugen.verify import invariants
from tests.shapes import box, labelled, two_sided

SLIDE = """\
<robot name="slide">
  <link name="wall"><visual><geometry><box size="0.2 0.4 0.4"/></geometry></visual></link>
  <link name="bolt">
    <visual><geometry><box size="0.2 0.1 0.1"/></geometry></visual>
  </link>
  <joint name="slide" type="prismatic"><parent link="wall"/><child link="bolt"/>
    <origin xyz="0.4 0 0"/><axis xyz="-1 0 0"/>
    <limit lower="0" upper="{upper}" effort="1" velocity="1"/></joint>
</robot>
"""
"""A bolt that starts 0.2 m from a wall and is pushed towards it, or into it."""

ASKING = {
    "articulation": {"states": 8, "collision": "label"},
    "views": {"count": 20, "resolution": 64},
    "sampling": {
        "grids": [16], "surface_points": 1000, "uniform_points": 500, "near_points": 500,
        "partial_points": 64, "near_sigma": [0.005, 0.05], "signed_distance": 0.1,
        "sharp_points": 400,
    },
    "images": {"views": 2, "resolution": 64},
}  # fmt: skip


def slide(folder: Path, upper: float, **articulation) -> ag.Maker:
    path = folder / "slide.urdf"
    path.write_text(SLIDE.format(upper=upper))
    recipe = ASKING | {"articulation": ASKING["articulation"] | articulation}
    return ag.Maker(ag.load(path), recipe)


@pytest.fixture(scope="module")
def apart(tmp_path_factory):
    """The instances of a bolt that never reaches the wall, and their recipe."""
    maker = slide(tmp_path_factory.mktemp("apart"), 0.15)
    return [maker[i].instance for i in range(4)], maker.recipe


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 40))
def test_distances_are_those_to_the_nearest_triangle(seed, count):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.4, 0.4, (count, 1, 3)) + rng.normal(0, 0.05, (count, 3, 3))
    corners[: count // 8, 2] = corners[: count // 8, 1]  # some are segments
    points = rng.uniform(-0.5, 0.5, (50, 3))
    part = rng.integers(0, 2, count).astype(np.uint8)
    faces = joined_trees([tree_of(corners[part == k]) for k in (0, 1)])
    motion = np.stack([np.eye(4), transform(translation=[0.1, -0.2, 0.0])])
    posed = corners + motion[part][:, None, :3, 3]
    each = [
        trimesh.triangles.closest_point(np.repeat(triangle[None], 50, axis=0), points)
        for triangle in posed
    ]
    far = np.linalg.norm(np.array(each) - points, axis=2)
    found = fusion.distances(points, faces, motion, 0.3)
    np.testing.assert_allclose(found, np.minimum(far.min(axis=0), 0.3), atol=2e-7)
    if (part == 1).any():
        alone = fusion.distances(points, faces, motion, 9.0, part=1)
        np.testing.assert_allclose(alone, far[part == 1].min(axis=0), atol=2e-7)


def box_distance(points, low, high):
    """Of a solid box: below 0 inside."""
    beyond = np.maximum(low - points, points - high)
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def test_signed_distances_are_exact_on_closed_solids(apart):
    rows, _ = apart
    for row in rows:
        wall = np.array([[-0.1, -0.2, -0.2], [0.1, 0.2, 0.2]])
        bolt = np.array([[0.3, -0.05, -0.05], [0.5, 0.05, 0.05]])
        bolt = bolt + np.array([-row.joint_state[0] * row.scale, 0.0, 0.0])
        for stem in ("uniform", "near"):
            points = dequantize(getattr(row, f"{stem}_points"))
            ends = [(solid - row.center) / row.scale for solid in (wall, bolt)]
            true = np.min([box_distance(points, *each) for each in ends], axis=0)
            found = getattr(row, f"{stem}_distance")
            np.testing.assert_allclose(found, np.clip(true, -0.1, 0.1), atol=1e-6)
            assert ((found < 0) == (getattr(row, f"{stem}_label") != FREE)).mean() > 0.99


def test_near_points_take_turns_at_several_sigmas(apart):
    row = apart[0][0]
    off = np.abs(row.near_distance)
    assert 4.0 < off[1::2].mean() / off[::2].mean() < 12.0  # 0.05 and 0.005, cut off at 0.1


def test_a_share_of_near_points_lies_around_sharp_edges(tmp_path):
    recipe = ASKING | {"sampling": ASKING["sampling"] | {"near_sharp": 0.4, "near_sigma": 0.001}}
    path = tmp_path / "slide.urdf"
    path.write_text(SLIDE.format(upper=0.15))
    row = ag.Maker(ag.load(path), recipe)[0].instance
    edges = cKDTree(dequantize(row.sharp_points))
    far, _ = edges.query(dequantize(row.near_points))
    assert (far[300:] < 0.006).all()  # around the 200 points of edges that are stored
    assert (far[:300] > 0.02).mean() > 0.5


def test_the_edges_of_a_box_are_drawn_by_their_length():
    solid = box((0.8, 0.5, 0.3))
    soup = solid.copy()
    soup.unmerge_vertices()
    for mesh in (solid, soup):
        edges = sharp_edges(labelled(mesh), 30.0)
        assert len(edges.part) == 12
        length = np.linalg.norm(edges.ends[:, 1] - edges.ends[:, 0], axis=1)
        assert sorted(length.round(9)) == [0.3] * 4 + [0.5] * 4 + [0.8] * 4
        middle = edges.ends.mean(axis=1)
        outwards = np.sign(middle * (np.abs(middle) > 1e-9))
        np.testing.assert_allclose(edges.normals, outwards / np.sqrt(2.0), atol=1e-12)
    drawn = drawn_on(edges, 20_000)
    counts = np.bincount(drawn.face, minlength=12)
    expected = 20_000 * length / length.sum()
    assert (((counts - expected) ** 2 / expected).sum() / 11) < 2.2  # p < 0.01
    on_face = np.isclose(np.abs(drawn.points), [0.4, 0.25, 0.15], atol=1e-9)
    assert (on_face.sum(axis=1) >= 2).all()


SURFACE = SurfacePoints(
    np.full((3, 3), 0.2), np.eye(3), np.array([0, 0, 1], np.uint8), np.arange(3)
)


def drawn_on(edges, count, is_free=lambda points, _: np.ones(len(points), bool)):
    return sharp_points(edges, is_free, count, SURFACE, rng=np.random.default_rng(0))


@pytest.mark.parametrize(("sections", "bound", "sides"), [(6, 59.0, 6), (6, 61.0, 0), (4, 61.0, 4)])
def test_an_edge_is_sharp_by_the_angle_that_its_faces_turn(sections, bound, sides):
    prism = trimesh.creation.cylinder(radius=0.2, height=0.5, sections=sections)
    edges = sharp_edges(labelled(prism), bound)
    upright = np.abs(edges.ends[:, 0, 2] - edges.ends[:, 1, 2]) > 0.1
    assert upright.sum() == sides
    assert (~upright).sum() == 2 * sections  # the rims turn by 90 degrees


def test_a_ball_has_none_and_gets_points_of_its_surface():
    edges = sharp_edges(labelled(trimesh.creation.icosphere(subdivisions=3, radius=0.4)), 30.0)
    assert len(edges.part) == 0
    drawn = drawn_on(edges, 5)
    np.testing.assert_array_equal(drawn.points, np.full((5, 3), 0.2))
    assert drawn.part.tolist() == [0, 0, 1, 0, 0]


def test_edges_that_no_view_sees_are_not_drawn():
    edges = sharp_edges(labelled(box((0.5, 0.5, 0.5))), 30.0)
    drawn = drawn_on(edges, 500, lambda points, _: points[:, 2] > 0.2)
    assert (drawn.points[:, 2] > 0.19).all()
    none = drawn_on(edges, 4, lambda points, _: np.zeros(len(points), bool))
    np.testing.assert_array_equal(none.points, np.full((4, 3), 0.2))


@given(st.lists(st.integers(1, 90), min_size=4, max_size=8).filter(lambda w: len(w) % 2 == 0))
def test_of_many_faces_at_an_edge_those_count_that_the_space_lies_between(widths):
    """Wedges of any number and width around one edge, space between them: in closed form."""
    turns = np.cumsum([0, *widths]) * 2.0 * np.pi / sum(widths)
    turn = rotation_about((0.36, 0.48, 0.8), 2.0)
    corners, faces = [(0.0, 0.0, -0.2), (0.0, 0.0, 0.3)], []
    for k, angle in enumerate(turns[:-1]):
        corners.append((0.4 * np.cos(angle), 0.4 * np.sin(angle), 0.01 * k))
        faces.append((0, 1, k + 2) if k % 2 else (1, 0, k + 2))  # wedges from even to odd angles
    edges = sharp_edges(
        labelled(trimesh.Trimesh(np.array(corners) @ turn.T, faces, process=False)), 1
    )
    spaces = [(abs(np.pi - (b - a)), (a + b) / 2) for a, b in pairwise(turns)][1::2]
    widest = max(spaces)[0]
    if widest < np.radians(1.0) - 1e-6:
        assert len(edges.part) == 0
        return
    (normal,) = edges.normals @ turn
    middles = [(np.cos(m), np.sin(m), 0.0) for turned, m in spaces if turned > widest - 1e-9]
    assert min(np.abs(normal - middle).max() for middle in middles) < 1e-9


def test_where_solids_touch_no_edge_is_sharp_that_is_flush_outside():
    lower, upper = box((0.4, 0.4, 0.2)), box((0.4, 0.4, 0.3))
    upper.apply_translation((0.0, 0.0, 0.25))
    edges = sharp_edges(labelled(trimesh.util.concatenate([lower, upper])), 30.0)
    assert len(edges.part) == 2 * 12 - 2 * 4
    inside = trimesh.Trimesh([(-0.2, 0.2, 0.1), (0.2, 0.2, 0.1), (0, 0, 0)], [(0, 1, 2)])
    one = sharp_edges(labelled(trimesh.util.concatenate([lower, inside])), 30.0)
    np.testing.assert_allclose(np.abs(one.normals).sum(axis=1), np.sqrt(2.0), atol=1e-12)


def test_faces_that_are_wound_in_no_order_still_have_edges():
    assert len(sharp_edges(labelled(two_sided(box((0.5, 0.5, 0.5)))), 30.0).part) >= 12
    open_sheet = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)], process=False)
    assert len(sharp_edges(labelled(open_sheet), 30.0).part) == 0


def test_sharp_points_move_with_their_parts(apart):
    for row in apart[0]:
        wall = dequantize(row.sharp_points)[row.sharp_part == 0] * row.scale + row.center
        bolt = dequantize(row.sharp_points)[row.sharp_part == 1] * row.scale + row.center
        bolt = bolt - [0.4 - row.joint_state[0] * row.scale, 0.0, 0.0]
        for points, half in ((wall, [0.1, 0.2, 0.2]), (bolt, [0.1, 0.05, 0.05])):
            assert len(points) > 20
            assert (np.isclose(np.abs(points), half, atol=2e-5).sum(axis=1) >= 2).all()


def test_images_of_a_ball_are_those_of_a_ball():
    ball = labelled(trimesh.creation.icosphere(subdivisions=5, radius=0.3))
    views = plain_pinhole_views(
        3, 96, np.array([[-0.3] * 3, [0.3] * 3]), rng=np.random.default_rng(0)
    )
    seen = images(
        ball, views, ("depth", "part", "normal", "rgba"), closed=np.ones(len(ball.faces), bool)
    )
    for k in range(3):
        T = invert_rigid(views.T_camera_world[k])
        assert T[2, 3] > 0.0
        i, j = np.indices((96, 96)) + 0.5
        rays = np.stack([(j - views.cx[k]) / views.fx[k], (i - views.cy[k]) / views.fy[k],
                         np.ones((96, 96))], axis=-1) @ T[:3, :3].T  # fmt: skip
        a, b = (rays**2).sum(-1), rays @ T[:3, 3]
        root = b * b - a * (T[:3, 3] @ T[:3, 3] - 0.3**2)
        hit, depth = root > 0, np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0.0)
        sure = np.abs(root) > 0.01  # a polyhedron is a little smaller
        np.testing.assert_array_equal(seen["part"][k][sure], hit[sure])
        np.testing.assert_allclose(seen["depth"][k][sure], depth[sure], atol=2e-3)
        normal = (T[:3, 3] + rays * depth[..., None]) / 0.3
        off = np.abs(seen["normal"][k] / 127.0 - normal * hit[..., None])[sure]
        assert off.max() < 0.08
        np.testing.assert_array_equal(seen["rgba"][k][..., 3] == 255, seen["part"][k] == 1)
        bright = seen["rgba"][k][..., 0].astype(float)
        lit, dark = (slice(None, 48), slice(None, 48)), (slice(48, None), slice(48, None))
        assert bright[lit][hit[lit]].mean() > 1.1 * bright[dark][hit[dark]].mean()


def test_all_instances_of_an_object_share_their_cameras(apart):
    rows, recipe = apart
    for row in rows[1:]:
        np.testing.assert_array_equal(row.image_T_camera_world, rows[0].image_T_camera_world)
        np.testing.assert_array_equal(row.image_intrinsics, rows[0].image_intrinsics)
        assert (row.image_part != rows[0].image_part).any()
        assert row.image_depth.shape == (2, 64, 64)
    assert recipe.images.views == 2


def test_states_that_were_not_sampled_are_seen_by_the_same_cameras(tmp_path):
    maker = slide(tmp_path, 0.28, states=1)  # whose views need not hold the ends of the range
    for pushed in (0.0, 0.28):
        made = maker.at(slide=pushed).instance
        np.testing.assert_array_equal(
            made.image_T_camera_world, maker[0].instance.image_T_camera_world
        )


def test_how_deep_boxes_are_in_one_another(tmp_path):
    """The bolt's front is in the wall by how far it was pushed beyond 0.2 m."""
    maker = slide(tmp_path, 0.28)
    for pushed in (0.0, 0.15, 0.2, 0.22, 0.28):
        row = maker.at(slide=pushed).instance
        deep = max(0.0, pushed - 0.2) / row.scale
        assert row.collision_depth == pytest.approx(deep, abs=1e-5)


def test_states_that_collide_are_drawn_again(tmp_path):
    bound = 0.02
    usual = slide(tmp_path, 0.29)
    maker = slide(tmp_path, 0.29, collision="reject", collision_depth=bound)
    before = np.array([state.q[0] for state in usual.prepared.states])
    after = np.array([state.q[0] for state in maker.prepared.states])
    reach = 0.2 + bound * maker.prepared.unit.scale
    collided = before > reach + 0.01
    assert collided.any()
    assert not collided.all()
    assert (after <= reach + 1e-3).all()
    np.testing.assert_array_equal(after[~collided & (before < reach - 0.01)],
                                  before[~collided & (before < reach - 0.01)])  # fmt: skip
    (note,) = [note for note in maker.prepared.obj.notes if "drawn again" in note]
    assert note.startswith(f"{collided.sum()} of 9 states")
    assert all(made.instance.collision_depth < bound + 1e-3 for made in maker)


LIFT = """<robot name="lift"><link name="base">
<visual><origin xyz="0 0 0.05"/><geometry><box size="0.6 0.6 0.1"/></geometry></visual>
<visual><origin xyz="0 0 1.4"/><geometry><box size="0.55 0.4 0.2"/></geometry></visual></link>
<link name="lift"><visual><origin xyz="0.05 0 0.7"/><geometry><box size="0.3 0.3 1.0"/></geometry>
</visual></link><joint name="up" type="prismatic"><parent link="base"/><child link="lift"/>
<axis xyz="0 0 1"/><limit lower="0" upper="1.2" effort="1" velocity="1"/></joint></robot>"""


def test_states_are_apart_in_the_frame_that_is_left(tmp_path):
    """A lift that goes through the roof would make the frame larger, and depths in it smaller."""
    (tmp_path / "lift.urdf").write_text(LIFT)
    bound, more = 0.02, {"states": 30, "collision": "reject", "collision_depth": 0.02}
    maker = ag.Maker(ag.load(tmp_path / "lift.urdf"), ASKING | {"articulation": more})
    depths = [made.instance.collision_depth for made in maker]
    assert 0.5 * bound < max(depths) <= bound


def test_where_hardly_any_state_is_free_one_sentence_says_so(tmp_path):
    path = tmp_path / "stuck.urdf"
    path.write_text(SLIDE.format(upper=0.29).replace('lower="0"', 'lower="0.25"'))
    recipe = ASKING | {"articulation": {"states": 2, "collision": "reject", "canonical": "zero"}}
    with pytest.raises(RejectedInstance, match=r"100 joint states .* set articulation\.collision"):
        _ = ag.Maker(ag.load(path), recipe).prepared


def test_a_pair_that_overlaps_when_closed_counts_where_it_is_deeper():
    closed = np.array([[0.0, 0.03], [0.02, 0.0]])
    assert not fusion.too_deep(closed + 0.009, closed, 0.01)
    assert fusion.too_deep(closed + np.array([[0, 0.011], [0, 0]]), closed, 0.01)


def test_sound_instances_have_no_faults(apart):
    rows, recipe = apart
    assert list(invariants.faults(rows, recipe)) == []


FAULTS = {
    "no sharp points": ("counts", lambda r: changed(r, sharp_points=None)),
    "no image of parts": ("counts", lambda r: changed(r, image_part=None)),
    "a sharp point too few": (
        "counts",
        lambda r: changed(
            r,
            sharp_points=r.sharp_points[1:],
            sharp_normals=r.sharp_normals[1:],
            sharp_part=r.sharp_part[1:],
        ),
    ),
    "distance of the other sign": ("distances", lambda r: edited(r, "near_distance", np.negative)),
    "distance too far": ("distances", lambda r: edited(r, "uniform_distance", lambda d: 2.0 * d)),
    "distance of a larger object": (
        "distances",
        lambda r: edited(r, "near_distance", lambda d: np.clip(1.5 * d, -0.1, 0.1)),
    ),
    "long normal at an edge": (
        "normals",
        lambda r: edited(r, "sharp_normals", put(3, (127, 20, 0))),
    ),
    "edge of no part": ("labels", lambda r: edited(r, "sharp_part", put(3, 2))),
    "image of no part": ("images", lambda r: edited(r, "image_part", lambda p: 3 * (p > 0))),
    "images of other poses": ("images", lambda r: edited(r, "image_rgba", lambda i: i[::-1])),
    "images too far": ("images", lambda r: edited(r, "image_depth", lambda d: 1.5 * d)),
}


@pytest.mark.parametrize("what", FAULTS)
def test_fault_is_found(apart, what):
    rows, recipe = apart
    check, harm = FAULTS[what]
    found = list(invariants.faults([*rows[:2], harm(rows[2]), rows[3]], recipe))
    assert check in {fault.check for fault in found if fault.state_index == 2}, found
    assert {fault.state_index for fault in found} <= {2}


def test_every_check_has_a_fault():
    told = {check for check, _ in FAULTS.values()}
    assert told == {"counts", "labels", "normals", "distances", "images"}


def test_what_was_not_asked_for_is_a_fault(apart):
    rows, recipe = apart
    usual = recipe.model_copy(update={"images": type(recipe.images)()})
    found = list(invariants.faults(rows, usual))
    assert {fault.check for fault in found} == {"counts"}


def test_they_come_back_from_a_shard(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "slide.urdf").write_text(SLIDE.format(upper=0.15))
    ag.generate("bolt", tmp_path / "in" / "slide.urdf", tmp_path, ASKING, states=2, jobs=0)
    row = ag.open(tmp_path / "bolt")[1]
    assert row.uniform.distance.shape == (500,)
    assert row.near.distance.dtype == np.float32
    assert row.sharp.points.shape == row.sharp.normals.shape == (400, 3)
    assert row.sharp.part.max() == 1
    assert row.collision_depth == 0.0
    assert row.images.depth.shape == row.images.part.shape == (2, 64, 64)
    assert row.images.normal.dtype == np.float32
    there = np.where(row.images.depth > 0, 1.0, 0.0)
    np.testing.assert_allclose(np.linalg.norm(row.images.normal, axis=-1), there, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(row.sharp.normals, axis=-1), 1.0, atol=1e-6)
    assert row.images.rgba.shape == (2, 64, 64, 4)
    assert row.images.T_camera_world.shape == (2, 4, 4)
    assert row.images.intrinsics.shape == (2, 4)
    assert ag.verify(tmp_path / "bolt", jobs=1).ok
