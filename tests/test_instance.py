"""Whole instances of procedural objects against the exact solids that those are made of.

The truth of a point: it is inside where an exact solid holds it, or where no ray from it towards
any of the fused views gets free (`Truth.enclosed`): what nobody can see is inside in both.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import articugen as ag
from articugen.core.backends import BACKENDS, Backend
from articugen.core.geometry import (
    apply,
    bounds,
    invert_rigid,
    rotation_about,
    transform,
    voxel_centres,
)
from articugen.core.near import by_cell, nearest_within
from articugen.core.recipe import Recipe, Sampling, load_recipe
from articugen.core.records import (
    ENCLOSED,
    ArticulatedObject,
    DepthMaps,
    Floats,
    JointKind,
    LabelledMesh,
    Normalization,
    Views,
    dequantize,
    is_material,
)
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.inspection.check.faces import Soup
from articugen.instance import articulation
from articugen.instance.again import part_meshes
from articugen.instance.make import make_instance
from articugen.instance.preparing import Prepared, pose, prepare
from articugen.procedural import CATEGORIES
from articugen.procedural.kit.writer import TRUTH_NAME
from articugen.procedural.truth import Truth, read_truth
from articugen.rendering import rasterizer
from articugen.sources import readers
from articugen.sources.source import open_source
from tests.procedural_truth import heights, object_id, written
from tests.shapes import iou, labelled, towards_cameras

Bools = NDArray[np.bool_]

STATES = 2
SAMPLES = Sampling(
    grids=(16, 32),
    surface_points=4000,
    uniform_points=20_000,
    near_points=6000,
    near_sigma=0.01,
    partial_views=2,
    partial_points=500,
    partial_resolution=128,
)

BESIDE = 1e-4
"""From a surface point to what is certainly inside, and outside: ten times the rounding of the
stored points."""


def recipe_for(category: str) -> Recipe:
    """The category's own recipe, with few states and samples that suit the tests."""
    own = load_recipe(None, category).with_options(states=STATES)
    return own.model_copy(update={"sampling": SAMPLES})


@dataclass(frozen=True, eq=False)
class Made:
    """An object, its truth, and its instances: the canonical one and `STATES` random ones."""

    obj: ArticulatedObject
    truth: Truth
    prepared: Prepared
    instances: tuple[Instance, ...]

    @property
    def recipe(self) -> Recipe:
        return self.prepared.recipe

    @cached_property
    def part_of_true_link(self) -> NDArray[np.int64]:
        """(links of the truth,) their parts."""
        index = self.obj.link_index
        return np.array([self.obj.part_of_link[index[name]] for name in self.truth.links])

    def frames(self, state: int) -> dict[str, Floats]:
        """T_world_link of every link."""
        posed = articulation.forward_kinematics(self.obj, self.prepared.states[state])
        names = (link.name for link in self.obj.links)
        return dict(zip(names, posed.T_world_link, strict=True))

    @cached_property
    def rigid(self) -> Prepared:
        """The same by the rule `rigid`."""
        fusion = self.recipe.fusion.model_copy(update={"rule": "rigid"})
        return prepare(self.obj, self.recipe.model_copy(update={"fusion": fusion}), seed=0)

    def world(self, points: Floats) -> Floats:
        return points * self.instances[0].scale + self.instances[0].center

    def holds(self, state: int, points: Floats) -> Bools:
        """(n, P) whether the exact solids of each part hold each point of the unit frame."""
        by_link = self.truth.holds(self.world(points), self.frames(state))
        parts = range(self.obj.part_count)
        return np.stack([by_link[:, self.part_of_true_link == k].any(axis=1) for k in parts], 1)

    def heights(self, state: int, points: Floats) -> Floats:
        """(n, P) as `procedural_truth.heights`, unit frame."""
        over = heights(self.obj, self.truth, self.world(points), self.frames(state))
        return over / self.prepared.unit.scale

    def inside(self, state: int, points: Floats) -> Bools:
        """(n,) inside a solid, or seen by none of the views."""
        inside: Bools = np.any(self.holds(state, points), axis=1)
        rest = np.flatnonzero(~inside)
        towards = towards_cameras(self.prepared.views)
        world = self.world(points[rest])
        inside[rest] = self.truth.enclosed(world, towards, self.frames(state))
        return inside


