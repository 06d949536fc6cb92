"""What only some recipes ask for: distances, images; right to their last digits."""

from collections.abc import Callable, Iterator

import numpy as np

from articugen.core.near import by_cell, nearest_within
from articugen.core.recipe import Recipe
from articugen.core.records import Views, dequantize, is_material
from articugen.core.schema import Instance
from articugen.verify.bounds import TOLERANCES

_LOOKED_AT, _SPECKS = 500, 0.004
"""Query points whose distance is compared with that to each surface point, and the share of them
that may be farther: of soups, views err in specks of the surface. Of 240 sound clouds of messy,
rough and varied objects none has more than 0.0004, most and real ones 0."""


def distances(row: Instance, recipe: Recipe) -> Iterator[str]:
    """They have the sign of their labels, and no surface point is nearer than they say."""
    surface = dequantize(row.surface_points)
    for stem in ("uniform", "near"):
        far, label = getattr(row, f"{stem}_distance"), getattr(row, f"{stem}_label")
        if far is None:
            continue
        if ((far < 0.0) & ~is_material(label) | (far > 0.0) & is_material(label)).any():
            yield f"{stem}_distance has another sign than the labels say"
        if np.abs(far).max(initial=0.0) > recipe.sampling.signed_distance * (1.0 + 1e-6):
            yield f"{stem}_distance goes beyond the recipe's signed_distance"
        step = max(1, len(far) // _LOOKED_AT)
        points = dequantize(getattr(row, f"{stem}_points")[::step])
        nearest = nearest_within(by_cell(surface), points, recipe.sampling.signed_distance)
        there = np.flatnonzero(nearest >= 0)
        reach = np.linalg.norm(surface[nearest[there]] - points[there], axis=1)
        beyond = TOLERANCES["distance"].exceeded_by(np.abs(far[::step][there]) - reach)
        if beyond.sum() > _SPECKS * len(points):
            yield f"{stem}_distance is greater than that to a surface point"


def images(row: Instance, recipe: Recipe) -> Iterator[str]:
    """They show the same silhouette, of parts that are there, inside the box that holds all."""
    shown = {}
    if row.image_depth is not None:
        shown["depth"] = row.image_depth != 0.0
    if row.image_part is not None:
        shown["part"] = row.image_part != 0
        if row.image_part.max(initial=0) > len(row.part_motion):
            yield f"image_part has part {row.image_part.max() - 1} of {len(row.part_motion)} parts"
    if row.image_normal is not None:
        shown["normal"] = row.image_normal.any(axis=3)
    if row.image_rgba is not None:
        shown["rgba"] = row.image_rgba[..., 3] != 0
    for name, silhouette in list(shown.items())[1:]:
        first = next(iter(shown))
        if not np.array_equal(silhouette, shown[first]):
            yield f"image_{name} and image_{first} show something at different pixels"
    if row.image_depth is None:
        return
    assert row.image_intrinsics is not None
    assert row.image_T_camera_world is not None
    sizes = row.image_depth.shape[2:0:-1]
    cameras = Views("pinhole", row.image_T_camera_world, *row.image_intrinsics.T, *sizes)
    half = 0.5 * (1.0 - recipe.padding) + recipe.fusion.sheet_thickness
    for view, depth in enumerate(row.image_depth):
        i, j = np.nonzero(depth)
        beyond = np.abs(cameras.points(view, i, j, depth[i, j].astype(np.float64))) - half
        if TOLERANCES["image"].exceeded_by(beyond).any():
            yield f"image_depth of camera {view} shows points outside of the object's box"


CHECKS: dict[str, Callable[[Instance, Recipe], Iterator[str]]] = {
    "distances": distances,
    "images": images,
}
