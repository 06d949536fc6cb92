"""What a model for depth input makes of a recorded sequence: numbers and a picture."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from articugen.core.colours import colour_of
from articugen.core.errors import InvalidCheckpoint
from articugen.core.files import make_folder, write_atomically
from articugen.core.seeding import generator
from articugen.evaluation.figures import Names, solid_of
from articugen.evaluation.reconstruction import Reconstruction, labelled_points
from articugen.evaluation.recorded import read_recording
from articugen.evaluation.recorded.frames import Posed, into_unit_frame, measured
from articugen.learning.commands import FolderLike, newest
from articugen.learning.run_folder import LATEST, read_checkpoint
from articugen.pictures.layout import Row, save, sheet
from articugen.pictures.portrait import solid_portrait, tile_camera
from articugen.pictures.shading import Picture

_AZIMUTH = np.radians(215.0)  # from the user's side, to the left
_POINTS, _SHOWN = 1024, 4096  # as many as a data set's partial clouds have; as are drawn


def watch(
    run: FolderLike, folder: FolderLike, *, images: int = 8, out: FolderLike = "recorded",
    resolution: int = 64,
) -> dict[str, float]:  # fmt: skip
    """Reconstruct a laptop from the depth images of a recorded sequence, and measure the outcome.

    Args:
        run: of `train-depth`, or a folder of such runs, whose newest is meant.
        folder: of a sequence, as `read_recording` takes it.
        images: how many of the sequence, evenly from the first to the last.
        out: the folder for `figure.png` (above what the camera sees by true parts, below what is
            reconstructed of it) and `numbers.json`.
        resolution: of the meshes' grid.

    Returns:
        The numbers: those of `measured`, and `images`, how many there were.

    Raises:
        InvalidCheckpoint: the run cannot be read, or did not learn from depth, or not of laptops.
        InvalidSource: the sequence cannot be read, or shows too little.
    """
    path = newest(run)
    point = read_checkpoint(path / LATEST)
    learner = point.learner()
    if not learner.inputs.partial or point.category != "laptop":
        raise InvalidCheckpoint(
            f"{path}: recordings show laptops to a depth camera, and this run did not learn from "
            "such; make one with: make depth CATEGORY=laptop"
        )
    posed = into_unit_frame(read_recording(Path(folder), images))
    rng = generator(0, "recorded")
    clouds = [np.resize(rng.permutation(p.points), (_POINTS, 3)) for p in posed]
    shapes = [learner.reconstruct(cloud, resolution=resolution) for cloud in clouds]
    labels, dominant, numbers = measured(posed, shapes)
    numbers = {"images": len(posed), **numbers}
    make_folder(Path(out))
    plain = {k: None if np.isnan(x) else x for k, x in numbers.items()}  # JSON has none
    write_atomically(Path(out) / "numbers.json", (json.dumps(plain, indent=1) + "\n").encode())
    names = Names(labels.tolist(), dominant.tolist())
    save(_drawn(posed, shapes, names), Path(out) / "figure.png")
    return numbers


def _drawn(posed: Sequence[Posed], results: Sequence[Reconstruction], whose: Names) -> Picture:
    """Draw a column for each image, the object as it stands in the unit frame."""
    camera = tile_camera(np.concatenate([p.points for p in posed]), _AZIMUTH)
    floor = min(float(p.points[:, 2].min()) for p in posed)
    some = [slice(None, None, -(-len(p.points) // _SHOWN)) for p in posed]
    clouds = [labelled_points(p.points[k], p.part[k], 2) for p, k in zip(posed, some, strict=True)]
    captions = [[(f"{np.degrees(p.state):.0f}°", colour_of(1))] for p in posed]
    rows = []
    for title, shapes, names in (
        ("what the camera sees, by true part", clouds, Names([0, 1], [0, 1])),
        ("reconstruction", results, whose),
    ):
        pictures = [solid_portrait(solid_of(shape, names), camera, floor) for shape in shapes]
        rows.append(Row(title, pictures, captions))
    return sheet(rows)
