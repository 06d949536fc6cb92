"""Every real model through every stage: its parts move, its surface is its own, it has an inside.

No truth is known of these models, so what is tested holds for any: the stored surface is the URDF's
meshes carried by the parts' motions, sheets and soups have an inside, and what cannot be read is
refused with its reason.
"""

import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from real_models import REAL_MODELS, needs_real_models
from scipy.spatial import KDTree

from articugen.core.errors import InvalidSource, NotOfCategory
from articugen.core.geometry import apply, invert_rigid
from articugen.core.recipe import Recipe, Sampling, load_recipe
from articugen.core.records import ArticulatedObject, Floats, dequantize
from articugen.core.schema import Instance
from articugen.fusion.solidify import LONGEST_MITRE
from articugen.instance import articulation
from articugen.instance.again import resolved
from articugen.instance.make import make_instance
from articugen.instance.preparing import Prepared, prepare
from articugen.sources import readers
from articugen.sources.refs import ObjectRef
from articugen.sources.source import open_source

pytestmark = needs_real_models

SAMPLES = Sampling(
    grids=(64,),
    surface_points=1500,
    uniform_points=0,
    near_points=3000,
    partial_views=1,
    partial_points=100,
    partial_resolution=64,
)
MOST_FLAT = 0.95
"""Of the surface points of a part, so many lie where no sheet bends: as near as flat ones do."""

STATES = 2
BUTTONS_ALONE = "103127"
"""A coffee machine; buttons are no part of what a category's articulation is."""

MOST_BYTES = 2**30
"""Of memory that this whole file may add to the process."""


def found() -> list[tuple[str, str, str]]:
    """(source, category, model) of every folder of the two collections."""
    return [
        (source, folder.parent.name, folder.name)
        for source in ("partnet_mobility", "partnet_mobility_more", "shape2motion")
        for folder in sorted((REAL_MODELS / source).glob("*/*"))
    ]


def recipe_for(category: str) -> Recipe:
    own = load_recipe(None, category).with_options(states=STATES)
    few = own.views.model_copy(update={"count": 50})
    return own.model_copy(update={"sampling": SAMPLES, "views": few})


def all_stages(ref: ObjectRef) -> tuple[Prepared, list[Instance]]:
    """The object's canonical instance and `STATES` random ones, as the pipeline makes them."""
    recipe = recipe_for(ref.category)
    prepared = prepare(resolved(ref, recipe), recipe, seed=0)
    return prepared, [make_instance(prepared, s) for s in range(STATES + 1)]


@pytest.fixture(scope="module", autouse=True)
def sane_memory() -> Iterator[None]:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown * 1024 < MOST_BYTES


@pytest.mark.parametrize(("source", "category", "model"), found())
def test_a_real_model_moves_and_has_an_inside(source: str, category: str, model: str) -> None:
    refs = open_source(REAL_MODELS / source).objects(category)
    mine = [ref for ref in refs if model in (ref.object_id, ref.object_id.split(".")[0])]
    assert mine
    if model == BUTTONS_ALONE:
        with pytest.raises(NotOfCategory, match="picks none of joint_0"):
            all_stages(mine[0])
        return
    for ref in mine:
        prepared, instances = all_stages(ref)
        assert_sound(prepared, instances)
        assert readers.digest(ref) == prepared.obj.sha256


def assert_sound(prepared: Prepared, instances: list[Instance]) -> None:
    assert_moves_rigidly(prepared, instances)
    assert_has_an_inside(prepared.obj, instances)


def assert_moves_rigidly(prepared: Prepared, instances: list[Instance]) -> None:
    """Points of a part, taken back by its motion, lie on the meshes of the URDF as they rest."""
    sheet = prepared.recipe.fusion.sheet_thickness / 2
    for k in range(prepared.obj.part_count):
        mesh = resting_mesh(prepared.obj, k, instances[0])
        seen = 0
        for s, instance in enumerate(instances):
            motion = instance.part_motion[k]
            own = dequantize(instance.surface_points[instance.surface_part == k])
            back = apply(invert_rigid(motion), own)
            away = distance_to(mesh, back, enough=sheet + 2e-5)
            assert (away < LONGEST_MITRE * sheet + 2e-5).all()  # where a sheet bends
            assert (away < sheet + 2e-5).sum() >= MOST_FLAT * len(away)
            farthest = np.linalg.norm(back - own, axis=1).max(initial=0.0)
            if k == 0 or s == 0:
                assert farthest < 1e-12
            else:
                assert farthest > 0.001
                seen += len(own)
        assert k == 0 or seen > 50, f"hardly anything of part {k} is seen when it has moved"