Maker = Callable[..., Made]


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Maker:
    """Makes an object's instances, once."""
    folder = tmp_path_factory.mktemp("objects")
    kept: dict[tuple[str, int, int], Made] = {}

    def make(category: str, k: int, *, messy: int = 0) -> Made:
        key = (category, k, messy)
        if key not in kept:
            name = object_id(category, k)
            own = folder / f"messy_{messy}" / name
            raw, _ = written(category, name, own, messy=messy)
            obj = articulation.resolve(raw, recipe_for(category).articulation)
            prepared = prepare(obj, recipe_for(category), seed=0)
            instances = tuple(make_instance(prepared, s) for s in range(STATES + 1))
            thickness = prepared.recipe.fusion.sheet_thickness * prepared.unit.scale
            truth = read_truth((own / TRUTH_NAME).read_bytes(), sheet_thickness=thickness)
            kept[key] = Made(obj, truth, prepared, instances)
        return kept[key]

    return make


@dataclass(frozen=True, eq=False)
class Agreement:
    """How the labels of all query points of an object compare with the truth."""

    uniform: float
    near: float
    both: float
    parts: float


def agreement(made: Made) -> Agreement:
    """IoU of occupancy over all states, and the share of points in one part labelled as that."""
    counts = np.zeros((2, 2), int)
    right = asked = 0
    for s, instance in enumerate(made.instances):
        queries = (
            (instance.uniform_points, instance.uniform_label),
            (instance.near_points, instance.near_label),
        )
        for n, (stored, label) in enumerate(queries):
            points = dequantize(stored)
            truth = made.inside(s, points)
            counts[n] += ((label > 0) & truth).sum(), ((label > 0) | truth).sum()
            holds = made.holds(s, points)
            one = holds.sum(axis=1) == 1
            right += int((label[one] == holds[one].argmax(axis=1) + 1).sum())
            asked += int(one.sum())
    shares = counts[:, 0] / counts[:, 1]
    total = counts.sum(axis=0)
    return Agreement(*shares.tolist(), both=float(total[0] / total[1]), parts=right / asked)


@pytest.mark.parametrize("category", CATEGORIES)
def test_occupancy_and_parts_are_those_of_the_exact_solids(make: Maker, category: str) -> None:
    """One wrong point of the few inside thin eyeglasses is 0.004 of `uniform`; `make accuracy` asks
    many more."""
    clean = agreement(make(category, 2))
    messy = agreement(make(category, 2, messy=1))
    assert min(clean.uniform, messy.uniform) >= 0.998
    assert clean.near >= 0.999
    assert clean.parts >= 0.9985
    assert messy.near >= 0.997
    assert messy.parts >= 0.9965
    assert messy.both >= clean.both - 0.003


@pytest.mark.parametrize("category", open_source("procedural_rough").file.categories)
def test_labels_of_rough_soups_are_those_of_the_exact_solids(make: Maker, category: str) -> None:
    rough = agreement(make(category, 2, messy=2))
    assert rough.uniform >= 0.998
    assert rough.near >= 0.997
    assert rough.parts >= 0.9965


@pytest.mark.parametrize("category", ["drawer", "laptop"])
def test_meshes_of_parts_are_their_solids_to_the_face_where_models_are_closed(
    make: Maker, category: str
) -> None:
    """Of soups they are the field's zero level, which 64 voxels draw less well."""
    clean, messy = make(category, 2), make(category, 2, messy=1)
    points = generator(0, "meshes").uniform(-0.5, 0.5, (20_000, 3))
    for made, most in ((clean, 0.0), (messy, 0.01)):
        holds = made.holds(0, points)
        for part, mesh in enumerate(part_meshes(made.prepared, 64)):
            soup = Soup(labelled(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)))
            counted = soup.counted()
            assert (counted.is_closed, counted.crossings) == (True, 0)
            assert np.mean(soup.winds_around(points) != holds[:, part]) <= most


