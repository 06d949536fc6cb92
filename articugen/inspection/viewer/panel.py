"""The controls: an object, a state or a slider for each joint, and what is drawn of it.

They note what is wished for and show what they get; who does it is `session`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.inspection.report.markup import Markup
from articugen.inspection.viewer import words
from articugen.inspection.viewer.shown import Joint, Shown
from articugen.inspection.viewer.words import Scale

if TYPE_CHECKING:
    import viser

SURFACE, NORMALS, MESHES, GRID, INSIDE, OUTSIDE, PARTIAL, AXES = LAYERS = (
    "Surface points", "Normals", "Part meshes", "Occupancy grid", "Query points inside",
    "Query points outside", "Partial clouds, cameras", "Axes and pivots",
)  # fmt: skip

AT_FIRST = frozenset({MESHES, AXES})

EASY_GRID = 64  # the finest occupancy grid that is shown unless a finer one is asked for


@dataclass(frozen=True, eq=False)
class Wish:
    """Attributes:
    object_id: of whom.
    q: (J,) joint values, rad or m; None for a state a little open.
    layers: what is drawn of it.
    resolution: of the occupancy grid; 0 for whichever is easily seen.
    """

    object_id: str
    q: Floats | None = None
    layers: frozenset[str] = AT_FIRST
    resolution: int = 0


BETWEEN = "as the sliders say"

Change = Callable[[Wish], Wish]


class Panel:
    """The controls of a server."""

    def __init__(
        self,
        server: "viser.ViserServer",
        title: str,
        objects: Sequence[str],
        ask: Callable[[Change], None],
    ) -> None:
        """
        Args:
            ask: is called, on the server's event loop, with what is to become of the wish.
        """
        gui, names = server.gui, words.names_of(objects)
        self._gui, self._ask = gui, ask
        self._shown: Shown | None = None
        self._sliders: list[Any] = []
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(47, 95, 149))
        gui.set_panel_label("articugen")
        gui.main_panel.dock_right()
        gui.add_html(str(words.heading(title, len(objects))))
        chooser = gui.add_dropdown("Object", tuple(names))
        self._state: Any = gui.add_dropdown("State", (BETWEEN,))
        self._said = gui.add_html("")
        self._joints = gui.add_folder("Joints")
        with gui.add_folder("Show"):
            for name in LAYERS:
                self._box(name)
                if name == GRID:
                    self._grid: Any = gui.add_dropdown("Voxels", ("none",), visible=False)
        with gui.add_folder("Parts"):
            self._legend = gui.add_html("")
        self._on(chooser, lambda w, name: replace(w, object_id=names[name], q=None))
        self._on(self._state, self._to_state)
        self._on(self._grid, lambda w, name: replace(w, resolution=words.edge_of(name)))

    def open(self, shown: Shown | None) -> None:
        """Have sliders for an object's joints, and its states to choose from; None: have none."""
        self._shown = shown
        for slider in self._sliders:
            slider.remove()
        with self._joints:
            joints = shown.joints if shown else ()
            self._sliders = [self._slider(j, joint) for j, joint in enumerate(joints)]
        self._joints.visible = bool(self._sliders)
        count = len(shown.states) if shown else 0
        self._state.options = (*(words.state_of(k) for k in range(count)), BETWEEN)

    def stand(self, q: Floats, state: int | None) -> None:
        """Put the sliders, and the state that these values are, where they belong."""
        assert self._shown is not None
        for slider, joint, value in zip(self._sliders, self._shown.joints, q, strict=True):
            slider.value = Scale.of(joint).shown(joint, float(value))
        self._state.value = BETWEEN if state is None else words.state_of(state)

    def say(self, text: Markup) -> None:
        self._said.content = str(text)  # viser sends no subclass of str

    def name_parts(self, legend: Markup) -> None:
        self._legend.content = str(legend)

    def offer_grids(self, resolutions: Sequence[int], chosen: int, *, visible: bool) -> None:
        """Let one of these grids be chosen."""
        self._grid.options = tuple(words.grid_of(r) for r in resolutions) or ("none",)
        self._grid.value = words.grid_of(chosen) if resolutions else "none"
        self._grid.visible = visible and len(resolutions) > 1

    def _on(self, control: Any, change: Callable[[Wish, Any], Wish]) -> None:
        """Ask for what `change` makes of a new value, where it was the window that changed it."""

        @control.on_update
        async def _(event: Any) -> None:  # on the event loop, where values keep their order
            if event.client is not None:
                value = event.target.value
                self._ask(lambda wish: change(wish, value))

    def _box(self, name: str) -> None:
        def flipped(wish: Wish, shown: bool) -> Wish:
            return replace(wish, layers=wish.layers | {name} if shown else wish.layers - {name})

        self._on(self._gui.add_checkbox(name, name in AT_FIRST), flipped)

    def _to_state(self, wish: Wish, name: str) -> Wish:
        shown = self._shown  # of which `name` is a state; the wish may be for the next already
        if shown is None or shown.object_id != wish.object_id or name == BETWEEN:
            return wish
        return replace(wish, q=shown.states[self._state.options.index(name)])

    def _slider(self, j: int, joint: Joint) -> Any:
        scale = Scale.of(joint)
        slider = self._gui.add_slider(
            words.label_of(j, joint),
            min=scale.lower,
            max=scale.upper,
            step=scale.step,
            initial_value=scale.shown(joint, 0.0),
            disabled=bool(joint.follows),
            hint=f"follows {words.shortened(joint.follows)}" if joint.follows else None,
        )

        def moved(wish: Wish, value: float) -> Wish:
            if self._shown is None or self._shown.object_id != wish.object_id:
                return wish
            q = np.array(self._shown.states[self._shown.ajar] if wish.q is None else wish.q)
            if scale.shown(joint, float(q[j])) == value:
                return wish  # a window returns what it got, rounded
            q[j] = scale.meant(joint, value)
            return replace(wish, q=q)

        self._on(slider, moved)
        return slider
