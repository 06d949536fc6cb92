"""The figures of an evaluation, as PNG: shapes, interpolations, part fields, curves, joints."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from articugen.inspection.layout import save
from articugen.inspection.portrait import COLOURS, best_azimuth
from articugen.inspection.shading import Picture
from articugen.learning.evaluation.evaluate import objects_of
from articugen.learning.evaluation.figures import plots
from articugen.learning.evaluation.figures.shapes import (
    Names,
    between,
    by_opening,
    evenly,
    interpolations,
    reconstructions,
)
from articugen.learning.evaluation.surfaces import Floats
from articugen.learning.ppd.learner import PPDLearner
from articugen.learning.ppd.reconstruct import (
    REVOLUTE,
    Reconstruction,
    logits_at,
    reconstruction_of,
)
from articugen.records import Instance, dequantize

OBJECTS = 3
INSTANCES = 16
"""Of each object so many are read, from its canonical pose to its widest."""

SLICE = 256
"""Pixels along a slice of the fields."""

NEAR = 0.01
"""Surface points so near a slice are drawn in it."""


def draw_figures(
    folder: Path,
    metrics: Sequence[dict[str, Any]],
    data: Path,
    learner: PPDLearner,
    result: dict[str, Any],
    *,
    resolution: int,
) -> Iterator[Path]:
    """Draw every figure into `folder` and yield its path when it is there.

    Args:
        metrics: the training curves.
        data: the data set whose test objects are drawn.
        result: what `evaluate` has returned for this learner.
        resolution: of the meshes' grid.

    Raises:
        ArticugenError: a file cannot be written.
    """
    names = Names(result["labels"], result["dominant"])
    objects = [
        evenly(by_opening(instances), INSTANCES) for instances in objects_of(data, "test", None)
    ]
    path = folder / "curves.png"
    plots.curves(metrics, path)
    yield path
    path = folder / "joints.png"
    plots.joints(result, COLOURS, path)
    yield path
    path = folder / "fields.png"
    _fields(path, learner, _half_open(objects[0]), names)
    yield path
    path = folder / "reconstructions.png"

    def see(instance: Instance) -> Reconstruction:
        return learner.reconstruct(dequantize(instance.surface_points), resolution=resolution)

    some = evenly(objects, OBJECTS)
    azimuth = best_azimuth([instances[-1] for instances in some])
    save(reconstructions(some, see, names, azimuth), path)
    yield path
    path = folder / "interpolations.png"
    save(_interpolations(learner, objects, names, azimuth, resolution), path)
    yield path


def _half_open(instances: Sequence[Instance]) -> Instance:
    return instances[len(instances) // 2]


def _cloud(learner: PPDLearner, instance: Instance) -> Floats:
    return dequantize(instance.surface_points[: learner.points])


def _interpolations(
    learner: PPDLearner,
    objects: Sequence[Sequence[Instance]],
    names: Names,
    azimuth: float,
    resolution: int,
) -> Picture:
    """Between the two objects whose shape codes differ most; from closed to wide open."""
    model, residual = learner.model, learner.residual_direction
    clouds = [_cloud(learner, _half_open(instances)) for instances in objects]
    codes = torch.cat([learner.predict(cloud).shape.detail.flatten(1) for cloud in clouds])
    one, other = divmod(int(torch.cdist(codes, codes).argmax()), len(codes))
    first = objects[one]
    opening = (_cloud(learner, first[0]), _cloud(learner, first[-1]))
    shapes, states = (
        [reconstruction_of(model, prediction, resolution) for prediction in row]
        for row in between(model, (clouds[one], clouds[other]), opening, residual)
    )
    return interpolations(shapes, states, names, first[0], azimuth)


def _fields(path: Path, learner: PPDLearner, instance: Instance, names: Names) -> None:
    """A slice through all part fields, across the first joint's axis or along its slide."""
    normal, offset = cutting_plane(instance)
    across = [axis for axis in range(3) if axis != normal]
    at = (np.arange(SLICE) + 0.5) / SLICE - 0.5
    points = np.full((SLICE, SLICE, 3), offset)
    points[..., across[0]], points[..., across[1]] = np.meshgrid(at, at, indexing="ij")
    predicted = learner.predict(_cloud(learner, instance))
    logits = logits_at(learner.model, predicted, torch.from_numpy(points.reshape(-1, 3)))
    fields = 1.0 / (1.0 + np.exp(-np.clip(logits, -50.0, 50.0)))
    surface = dequantize(instance.surface_points)
    near = np.abs(surface[:, normal] - offset) < NEAR
    settings = learner.settings.model
    revolute, prismatic = len(settings.revolute), len(settings.prismatic)
    kinds = ["fixed"] + ["revolute"] * revolute + ["prismatic"] * prismatic
    plots.slices(
        fields.reshape(-1, SLICE, SLICE),
        names.colours,
        [f"part {i}, {kind}" for i, kind in enumerate(kinds)],
        (surface[near][:, across], instance.surface_part[near].astype(np.int64), COLOURS),
        ("xyz"[across[0]], "xyz"[across[1]]),
        path,
    )


def cutting_plane(instance: Instance) -> tuple[int, float]:
    """(k, c): the plane where coordinate k is c, on which the first joint's motion shows.

    Across a revolute axis, upright along a slide; through the middle of the parts that move.
    """
    if not len(instance.joint_kind):
        return 1, 0.0
    steepest = int(np.abs(instance.joint_axis[0]).argmax())
    sideways = 1 if steepest == 0 else 0
    normal = steepest if instance.joint_kind[0] == REVOLUTE else sideways
    moving = dequantize(instance.surface_points)[instance.surface_part > 0, normal]
    return normal, float(np.median(moving)) if len(moving) else 0.0
