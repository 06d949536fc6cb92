"""How far a method's inside agrees with the truth, of which there are two, both told.

Material: the solids alone. Visible space: the solids with the space that no view sees, by the views
that the method has; for one without views, by ours.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from articugen.core.records import FREE, Floats, Views, is_material
from articugen.instance import preparing
from articugen.instance.preparing import Prepared
from tests.benchmarks import rows
from tests.benchmarks.cases import Bools, Case, Inside
from tests.benchmarks.peers import Answer
from tests.benchmarks.rows import Row
from tests.shapes import iou

TRUTHS = ("material", "visible")
Held = Mapping[str, Mapping[str, Bools]]
"""By truth and kind of points, which are inside."""


def truths(made: Case, views: Views) -> Held:
    scene = made.scene
    assert scene is not None
    return {
        "material": {kind: scene.solid(points) for kind, points in made.points.items()},
        "visible": {kind: scene.unseen(points, views) for kind, points in made.points.items()},
    }


def of_ours(made: Case, prepared: Prepared) -> Held:
    """Material by the labels of parts; with what they call enclosed, what is not visible space."""
    label: Callable[[Floats], NDArray[np.uint8]]
    label = preparing.pose(prepared, made.state)[1].labels
    labels = {kind: label(points) for kind, points in made.points.items()}
    return {
        "material": {kind: is_material(found) for kind, found in labels.items()},
        "visible": {kind: found != FREE for kind, found in labels.items()},
    }


def of_peer(made: Case, inside: Inside) -> Held:
    """One answer for both: peers tell material from enclosed space by no label."""
    got = {kind: inside(points) for kind, points in made.points.items()}
    return {"material": got, "visible": got}


def peer_truths(made: Case, answer: Answer, ours: Held) -> Held:
    """With what its own views do not see, for a peer that has views."""
    if answer.views is None or made.scene is None:
        return ours
    by_its_own = {k: made.scene.unseen(points, answer.views) for k, points in made.points.items()}
    return {"material": ours["material"], "visible": by_its_own}


def score(method: str, made: Case, got: Held, truth: Held) -> Row:
    agreement = {
        name: {kind: iou(got[name][kind], truth[name][kind]) for kind in made.points}
        for name in TRUTHS
    }
    return rows.about(method, made.model, made.state) | agreement
