"""The seam for learners: what a method has to be, so that all else here works for it.

A method is one folder beside this file, or another package: one loop trains it, one kind of run
folder keeps it, seeds race, evaluation judges it, and the commands take it by name. Nothing here
imports a method; METHODS and entry points of the group `articugen.methods` say where they are, as
`<module>:<attribute>`, and what is named there is imported when it is needed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from articugen.core.errors import InvalidRecipe
from articugen.core.plugins import Table
from articugen.core.yaml_files import find, resolved, resolved_mapping, validated
from articugen.learning.recipe import TrainRecipe

if TYPE_CHECKING:
    import torch

    from articugen.core.records import Floats
    from articugen.evaluation.reconstruction import Reconstruction
    from articugen.evaluation.results import Evaluation
    from articugen.learning.data.batch import Batch, BatchSpec
    from articugen.learning.data.split import PackedSplit

METHODS = {
    "bae": "articugen.learning.bae:METHOD",
    "bsp": "articugen.learning.bsp:METHOD",
    "npcs": "articugen.learning.npcs:METHOD",
    "nsd": "articugen.learning.nsd:METHOD",
    "opalign": "articugen.learning.opalign:METHOD",
    "one_part": "articugen.learning.one_part:METHOD",
    "ppd": "articugen.learning.ppd:METHOD",
    "ppd_depth": "articugen.learning.ppd:DEPTH_METHOD",
}
"""Ours by name; those of other packages are found by their entry points."""

DEFAULT = "ppd"

_learner_recipe = partial(find, learner=True)

_TABLE = Table(
    "articugen.methods", METHODS, ("name", "recipe", "Settings", "start"), "method", InvalidRecipe
)

Terms = dict[str, "torch.Tensor"]
"""What an iteration minimised: scalars by name, weighted."""


class Learner(Protocol):
    """Something that learns from batches. Inherit from this: what has a body need not be given."""

    settings: TrainRecipe
    """The recipe that it follows."""

    inputs: BatchSpec
    """What batches and held-out objects must hold."""

    unjudged: Sequence[str] = ()
    """Keys of `state` that `validate` does not measure: of these the best checkpoint has the
    last."""

    @property
    def parameters(self) -> int | None:
        """Number of values learned for predictions: those of `network`, if there is one."""
        network = getattr(self, "network", None)
        return network and sum(p.numel() for p in network.parameters() if p.requires_grad)

    def begin(
        self, training: PackedSplit, beside: Path, notify: Callable[[str], None] = lambda _: None
    ) -> None:
        """Prepare from all training instances, before the first iteration of every start; from
        those of a stream that are learned from now, as often as others take their place.

        Args:
            beside: a folder that several runs share, for what is worth keeping of it.
            notify: called with a sentence on what takes time.
        """

    def learn(
        self, batch: Batch, rng: torch.Generator | None, *, iteration: int
    ) -> Mapping[str, torch.Tensor]:
        """Make one step and return every term of the loss, with a graph or without.

        Args:
            rng: of the batch's device, for whatever is drawn besides.
            iteration: from 0; the recipe's schedule says the rate and the stage. At a stage's first
                iteration whatever a stage starts with is made again.

        Raises:
            TrainingDiverged: something is not finite; nothing is spoilt by it.
        """
        ...

    def check(self) -> None:
        """Raise TrainingDiverged for what was only noted so far, so as not to wait for a GPU."""

    def validate(self, held_out: PackedSplit) -> dict[str, float]:
        """Return measures of held-out objects; by the first, a loss, the best checkpoint is
        chosen."""
        ...

    def state(self) -> dict[str, Any]:
        """Tensors, numbers and texts in nested dicts: all that `load` needs to go on exactly.

        Keys, shapes and types are the same at any time, also of a learner that is new.
        """
        ...

    def load(self, state: dict[str, Any]) -> None:
        """Go on from another one's `state`; it was compared with this one's."""
        ...

    def reconstruct(self, cloud: Floats, *, resolution: int) -> Reconstruction:
        """Return the shape predicted from one cloud (n, 3) in the unit frame, on a grid of
        `resolution`^3."""
        ...


class OfThread(threading.local):
    """A copy of a learner for each thread: where one calls a model with some of its weights, no
    other may at that time."""

    def __init__(self, learner: Learner) -> None:
        self.learner = deepcopy(learner)


@dataclass(frozen=True)
class Yardstick:
    """One way to be measured, for `articugen evaluate --protocol <name>`.

    Attributes:
        resolution: of the grid, unless said otherwise.
        reconstruct: (learner, cloud, resolution), what is measured.
        evaluate: as `evaluation.evaluate.evaluate`.
        finer: of the second grid by which labels are measured, if no grid was asked for.
    """

    resolution: int
    reconstruct: Callable[[Any, Floats, int], Reconstruction]
    evaluate: Callable[..., Evaluation]
    finer: int | None = None


class Method(Protocol):
    """A way to learn. Inherit from this: what has a body need not be given."""

    name: str
    recipe: str
    """The recipe where none is named: a name under recipes/, or a path."""

    Settings: type[TrainRecipe]
    """Its recipes: a TrainRecipe with sections of its own, stages and their flags included."""

    learner: str = ""
    """The class of its learners, as `<module>:<class>`, so that torch is imported late. It takes
    (settings, seed, device), which `start` names."""

    def start(self, settings: Any, *, seed: int, device: torch.device) -> Learner:
        """Return a new learner.

        Args:
            settings: a recipe, of the kind `Settings`.
            seed: decides its weights, whatever the device; any integer below 2^63.
            device: `meta` asks for shapes alone, to compare a stored state with.
        """
        return EntryPoint("", self.learner, "").load()(settings, seed, device)

    def yardsticks(self) -> Mapping[str, Yardstick]:
        """Return the other ways it is measured, by protocol; `paper` is there for all."""
        return {}


@dataclass(frozen=True)
class PlainMethod(Method):
    """Method that adds nothing to what all have."""

    name: str
    recipe: str
    Settings: type[TrainRecipe]
    learner: str


def find_method(name: str) -> Method:
    """Return the method `name`.

    Raises:
        InvalidRecipe: there is none.
        MissingExtra: it needs a library that is not installed.
        BrokenPlugin: it is another package's and cannot be used.
    """
    return _TABLE.load(name)


def load_recipe(
    source: str | Path | Mapping[str, Any] | TrainRecipe | None = None, *, method: str | None = None
) -> TrainRecipe:
    """Return a training recipe.

    Args:
        source: a name under recipes/, a path, a mapping that may say `extends`, or one that is
            resolved already; None is what the method has for that.
        method: whose recipe it must be; None is whosever it is.

    Raises:
        InvalidRecipe: no such recipe or method, bad YAML, an unknown key, a bad value, or a recipe
            of another method.
    """
    if isinstance(source, TrainRecipe):
        recipe, where = source, source.name
    elif isinstance(source, Mapping):
        data, where = resolved_mapping(source, _learner_recipe), "the recipe"
        recipe = parse_recipe({"name": "own"} | data, where)
    else:
        path = _learner_recipe(str(source or find_method(method or DEFAULT).recipe))
        data, where = resolved(path, _learner_recipe), str(path)
        recipe = parse_recipe({"name": path.stem} | data, where)
    if method is not None and recipe.method != method:
        raise InvalidRecipe(
            f"{where}: is of method {recipe.method}, not {method}; name a recipe of that"
        )
    return recipe


def parse_recipe(data: dict[str, Any], where: str) -> TrainRecipe:
    """Return a recipe from plain data; `where` is named in errors.

    Raises:
        InvalidRecipe: an unknown key, a bad value, or no such method.
    """
    name = data.get("method", DEFAULT) if isinstance(data, dict) else DEFAULT
    return validated(find_method(str(name)).Settings, data, where)