@pytest.mark.parametrize("category", CATEGORIES)
def test_grids_are_the_field_at_voxel_centres(make: Maker, category: str) -> None:
    made = make(category, 2)
    for s, instance in enumerate(made.instances):
        fields = pose(made.prepared, s)[1]
        for resolution, grid in instance.occupancy.items():
            expected = fields.labels(voxel_centres(resolution))
            np.testing.assert_array_equal(grid.ravel(), expected)
            assert 0.0 < np.mean(grid > 0) < 0.9


def test_the_unseen_inside_of_a_closed_oven_is_enclosed(make: Maker) -> None:
    """And is free once the door is open."""
    made = make("oven", 2)
    closed = made.instances[0]
    points = dequantize(closed.uniform_points)
    hollow = made.inside(0, points) & ~made.holds(0, points).any(axis=1)
    assert hollow.sum() > 1000
    assert np.mean(closed.uniform_label[hollow] == ENCLOSED) > 0.98  # the rest: the body's corners
    widest = int(np.argmax([abs(i.joint_state[0]) for i in made.instances]))
    opened = pose(made.prepared, widest)[1].labels(points[hollow])
    np.testing.assert_array_equal(opened > 0, made.inside(widest, points[hollow]))
    assert np.mean(opened == 0) > 0.5


@pytest.mark.parametrize("rule", ["seen", "rigid"])
@pytest.mark.parametrize("category", CATEGORIES)
def test_material_is_rigid(make: Maker, category: str, rule: str) -> None:
    """Part 0's voxels are the same in every pose but where a moving part's lie in them, and points
    that move with a part keep its label."""
    made = make(category, 2)
    prepared = made.prepared if rule == "seen" else made.rigid
    poses = [pose(prepared, s)[1] for s in range(STATES + 1)]
    centres = voxel_centres(32)
    grids = [fields.labels(centres) for fields in poses]
    fixed = [np.where(is_material(grid), grid, 0) for grid in grids]
    for one in fixed[1:]:
        assert (is_material(one) | (fixed[0] != 1)).all()
        assert (is_material(fixed[0]) | (one != 1)).all()
    rng = np.random.default_rng(0)
    for part, own in enumerate(prepared.own):
        points = rng.uniform(own.box[0], own.box[1], (3000, 3))
        held = [
            f.material.holds(part, apply(f.part_motion[part], points).astype("f4"), EVERY)
            for f in poses
        ]
        masks = np.stack([np.isin(EVERY, h) for h in held])
        assert masks[0].any()
        assert np.mean(masks != masks[0]) < 1e-3  # single precision, at the surface
        if part == 0:
            assert (masks == masks[0]).all()


EVERY = np.arange(3000)


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_rule_rigid_is_the_material_of_the_rule_seen(make: Maker, category: str) -> None:
    made = make(category, 2)
    for s, instance in enumerate(made.instances):
        other = make_instance(made.rigid, s)
        np.testing.assert_array_equal(other.uniform_points, instance.uniform_points)
        pairs = [(other.uniform_label, instance.uniform_label)]
        pairs += [(grid, instance.occupancy[r]) for r, grid in other.occupancy.items()]
        for ours, seen in pairs:
            np.testing.assert_array_equal(ours, np.where(is_material(seen), seen, 0))


@pytest.mark.parametrize("rule", ["seen", "rigid"])
@pytest.mark.parametrize("category", CATEGORIES)
def test_surface_points_lie_on_the_exact_solids(make: Maker, category: str, rule: str) -> None:
    """By `rigid` on inner faces of a shut oven, too: no other part's solid covers them."""
    made = make(category, 2)
    for s, seen in enumerate(made.instances):
        instance = make_instance(made.rigid, s) if rule == "rigid" else seen
        points, normals = dequantize(instance.surface_points), unit_normals(instance)
        inwards = made.holds(s, points - BESIDE * normals)
        outwards = made.holds(s, points + BESIDE * normals)
        part = instance.surface_part
        assert np.mean(inwards[np.arange(len(part)), part]) >= 0.999
        assert np.mean(outwards.any(axis=1)) <= 0.0005  # next to an inner edge rounding counts


