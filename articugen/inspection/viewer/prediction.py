"""What a trained run makes of an instance's surface points, to stand beside the truth."""

from pathlib import Path

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.colours import part_colours, rgb
from articugen.core.errors import InvalidSource, MissingExtra
from articugen.core.records import JointKind, dequantize
from articugen.core.schema import Instance
from articugen.inspection.viewer.layers import Drawn, Solid, axes

RESOLUTION = 64  # voxels along an edge, of its surfaces
VOTERS = 512  # triangles of a predicted part that are asked which true part lies nearest


class Predictor:
    """A trained run.

    Attributes:
        path: its folder.
        category: of what it was trained on.
        data: the folder of the data set that it was trained on.
    """

    def __init__(self, run: str) -> None:
        """
        Raises:
            InvalidCheckpoint: the run cannot be read.
            MissingExtra: torch is not there.
        """
        try:
            from articugen.learning import commands, run_folder  # noqa: PLC0415 - torch is optional
        except ModuleNotFoundError as error:
            if error.name != "torch":
                raise
            raise MissingExtra("torch", "ppd") from None
        self.path = commands.newest(run)
        point = run_folder.read_checkpoint(self.path / run_folder.LATEST)
        self._learner, self.category = point.learner(), point.category
        self.data = Path(run_folder.RunFolder(self.path).about()["data"]["folder"])

    def check(self, category: str) -> None:
        """Raise InvalidSource where the data are of another category than the run."""
        if category != self.category:
            raise InvalidSource(
                f"{self.path}: is of {self.category}, the data are of {category}; give others "
                "with --data"
            )

    def drawn(self, instance: Instance, beside: Floats) -> list[Drawn]:
        """Its parts and axes, each part in the colour of the true part that most of it lies
        nearest to, moved by `beside` (3,)."""

        points = dequantize(instance.surface_points)
        found = self._learner.reconstruct(points, resolution=RESOLUTION)
        labels = _votes(found.triangles, found.part, found.parts, points, instance.surface_part)
        sizes = np.bincount(found.part, minlength=found.parts)
        largest = [
            label if sizes[k] == max(sizes[i] for i in range(found.parts) if labels[i] == label)
            else -1
            for k, label in enumerate(labels)
        ]  # fmt: skip
        colours = [rgb(colour) for colour in part_colours(labels, largest)]
        drawn: list[Drawn] = []
        for k in range(found.parts):
            # shared corners once: without a graphics card that is drawn several times as fast
            corners = found.triangles[found.part == k].reshape(-1, 3)
            corners, used = np.unique(corners, axis=0, return_inverse=True)
            faces = used.reshape(-1, 3).astype(np.int32)
            drawn.append(Solid(corners + beside, faces, colours[k]))
        known = found.joints
        if known is not None:
            moves = (known.kind != JointKind.FIXED) & (sizes > 0)
            drawn += axes(
                known.pivot[moves] + beside,
                known.direction[moves],
                np.array(colours, np.uint8)[moves],
                known.kind[moves] == JointKind.REVOLUTE,
            )
        return drawn


def _votes(
    triangles: Floats, part: np.ndarray, parts: int, points: Floats, true_part: np.ndarray
) -> list[int]:
    """Return for each predicted part the true part nearest to most of it; -1 without a surface."""
    votes = []
    for k in range(parts):
        middle = triangles[part == k].mean(axis=1)
        if not len(middle) or not len(points):
            votes.append(-1)
            continue
        some = middle[np.linspace(0, len(middle) - 1, min(VOTERS, len(middle))).astype(int)]
        squared = (points**2).sum(1) - 2.0 * some @ points.T
        votes.append(int(np.bincount(true_part[squared.argmin(axis=1)]).argmax()))
    return votes