def resting_mesh(obj: ArticulatedObject, part: int, canonical: Instance) -> trimesh.Trimesh:
    """The URDF's own meshes of one part, canonical pose, unit frame."""
    posed = articulation.forward_kinematics(obj, articulation.canonical_state(obj))
    meshes = [
        trimesh.Trimesh(
            (apply(T, link.mesh.vertices) - canonical.center) / canonical.scale,
            link.mesh.faces,
            process=False,
        )
        for link, T, k in zip(obj.links, posed.T_world_link, obj.part_of_link, strict=True)
        if k == part and len(link.mesh.faces)
    ]
    whole = trimesh.util.concatenate(meshes)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def distance_to(mesh: trimesh.Trimesh, points: Floats, *, enough: float) -> Floats:
    """(n,) to the mesh; not always the least where that is below `enough` anyway.

    First to some triangles nearby, then, of points that are none of theirs, to all.
    """
    if not len(points):
        return np.zeros(0)
    rng = np.random.default_rng(0)
    area = mesh.area_faces / mesh.area
    face = np.concatenate([rng.choice(len(area), 20_000, p=area), np.arange(len(area))])
    weights = rng.dirichlet([1.0, 1.0, 1.0], len(face))
    nearby = KDTree(np.einsum("nc,nci->ni", weights, mesh.triangles[face])).query(points, k=12)[1]
    distance = pair_distances(mesh.triangles[face[nearby]], points)
    for n in np.flatnonzero(distance > enough):
        distance[n] = pair_distances(mesh.triangles[None], points[n : n + 1])[0]
    return distance


def pair_distances(triangles: Floats, points: Floats) -> Floats:
    """(n,) of each point (n, 3) to the nearest of its own triangles (n, k, 3, 3)."""
    repeated = np.repeat(points, triangles.shape[1], axis=0)
    closest = trimesh.triangles.closest_point(triangles.reshape(-1, 3, 3), repeated)
    return np.linalg.norm(closest - repeated, axis=1).reshape(len(points), -1).min(axis=1)


def assert_has_an_inside(obj: ArticulatedObject, instances: list[Instance]) -> None:
    labelled = np.zeros(obj.part_count + 1, int)
    for instance in instances:
        size = np.ptp(dequantize(instance.surface_points), axis=0) + 2 / 64
        assert 0.0005 < np.mean(instance.occupancy[64] > 0) < np.prod(size)
        assert 0.1 < np.mean(instance.near_label > 0) < 0.6
        labelled += np.bincount(instance.near_label, minlength=256)[: len(labelled)]
    assert (labelled > 10).all(), f"a part has next to no inside: {labelled}"


OTHERS = {"fridge": 3, "sektion_cabinet_model": 2}


@pytest.mark.parametrize(("folder", "models"), OTHERS.items())
def test_other_urdfs_move_too(folder: str, models: int) -> None:
    refs = open_source(REAL_MODELS / "other" / folder).objects("thing")
    assert len(refs) == models
    for ref in refs:
        assert_moves_rigidly(*all_stages(ref))


SMALL_PARTS = {"Microwave": "7265", "CoffeeMachine": "103127", "Dishwasher": "12553"}
"""Buttons and knobs of 1/30 to 1/200 of the object."""


@pytest.mark.parametrize(("category", "model"), SMALL_PARTS.items())
def test_small_moving_parts_take_no_more_memory_than_others(category: str, model: str) -> None:
    (ref,) = open_source(REAL_MODELS / "partnet_mobility_more" / category / model).objects("thing")
    recipe = recipe_for(ref.category)
    every = recipe.articulation.model_copy(update={"movable": ("*",)})
    prepared = prepare(articulation.resolve(readers.load(ref), every), recipe, seed=0)
    rng = np.random.default_rng(0)
    for own in prepared.own:
        assert own.field.thin.bits.nbytes < 5e6
        assert own.holds(rng.uniform(*own.box, (4000, 3))).any()


NOTHING_MOVES = ("multiple_visuals_collisions_in_link", "simple-primitives")
MADE = {
    "fixed_continuous_joints": 1,
    "link_skip_ghost_link_chain": 1,
    "mimic_joint": 4,
    "revolute_joints": 4,
}
"""How many joints move."""


@pytest.mark.parametrize("path", sorted((REAL_MODELS / "difficult").glob("*.urdf")), ids=str)
def test_a_difficult_model_is_made_or_refused_in_a_sentence(path: Path) -> None:
    """What the sentences say is in test_urdf.py."""
    (ref,) = open_source(path).objects("thing")
    if path.stem in MADE:
        prepared, instances = all_stages(ref)
        assert prepared.obj.part_count == MADE[path.stem] + 1
        assert_moves_rigidly(prepared, instances)
        return
    still = path.stem in NOTHING_MOVES
    with pytest.raises(NotOfCategory if still else InvalidSource) as caught:
        all_stages(ref)
    assert "\n" not in str(caught.value)
    assert ("no joint moves" if still else f"difficult/{path.name}") in str(caught.value)