@pytest.mark.parametrize("category", CATEGORIES)
def test_no_face_of_a_closed_solid_is_swollen_and_none_shows_through(make, category, tmp_path):
    """Six objects: no surface point stands over the exact solids by more than its rounding, and
    none lies in them but right at an inner edge, as far as the look from in front of it reaches."""
    for k in range(6):
        made = make(category, k) if k == 2 else with_surface_only(category, k, tmp_path)
        assert made.prepared.closed.all()
        instance = made.instances[-1]
        points = dequantize(instance.surface_points[:1500])
        s = instance.state_index
        height = made.heights(s, points)
        assert height[np.arange(len(points)), instance.surface_part[:1500]].max() <= 2e-5
        assert np.sum(height.min(axis=1) < -BESIDE) <= 1


def with_surface_only(category: str, k: int, folder: Path) -> Made:
    """One random pose, nothing but surface points."""
    nothing = dict.fromkeys(("uniform_points", "near_points", "partial_views"), 0)
    only = SAMPLES.model_copy(update={"grids": (), "surface_points": 1500, **nothing})
    recipe = recipe_for(category).with_options(states=1).model_copy(update={"sampling": only})
    raw, truth = written(category, object_id(category, k), folder / str(k))
    obj = articulation.resolve(raw, recipe.articulation)
    prepared = prepare(obj, recipe, seed=0)
    return Made(obj, truth, prepared, (make_instance(prepared, 1),))


@pytest.mark.parametrize("k", [0, 2])
def test_nothing_right_below_the_surface_of_eyeglasses_is_free(make: Maker, k: int) -> None:
    """The rims' edges, seen end-on, are narrower than a pixel: views look past them."""
    made, rng = make("eyeglasses", k), np.random.default_rng(0)
    for s, instance in enumerate(made.instances):
        surface, normals = dequantize(instance.surface_points), unit_normals(instance)
        below = np.concatenate([
            surface - rng.uniform(0.0, 0.003, (len(surface), 1)) * normals for _ in range(5)
        ])  # fmt: skip
        solid = made.heights(s, below).min(axis=1) < -1e-5
        label = pose(made.prepared, s)[1].labels(below[solid])
        assert solid.mean() > 0.9
        assert is_material(label).all()


@pytest.mark.parametrize(("category", "k"), [("laptop", 6), ("drawer", 4)])
def test_closed_solids_are_left_as_they_are(category: str, k: int, tmp_path: Path) -> None:
    """Plugs hide between pixels, so that their insides look free; a bevelled handle is thin at its
    very edge: neither is a sheet, so that no vertex moves."""
    raw, _ = written(category, object_id(category, k), tmp_path)
    obj = articulation.resolve(raw, recipe_for(category).articulation)
    prepared = prepare(obj, recipe_for(category), seed=0)
    assert len(prepared.mesh.faces) == sum(len(link.mesh.faces) for link in obj.links)
    assert prepared.closed.all()


@pytest.mark.parametrize("category", CATEGORIES)
def test_surface_points_of_messy_objects_lie_within_half_a_voxel(make, category):
    """Or a sheet's thickness, where the solid is a thin panel that is drawn without any."""
    made = make(category, 2, messy=1)
    thickness = made.recipe.fusion.sheet_thickness
    for s, instance in enumerate(made.instances):
        points, normals = dequantize(instance.surface_points), unit_normals(instance)
        part, each = instance.surface_part, np.arange(len(instance.surface_part))
        inwards = made.holds(s, points - 0.5 / 256 * normals)[each, part]
        thick = made.holds(s, points - thickness / 2 * normals)[each, part]
        assert np.mean(inwards | thick) >= 0.995
        # The gap around doors is 3 mm: less than half a voxel of what is two metres high.
        out = 0.25 / 256 if category == "refrigerator" else 0.5 / 256
        assert np.mean(made.holds(s, points + out * normals).any(axis=1)) < 0.02


