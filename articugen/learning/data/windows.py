"""New objects without end in place of a stored set: a window of them after the other.

Which objects a window holds, and for which iterations, no clock decides: a run that was stopped
goes on with the same batches. The stream's first objects are held out for ever.
"""

import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from articugen.core.processes import in_order, report
from articugen.learning.data.split import PackedSplit, packed
from articugen.learning.method import Learner
from articugen.learning.recipe import TrainRecipe
from articugen.store.shards import Shard

OBJECTS = 24
"""In a window."""

PASSES = 8
"""How often, about, each instance is learned from while its window is there."""


@runtime_checkable
class Endless(Protocol):
    """A stream of objects, as `ag.stream` makes it; its text names all that decides it."""

    @property
    def category(self) -> str: ...

    @property
    def each(self) -> int:
        """Instances of an object."""
        ...

    def for_training(self) -> "Endless":
        """Return the same of objects alone that no test set has."""
        ...

    def objects(self, numbers: Iterable[int]) -> Sequence[Shard]:
        """Return some of its objects; what cannot be made is left out."""
        ...


@dataclass(frozen=True)
class Windows:
    """Instances of a stream as they are learned from.

    Attributes:
        start: makes a learner to prepare windows for; of its weights only the shapes count.
        resolutions: of the grids that batches and validation read.
        beside: as `Learner.begin` takes it.
        size: objects in a window.
    """

    stream: Endless
    recipe: TrainRecipe
    start: Callable[[], Learner]
    resolutions: frozenset[int]
    beside: Path
    size: int

    @property
    def stay(self) -> int:
        """Iterations for which a window is there."""
        return max(PASSES * self.size * self.stream.each // self.recipe.schedule.batch, 1)

    def held_out(self) -> PackedSplit:
        """Return the objects that no window holds; where there are none, no instances."""
        count = self.recipe.data.validation_objects
        some = self._packed(range(count or 1))
        return some if count else some.of([])

    def since(self, iteration: int, notify: Callable[[str], None]) -> Iterator[PackedSplit]:
        """Yield the window of an iteration and those that follow. While one is there, another
        process makes the next, and prepares it."""
        last = max(self.recipe.schedule.iterations - 1, iteration)
        numbers = range(iteration // self.stay, last // self.stay + 1)
        yield from map(pickle.loads, in_order(self._window, numbers, workers=2, on_report=notify))

    def _window(self, number: int) -> bytes:
        """Return a window as bytes: a pipe would have tensors share memory with this process."""
        first = self.recipe.data.validation_objects + number * self.size
        window = self._packed(range(first, first + self.size))
        self.start().begin(window, self.beside, report)
        return pickle.dumps(window)

    def _packed(self, numbers: Iterable[int]) -> PackedSplit:
        shards = [lambda shard=shard: shard for shard in self.stream.objects(numbers)]
        return packed(shards, self.start().inputs, self.resolutions, str(self.stream))
