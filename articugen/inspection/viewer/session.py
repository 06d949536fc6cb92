"""One worker that does what is wished for: opens objects, makes instances, has them drawn.

It always does the newest wish, so that a slider that is dragged waits for nothing that it has left
behind.
"""

import threading
import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import ArticugenError
from articugen.core.geometry import box_corners
from articugen.core.schema import Instance
from articugen.inspection.report.markup import Markup, join
from articugen.inspection.viewer import layers, panel, words
from articugen.inspection.viewer.layers import Drawn
from articugen.inspection.viewer.panel import Change, Panel, Wish
from articugen.inspection.viewer.shown import Seen, Shown
from articugen.inspection.viewer.sources import Source
from articugen.inspection.viewer.stage import Stage
from articugen.pictures.contact_sheet import evenly
from articugen.pictures.portrait import best_azimuth, swept

if TYPE_CHECKING:
    import viser

LOOKED_AT = 5  # states of the first object that decide from where one looks


class Session:
    """State of a server and of what it shows.

    Attributes:
        wish: what was asked for last.
        seen: what is shown now; None where nothing can be.
        fault: the sentence that says why it cannot be as it is wished for, or "".
    """

    def __init__(self, server: "viser.ViserServer", source: Source) -> None:
        self._source, self._stage = source, Stage(server)
        self._panel = Panel(server, source.title, source.objects, self.ask)
        self.seen: Seen | None = None
        self.fault = ""
        self._shown: Shown | None = None
        self._q: Floats | None = None
        self._drawn: dict[str, tuple[object, ...]] = {}
        self.wish = Wish(source.objects[0])
        self._done: Wish | None = None
        self._changed, self._ended = threading.Condition(), False
        self._worker = threading.Thread(target=self._work, name="articugen view", daemon=True)
        self._worker.start()

    def ask(self, change: Change) -> None:
        """Wish for something else than now."""
        with self._changed:
            self.wish = change(self.wish)
            self._changed.notify_all()

    def wait(self, seconds: float | None) -> bool:
        """Until all that was wished for is there; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self._done is self.wish, seconds)

    def end(self) -> None:
        """Let the worker finish what it does, and do nothing more."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._worker.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self.wish is not self._done)
                wish = self.wish
                if self._ended:
                    return
            self.fault = ""
            try:
                self._do(wish)
            except ArticugenError as error:
                self.fault = str(error)
            except Exception as error:  # the window stays, and says it; where it was goes to stderr
                traceback.print_exc()
                self.fault = f"internal error, please report it: {type(error).__name__}: {error}"
            if self.fault:
                self._panel.say(words.warning(self.fault))
            with self._changed:
                self._done = wish
                self._changed.notify_all()

    def _do(self, wish: Wish) -> None:
        opened = self._shown is None or self._shown.object_id != wish.object_id
        shown = self._open(wish.object_id) if opened else self._shown
        assert shown is not None
        text = self._look(shown, wish)
        self._draw(shown, wish)
        if opened and shown.maker is not None:
            self._panel.say(join(text, words.busy("getting ready for the sliders …")))
            _ = shown.maker.prepared
        self._panel.say(text)

    def _open(self, object_id: str) -> Shown:
        self._shown, self.seen = None, None
        for layer in list(self._drawn):
            self._clear(layer)
        self._panel.open(None)
        self._panel.say(words.busy(f"opening {words.shortened(object_id)} …"))
        self._shown = self._source.shown(object_id)
        self._panel.open(self._shown)
        return self._shown

    def _look(self, shown: Shown, wish: Wish) -> Markup:
        """Have `seen` what is wished for; what is to be said of it."""
        if self.seen is None or wish.q is not self._q:
            self._panel.say(words.busy("fusing …"))
            began = time.perf_counter()
            self.seen = shown.at_state(shown.ajar) if wish.q is None else shown.at(wish.q)
            self._said = words.said_of(shown, self.seen, time.perf_counter() - began)
            self._q = wish.q
            q = self.seen.q if self.seen.asked or wish.q is None else wish.q
            self._panel.stand(q, self.seen.state if self.seen.asked else None)
            self._panel.name_parts(words.legend(self.seen.instance))
        return self._said

    def _draw(self, shown: Shown, wish: Wish) -> None:
        """Bring every layer to what is seen now; what shows it already stays."""
        assert self.seen is not None
        instance = self.seen.instance
        if not self._stage.framed:
            some = evenly(range(len(shown.states)), LOOKED_AT)
            instances = [shown.at_state(state).instance for state in some]
            points, azimuth = swept(instances[0]), 0.0
            if len(points):
                azimuth = best_azimuth(instances)
            else:
                points = box_corners(np.array([[-0.5] * 3, [0.5] * 3]))
            self._stage.frame(azimuth, points)
        grids = sorted(instance.occupancy)
        edge = wish.resolution
        if edge not in grids:
            edge = max((r for r in grids if r <= panel.EASY_GRID), default=min(grids, default=0))
        self._panel.offer_grids(grids, edge, visible=panel.GRID in wish.layers)
        for layer in set(self._drawn) - wish.layers:
            self._clear(layer)
        for layer in panel.LAYERS:
            now = (self.seen, edge) if layer == panel.GRID else (self.seen,)
            if layer in wish.layers and self._drawn.get(layer) != now:
                self._stage.draw(layer, self._layer(layer, shown, instance, edge))
                self._drawn[layer] = now

    def _layer(self, layer: str, shown: Shown, instance: Instance, edge: int) -> list[Drawn]:
        if layer == panel.GRID:
            return layers.voxels(instance, edge) if edge else []
        if layer == panel.PARTIAL:
            return layers.partial(instance, shown.image_size)
        if layer == panel.MESHES:
            if not shown.part_meshes:  # a shard may hold no grid
                return layers.surface(instance)
            return layers.meshes(shown.part_meshes, instance.part_motion)
        return _OF_INSTANCE[layer](instance)

    def _clear(self, layer: str) -> None:
        self._stage.draw(layer, [])
        del self._drawn[layer]


_OF_INSTANCE: dict[str, Callable[[Instance], list[Drawn]]] = {
    panel.SURFACE: layers.surface,
    panel.NORMALS: layers.normals,
    panel.INSIDE: partial(layers.queries, inside=True),
    panel.OUTSIDE: partial(layers.queries, inside=False),
    panel.AXES: layers.joints,
}