@pytest.mark.parametrize("category", CATEGORIES)
def test_surface_points_go_back_to_the_canonical_surface_of_their_part(make, category):
    made = make(category, 2)
    for instance in made.instances[1:]:
        points, normals = dequantize(instance.surface_points), unit_normals(instance)
        for k, T in enumerate(invert_rigid(instance.part_motion)):
            own = instance.surface_part == k
            assert own.sum() > 50
            at, out = apply(T, points[own]), normals[own] @ T[:3, :3].T
            assert np.mean(made.holds(0, at - BESIDE * out)[:, k]) >= 0.999
            buried = made.holds(0, at + BESIDE * out)[:, k].sum()
            assert buried <= 1 + 0.0005 * own.sum()  # next to an inner edge rounding counts


@pytest.mark.parametrize("category", CATEGORIES)
def test_partial_clouds_are_what_a_camera_sees(make: Maker, category: str) -> None:
    """The way to the camera is free, the point is on its part, its pixel's centre is its place."""
    made = make(category, 2)
    for s, instance in enumerate(made.instances):
        check_partial_clouds(made, s, instance)


def test_partial_clouds_come_from_the_recipes_backend(make, monkeypatch):
    """Also of one that tells no faces: each part is then drawn alone."""
    made, asked = make("laptop", 2), []

    def render(mesh: LabelledMesh, views: Views) -> DepthMaps:
        asked.append((views.projection, views.width, len(np.unique(mesh.part_of_face))))
        return replace(rasterizer.render(mesh, views), face=None)

    monkeypatch.setitem(sys.modules, "depth_alone", SimpleNamespace(render=render))
    monkeypatch.setitem(BACKENDS, "depth_alone", Backend("depth_alone"))
    theirs = seen_otherwise(made, backend="depth_alone")
    asked.clear()
    check_partial_clouds(made, 1, make_instance(theirs, 1))
    pixels = made.recipe.sampling.partial_resolution
    assert asked.count(("pinhole", pixels, 1)) == made.obj.part_count
    assert len(asked) == made.obj.part_count + 1


def test_held_cameras_are_alike_above_the_floor_and_the_same_in_all_states(make: Maker) -> None:
    made = make("laptop", 2)
    held = {"partial_cameras": "held", "partial_views": 12}
    wanted = made.recipe.sampling.model_copy(update=held)
    recipe = made.recipe.model_copy(update={"sampling": wanted})
    prepared = prepare(made.obj, recipe, seed=0)
    instance, other = make_instance(prepared, 1), make_instance(prepared, 2)
    check_partial_clouds(made, 1, instance)
    cameras = instance.partial_T_camera_world
    np.testing.assert_array_equal(cameras, other.partial_T_camera_world)
    assert np.ptp(instance.partial_intrinsics, axis=0).max() == 0.0
    fx, fy, cx, cy = instance.partial_intrinsics[0]
    assert fx == fy
    corners = dequantize(instance.surface_points)
    eyes = np.array([invert_rigid(T)[:3, 3] for T in cameras])
    assert (eyes[:, 2] > corners[:, 2].min()).all()
    seen = np.stack([apply(T, corners) for T in cameras])
    at = seen[..., :2] / seen[..., 2:] * fx + (cx, cy)
    outside = ((at < 0) | (at > recipe.sampling.partial_resolution)).any(axis=2).mean(axis=1)
    assert 0.1 < (outside > 0).mean() < 0.9  # images cut the object, some of them
    assert outside.max() < 0.6
    measured = wanted.model_copy(update={"kinect_metres": 0.5})
    measured = recipe.model_copy(update={"sampling": measured})
    noisy = make_instance(replace(prepared, recipe=measured), 1)
    np.testing.assert_array_equal(noisy.partial_T_camera_world, cameras)
    clouds = dequantize(noisy.partial_points).reshape(-1, 3)
    assert (nearest_within(by_cell(corners), clouds, 0.05) >= 0).mean() > 0.99
    assert np.abs(noisy.partial_points.astype(int) - instance.partial_points).max() > 50


