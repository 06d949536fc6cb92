"""Shapes of which all is known: tubes, sheets of no thickness, closed solids, uniform surfaces."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from articugen import fusion
from articugen.core.geometry import fibonacci_sphere, look_along, transform
from articugen.core.recipe import Recipe
from articugen.core.records import Floats, LabelledMesh
from articugen.fusion.field import FusedField
from articugen.instance import preparing, sampling
from tests.benchmarks import cases
from tests.benchmarks.cases import GENERIC, VOXEL, Model, depth_along
from tests.benchmarks.exactness import counts, off_level
from tests.shapes import Convex, labelled, sheet, spectacles, towards_cameras, two_sided

Row = dict[str, Any]
REACH = 8 * VOXEL
DIRECTIONS = 16


def tubes(recipe: Recipe, points: int) -> Row:
    """IoU of a frame of tubes of radius 0.01, `points` uniform ones and near the surface."""
    meshes = spectacles()
    soup: Any = trimesh.util.concatenate(meshes)
    rng = np.random.default_rng(0)
    near = trimesh.sample.sample_surface(soup, points, seed=1)[0]
    drawn = {
        "uniform": rng.random((points, 3)) - 0.5,
        "near": near + recipe.sampling.near_sigma * rng.normal(size=(points, 3)),
    }
    field = _alone(labelled(soup), recipe).field
    exact, towards = Convex.of(*meshes), towards_cameras(field.maps.views)
    row: Row = {}
    for kind, asked in drawn.items():
        inside = exact.inside(asked)
        rest = np.flatnonzero(~inside)
        inside[rest] = ~exact.seen_free(asked[rest], towards)
        both, either = counts(~field.is_free(asked), inside)
        row[kind] = float(both / either)
    return row


def sheets(recipe: Recipe) -> list[float]:
    """The thickness, in voxels, of a two-sided sheet without any, by its direction."""
    feet = np.random.default_rng(0).uniform(-0.35, 0.35, (400, 3)) * (1.0, 1.0, 0.0)
    bare = two_sided(sheet())
    thick = []
    for direction in [*np.eye(3), *fibonacci_sphere(DIRECTIONS - 3)]:
        R = look_along(direction, np.zeros(3))[:3, :3].T
        turned = bare.copy()
        turned.apply_transform(transform(R))
        field = _alone(labelled(turned), recipe).field
        normals = np.repeat(R[:, 2][None], len(feet), axis=0)
        held = depth_along(lambda p, f=field: ~f.is_free(p), feet @ R.T, normals, REACH)
        thick.append(float(held.mean()))
    return thick


def growth(recipe: Recipe) -> dict[str, float]:
    """How far the surfaces of closed solids are displaced outwards, in voxels, on average."""
    grown = {}
    for name, mesh in _solids().items():
        drawn = trimesh.sample.sample_surface(mesh, 4000, seed=0)
        field = _alone(labelled(mesh), recipe).field
        held = depth_along(
            lambda p, f=field: ~f.is_free(p), np.asarray(drawn[0]), mesh.face_normals[drawn[1]],
            REACH,
        )  # fmt: skip
        grown[name] = float(held.mean()) - REACH / VOXEL
    return grown


def uniformity(recipe: Recipe, drawer: Model, points: int) -> list[Row]:
    """Chi-square tests of surface points against the exactly visible surface, drawn evenly."""
    rows = []
    for name, mesh in _solids().items():
        part = preparing.solid_part(labelled(mesh), recipe)
        field = preparing.own_solid(part, recipe).field
        rows.append({"shape": name} | _uniform(part.mesh, part.seen, field, points, None))
    prepared = preparing.prepare(drawer.obj, drawer.recipe.with_options(states=8), 0)
    state = int(np.argmax([np.abs(state.q).sum() for state in prepared.states]))
    mesh, fields = preparing.pose(prepared, state)
    exact = cases.scene(drawer, prepared, state)

    def visible(at: Floats) -> NDArray[np.bool_]:
        return ~exact.unseen(at, prepared.views)

    row = _uniform(mesh, prepared.seen, fields.whole, points, visible)
    return [*rows, {"shape": f"{drawer.ref.object_id}, open"} | row]


def _uniform(
    mesh: LabelledMesh,
    seen: NDArray,
    field: FusedField | fusion.PosedSolids,
    points: int,
    visible: Any,
) -> Row:
    rng = np.random.default_rng(0)
    ours = sampling.surface_points(mesh, seen, lambda p, _: field.is_free(p), points, rng=rng)
    soup = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    drawn = trimesh.sample.sample_surface(soup, 20 * points, seed=1)
    even, normals = np.asarray(drawn[0]), soup.face_normals[drawn[1]]
    if visible is not None:
        kept = visible(even + sampling.SURFACE_OFFSET * normals)
        even, normals = even[kept], normals[kept]
    off = off_level(field, ours.points, ours.normals)
    return two_sample((ours.points, ours.normals), (even, normals)) | {
        "on level": float(np.mean(off <= 0.5)),
        "off level": float(off.max()),
    }


def two_sample(ours: Sequence[Floats], even: Sequence[Floats]) -> Row:
    """Whether two sets of (points, normals) come from one distribution.

    The chi-square test of two binned samples of unequal size (Press et al., Numerical Recipes,
    14.3); bins are cells of 1/6 of the unit cube, apart for the side that the surface looks to.
    Those that would hold less than ten of ours are put together.
    """
    from scipy.stats import chi2  # noqa: PLC0415 - optional

    keys = [_bins(*sample) for sample in (ours, even)]
    size = max(int(key.max()) for key in keys) + 1
    n, m = (np.bincount(key, minlength=size).astype(float) for key in keys)
    small = (n + m) * n.sum() / (n.sum() + m.sum()) < 10
    n = np.append(n[~small], n[small].sum())
    m = np.append(m[~small], m[small].sum())
    n, m = n[n + m > 0], m[n + m > 0]
    ratio = np.sqrt(m.sum() / n.sum())
    statistic = float(np.sum((n * ratio - m / ratio) ** 2 / (n + m)))
    freedom = len(n) - 1
    return {"chi-square": statistic, "freedom": freedom, "p": float(chi2.sf(statistic, freedom))}


def _bins(points: Floats, normals: Floats) -> NDArray[np.int64]:
    cell = np.clip(((points + 0.5) * 6).astype(np.int64), 0, 5)
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (normals[np.arange(len(axis)), axis] > 0)
    return side + 6 * (cell @ (36, 6, 1))


def _alone(mesh: LabelledMesh, recipe: Recipe) -> fusion.OwnSolid:
    return preparing.own_solid(preparing.solid_part(mesh, recipe), recipe)


def _solids() -> dict[str, trimesh.Trimesh]:
    """Closed, in line with nothing."""
    turned = transform(GENERIC)
    return {
        "box": trimesh.creation.box((0.7, 0.5, 0.3), turned),
        "sphere": trimesh.creation.icosphere(subdivisions=4, radius=0.4),
        "cylinder": trimesh.creation.cylinder(0.25, 0.5, sections=96, transform=turned),
    }