@pytest.mark.parametrize("fixed", [True, False])
def test_held_cameras_see_an_object_that_goes_far(fixed: bool, tmp_path: Path) -> None:
    """A box of 0.2 m slides by 4 m: in most states nothing is where most cameras look."""
    box = '<visual><geometry><box size="0.2 0.2 0.2"/></geometry></visual>'
    (tmp_path / "far.urdf").write_text(
        f'<robot name="far"><link name="wall">{box * fixed}</link><link name="sledge">{box}</link>'
        '<joint name="slide" type="prismatic"><parent link="wall"/><child link="sledge"/>'
        '<origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>'
        f'<limit lower="0" upper="{4 if fixed else 0.2}" effort="1" velocity="1"/></joint></robot>'
    )
    held = {"partial_cameras": "held", "partial_views": 12, "partial_resolution": 64}
    few = {"grids": [8], "surface_points": 64, "uniform_points": 64, "near_points": 64}
    recipe = {"articulation": {"states": 12}, "views": {"count": 8, "resolution": 64}}
    maker = ag.Maker(ag.load(tmp_path / "far.urdf"), recipe | {"sampling": held | few}, seed=0)
    assert all(np.ptp(maker[k].partial.points, axis=1).max() > 0.0 for k in range(13))


def check_partial_clouds(made: Made, s: int, instance: Instance) -> None:
    size = made.recipe.sampling.partial_resolution
    for c, T in enumerate(instance.partial_T_camera_world):
        points = dequantize(instance.partial_points[c])
        in_camera = apply(T, points)
        fx, fy, cx, cy = instance.partial_intrinsics[c]
        pixel = in_camera[:, :2] / in_camera[:, 2:] * (fx, fy) + (cx, cy)
        assert (in_camera[:, 2] > 0.5).all()
        assert ((pixel > 0) & (pixel < size)).all()
        assert np.abs(pixel % 1.0 - 0.5).max() < 0.01
        eye = invert_rigid(T)[:3, 3]
        away = (points - eye) / np.linalg.norm(points - eye, axis=1, keepdims=True)
        behind = made.holds(s, points + BESIDE * away)
        part = instance.partial_part[c]
        assert np.mean(behind[np.arange(len(part)), part]) >= 0.98  # silhouettes graze
        before = made.holds(s, points - 2 * BESIDE * away)  # rounding counts more where grazed
        assert np.mean(before.any(axis=1)) <= 0.02


@pytest.mark.parametrize("category", CATEGORIES)
def test_joint_fields_say_how_the_parts_move(make: Maker, category: str) -> None:
    made = make(category, 2)
    for s, instance in enumerate(made.instances):
        expected = [np.eye(4)]
        for j, axis in enumerate(instance.joint_axis):
            q, pivot = instance.joint_state[j], instance.joint_pivot[j]
            assert np.linalg.norm(axis) == pytest.approx(1.0, abs=1e-12)
            if instance.joint_kind[j] == JointKind.PRISMATIC:
                own = transform(translation=q * axis)
            else:
                own = transform(translation=pivot)
                own = own @ transform(rotation_about(axis, q)) @ invert_rigid(own)
            expected.append(own @ expected[instance.joint_parent[j]])
            low, high = instance.joint_lower[j], instance.joint_upper[j]
            assert low <= q <= high
            assert (q == 0.0) == (s == 0)
        np.testing.assert_allclose(instance.part_motion, expected, atol=1e-12)


@pytest.mark.parametrize("category", CATEGORIES)
def test_names_and_semantics_are_those_of_the_file(make: Maker, category: str) -> None:
    made = make(category, 2)
    children = {joint.name: joint.child for joint in made.obj.joints}
    links = {link.name: link for link in made.obj.links}
    for instance in made.instances:
        assert instance.joint_name is not None
        assert instance.part_name is not None
        assert instance.part_name[0] == made.obj.links[0].name
        assert instance.part_name[1:] == tuple(children[name] for name in instance.joint_name)
        assert instance.part_semantic == tuple(links[n].semantic for n in instance.part_name)
        part_of_link = made.obj.part_of_link[[made.obj.link_index[n] for n in instance.part_name]]
        assert part_of_link.tolist() == list(range(made.obj.part_count))


@pytest.mark.parametrize("category", CATEGORIES)
def test_part_motion_takes_the_canonical_meshes_to_the_posed_ones(make, category):
    made = make(category, 2)
    for s, instance in enumerate(made.instances):
        unit = Normalization(instance.center, instance.scale)
        canonical, posed = made.frames(0), made.frames(s)
        for link, part in zip(made.obj.links, made.obj.part_of_link, strict=True):
            before = unit.to_unit(apply(canonical[link.name], link.mesh.vertices))
            after = unit.to_unit(apply(posed[link.name], link.mesh.vertices))
            motion = instance.part_motion[part]
            np.testing.assert_allclose(apply(motion, before), after, atol=1e-9)
        stays = [np.allclose(motion, np.eye(4), atol=1e-12) for motion in instance.part_motion]
        assert stays == [k == 0 or s == 0 for k in range(len(stays))]


@pytest.mark.parametrize("messy", [False, True])
@pytest.mark.parametrize("category", CATEGORIES)
def test_all_poses_together_just_fill_the_unit_frame(make, category, *, messy):
    made = make(category, 2, messy=messy)
    corners = []
    for s, instance in enumerate(made.instances):
        assert instance.scale == made.instances[0].scale
        np.testing.assert_array_equal(instance.center, made.instances[0].center)
        frames = made.frames(s)
        unit = Normalization(instance.center, instance.scale)
        corners += [
            unit.to_unit(apply(frames[link.name], link.mesh.vertices)) for link in made.obj.links
        ]
        most = 0.45 + made.recipe.fusion.sheet_thickness
        assert np.abs(dequantize(instance.surface_points)).max() <= most
    box = bounds(np.concatenate(corners))
    np.testing.assert_allclose(box[0], -box[1], atol=1e-9)
    assert np.max(box[1]) == pytest.approx(0.45, abs=1e-9)


def test_an_object_that_was_never_resolved_is_refused(tmp_path: Path) -> None:
    raw, _ = written("oven", object_id("oven", 0), tmp_path)
    with pytest.raises(TypeError, match=r"oven_0000: was never resolved; call articulation"):
        prepare(raw, recipe_for("oven"), seed=0)  # pyright: ignore[reportArgumentType]


def test_the_same_instance_whatever_was_made_before(make: Maker) -> None:
    first = make("eyeglasses", 2)
    obj, recipe = first.obj, first.recipe
    again = prepare(obj, recipe, seed=0)
    for s in (2, 0, 1, 2):
        assert_same(make_instance(again, s), first.instances[s])
    other = prepare(obj, recipe, seed=1)
    instance = make_instance(other, 1)
    for name in ("joint_state", "surface_points", "uniform_points", "partial_T_camera_world"):
        assert not np.array_equal(instance.arrays()[name], first.instances[1].arrays()[name])


def test_more_states_leave_the_random_states_as_they_are(make: Maker) -> None:
    """The frame may grow with the poses, what is drawn does not change."""
    first = make("oven", 2)
    more = prepare(first.obj, first.recipe.with_options(states=STATES + 3), seed=0)
    for s, state in enumerate(first.prepared.states):
        np.testing.assert_array_equal(more.states[s].q, state.q)
        points = make_instance(more, s).uniform_points
        np.testing.assert_array_equal(points, first.instances[s].uniform_points)


def assert_same(a: Instance, b: Instance) -> None:
    for name, value in a.arrays().items():
        if isinstance(value, np.ndarray):
            assert value.tobytes() == b.arrays()[name].tobytes(), name
        else:
            assert value == b.arrays()[name], name


@pytest.mark.parametrize("category", ["laptop", "oven"])
def test_embree_gives_the_same_labels(make: Maker, category: str) -> None:
    pytest.importorskip("open3d", reason="it cannot be loaded here", exc_type=ImportError)
    made = make(category, 2)
    ours = seen_otherwise(made, count=30)
    theirs = seen_otherwise(made, count=30, backend="embree")
    for s in range(STATES + 1):
        points, _ = some_queries(made, s)
        label = pose(ours, s)[1].labels(points)
        assert np.mean(pose(theirs, s)[1].labels(points) == label) >= 0.999


@pytest.mark.parametrize("category", ["laptop", "drawer"])
def test_pinhole_views_see_the_same_object(make: Maker, category: str) -> None:
    """Inside is what no camera sees; of what both kinds of views leave free, ours are the proof."""
    ours = make(category, 2)
    theirs = seen_otherwise(ours, projection="pinhole")
    eyes = ours.world(invert_rigid(theirs.views.T_camera_world)[:, :3, 3])
    all_found, all_inside = [], []
    for s in range(STATES + 1):
        points, label = some_queries(ours, s)
        found: Bools = np.not_equal(pose(theirs, s)[1].labels(points), 0)
        inside: Bools = np.any(ours.holds(s, points), axis=1)
        world, frames = ours.world(points), ours.frames(s)
        for n in np.flatnonzero(~inside & (found | (label > 0))):
            inside[n] = ours.truth.enclosed(world[n : n + 1], eyes - world[n], frames)[0]
        all_found.append(found)
        all_inside.append(inside)
    assert iou(np.concatenate(all_found), np.concatenate(all_inside)) >= 0.99


def seen_otherwise(made: Made, **views: object) -> Prepared:
    changed = {"views": made.recipe.views.model_copy(update=views)}
    return prepare(made.obj, made.recipe.model_copy(update=changed), seed=0)


def some_queries(made: Made, s: int) -> tuple[Floats, NDArray[np.uint8]]:
    """(points, labels): a tenth of the uniform ones, two fifths of those near the surface."""
    i, n = made.instances[s], 2000
    points = np.concatenate([i.uniform_points[:n], i.near_points[: 2 * n]])
    return dequantize(points), np.concatenate([i.uniform_label[:n], i.near_label[: 2 * n]])


def unit_normals(instance: Instance) -> Floats:
    normals = instance.surface_normals / 127.0
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.abs(lengths - 1.0).max() < 0.007  # rounding to 1/127
    return normals / lengths


@pytest.mark.parametrize("rule", ["seen", "rigid"])
def test_coverage_is_the_share_of_the_exact_solids(make: Maker, rule: str) -> None:
    """Of every grid, whether it divides the finest or not; without it all else stays as it is."""
    made = make("eyeglasses", 2)
    sampling = SAMPLES.model_copy(update={"grids": (8, 12, 32), "coverage": True})
    fusion = made.recipe.fusion.model_copy(update={"rule": rule})
    recipe = made.recipe.model_copy(update={"sampling": sampling, "fusion": fusion})
    instance = make_instance(prepare(made.obj, recipe, seed=0), 1)
    truth = made.inside if rule == "seen" else lambda s, x: made.holds(s, x).any(axis=1)
    jitter = np.random.default_rng(0).uniform(-0.5, 0.5, (96**3, 3)) / 96  # or thin parts alias
    dense = truth(1, voxel_centres(96) + jitter).reshape((96,) * 3)
    for r, share in instance.coverage.items():
        k = 96 // r
        exact = dense.reshape(r, k, r, k, r, k).mean(axis=(1, 3, 5))
        assert share.sum() / 255 / r**3 == pytest.approx(dense.mean(), rel=0.15)
        most = 0.03 if r < 32 else 0.15  # which has 2^3 samples a cell, and 3^3 for the truth
        assert np.mean(np.abs(share / 255 - exact)[exact > 0]) < most
    assert sorted(instance.coverage) == [8, 12, 32]
    assert (instance.occupancy[8] > 0).sum() < 0.2 * (instance.coverage[8] > 0).sum()
    if rule == "seen":
        np.testing.assert_array_equal(instance.near_label, made.instances[1].near_label)


def test_an_instance_may_hold_no_samples_at_all() -> None:
    nothing = dict.fromkeys(
        ("surface_points", "uniform_points", "near_points", "partial_views", "partial_points"), 0
    )
    recipe = Recipe.model_validate(
        {
            "name": "nothing",
            "articulation": {"states": 1},
            "views": {"count": 20, "resolution": 64},
            "sampling": {"grids": [], **nothing},
        }
    )
    ref = open_source("procedural").objects("oven", objects=2)[0]
    obj = articulation.resolve(readers.load(ref), recipe.articulation)
    made = make_instance(prepare(obj, recipe, seed=0), 1)
    assert not made.occupancy
    assert made.surface_points.shape == (0, 3)
    assert made.partial_points.shape == (0, 0, 3)
