"""The viewer's page in a real browser: what is asked for with its controls is what is seen.

One server and one window serve most tests, as each has the window start from what it shows at
first; the others come before it, as it draws all the time. Nothing waits for a number of seconds,
but for what must come to be seen.
"""

import io
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from browser import PHONE, faults_of
from instances import SMALL, hinged_box
from PIL import Image
from ppd_data import shard
from test_html_report import HOSTILE, STATES, named
from test_maker import CABINET, TINY

import articugen as ag
from articugen.core.geometry import rotation_about
from articugen.inspection.viewer import layers
from articugen.inspection.viewer.panel import AT_FIRST, LAYERS
from articugen.inspection.viewer.serve import Served, served
from articugen.inspection.viewer.sources import source_of

WINDOW = {"width": 900, "height": 450}

PATIENCE = 180_000
"""Milliseconds that a busy machine is given for anything."""

STILL = """
*, ::before, ::after {
    animation: none !important; box-shadow: none !important; transition: none !important;
}
.mantine-Notifications-root, .mantine-Slider-label { display: none !important; }
"""
"""Shadows of controls fall on the picture, and what viser says of slow machines lies on it."""


SHARP = "fixedDpr=1"
"""viser draws fewer pixels while a machine is slow; the same must look the same."""


@dataclass(frozen=True, eq=False)
class Window:
    """A page that shows an object, and all that speaks against it."""

    tab: Any
    there: Served
    faults: list[str]

    def picture(self, wanted: Callable[[np.ndarray], bool] = lambda _: True) -> np.ndarray:
        """(H, W, 3) what is seen beside the controls, once it is as wanted and changes no more."""
        before, alike, until = np.zeros(0), 0, time.monotonic() + PATIENCE / 1000
        while time.monotonic() < until:
            now = self._now()
            alike = alike + 1 if np.array_equal(now, before) else 0
            if alike >= 2 and wanted(now):
                return now
            before = now
            self.tab.wait_for_timeout(150)
        raise AssertionError("the picture never came to be as it should")

    def other_than(self, before: np.ndarray) -> np.ndarray:
        """What is seen once it is no longer that."""
        return self.picture(lambda now: (now != before).any(axis=2).sum() > 100)

    def toggle(self, name: str) -> None:
        """Flip a box, and wait until the server knows: of two flipped within 50 ms, viser's page
        sends the second alone."""
        box = self.tab.get_by_role("checkbox", name=name)
        box.click(force=True)
        until(self.tab, lambda: (name in self.there.session.wish.layers) == box.is_checked())

    def as_at_first(self) -> np.ndarray:
        """What is seen with the layers and joint values that a window has at first."""
        for name in LAYERS:
            box = self.tab.get_by_role("checkbox", name=name)
            if box.count() and box.is_checked() != (name in AT_FIRST):
                self.toggle(name)
        self.tab.get_by_label("State").first.click()
        self.tab.get_by_role("option").first.click()
        self.tab.wait_for_selector("text=state 0, as it is stored")
        return self.picture(lambda now: now.min() < 150)

    def _now(self) -> np.ndarray:
        shot = self.tab.locator("canvas").first.screenshot()
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), np.int64)


def opened(chromium: Any, there: Served, screen: dict[str, int]) -> Window:
    """A window that shows the first object."""
    tab = chromium.new_context(viewport=screen).new_page()
    tab.set_default_timeout(PATIENCE)
    faults = faults_of(tab, there.url, there.url.replace("http", "ws"))
    tab.goto(f"{there.url}/?{SHARP}")
    tab.add_style_tag(content=STILL)
    tab.wait_for_selector("text=as it is stored")
    return Window(tab, there, faults)


@pytest.fixture(scope="module")
def cabinet(viser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A cabinet with a door and a tray, made as `generate` makes it."""
    folder = tmp_path_factory.mktemp("cabinets")
    (folder / "cabinet.urdf").write_text(CABINET)
    ag.generate("cabinet", folder, folder / "data", TINY, seed=3, jobs=0)
    with served(source_of(str(folder / "data" / "cabinet"))) as there:
        yield there


@pytest.fixture(scope="module")
def window(chromium: Any, cabinet: Served) -> Window:
    return opened(chromium, cabinet, WINDOW)


def where(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """(n, 2) the pixels of one hue, light or dark."""
    wanted, lit = np.array(colour) / max(colour), image.max(axis=2, keepdims=True)
    alike = (
        np.abs(image / np.maximum(lit, 1) - wanted).max(axis=2) < 0.15
    )  # lamps have a hue of their own
    return np.argwhere(alike & (lit[..., 0] > 60))


def assert_fills(image: np.ndarray) -> None:
    rows, columns = np.nonzero((image < 250).any(axis=2))
    height, width = image.shape[:2]
    assert rows.min() > 0
    assert rows.max() < height - 1
    assert columns.min() > 0
    assert columns.max() < width - 1
    assert max(np.ptp(rows) / height, np.ptp(columns) / width) > 0.5


def test_on_a_phone_the_object_stands_above_the_controls(chromium: Any, cabinet: Served) -> None:
    phone = opened(chromium, cabinet, PHONE)
    image = phone.picture(lambda now: now.min() < 150)
    assert_fills(image[: int(0.4 * len(image))])
    assert phone.faults == []
    placed = cabinet.session._stage._placed
    other = chromium.new_context().new_page()
    until(other, lambda: len(placed) == 1)
    phone.tab.close()
    until(other, lambda: not placed)  # or every window that there ever was would stay
    other.close()


def test_hostile_names_are_text_and_many_objects_no_trouble(viser, chromium, tmp_path):
    few = {"grids": (8,), "surface_points": 256, "uniform_points": 64, "near_points": 256}
    recipe = SMALL.model_copy(update={"sampling": SMALL.sampling.model_copy(update=few)})
    one = named(hinged_box(STATES, recipe=recipe)[0])
    many = [replace(one, object_id=f"{HOSTILE} {n}") for n in range(500)]
    path = shard(tmp_path / "train-00000.h5", many)
    with served(source_of(str(path))) as there:
        window = opened(chromium, there, WINDOW)
        tab = window.tab
        assert tab.get_by_text("500 objects").is_visible()
        assert "has no manifest.json" in tab.inner_text("body")
        assert "part 1: </title><img" in tab.inner_text("body")
        tab.get_by_label("Object").first.click()
        tab.get_by_role("option").nth(499).click()
        until(tab, lambda: of(there) == many[499].object_id)
        assert there.session.fault == ""
        assert window.faults == []
        tab.close()


def test_the_object_fills_the_window_and_nothing_is_cut_off(window: Window) -> None:
    assert_fills(window.as_at_first())
    assert window.faults == []


def test_a_slider_moves_its_part_and_changes_the_picture(window: Window) -> None:
    first, door = window.as_at_first(), layers.rgb("#4477aa")
    slider = window.tab.get_by_role("slider").first
    slider.focus()
    slider.press("End")
    window.tab.wait_for_selector("text=made for these joint values in")
    second, seen = window.other_than(first), window.there.session.seen
    assert seen is not None
    assert seen.state is None
    np.testing.assert_allclose(seen.q, [1.57, 0.785, 0.0])
    np.testing.assert_allclose(
        seen.instance.part_motion[1][:3, :3], rotation_about([0, 0, 1], 1.57), atol=1e-6
    )
    shut, wide = where(first, door), where(second, door)
    assert min(len(shut), len(wide)) > 300
    assert np.linalg.norm(shut.mean(axis=0) - wide.mean(axis=0)) > 0.03 * len(first)
    slider.press("Home")
    window.tab.wait_for_selector("text=state 0, as it is stored")
    window.picture(lambda now: np.array_equal(now, first))
    assert window.faults == []


def test_each_toggle_draws_something_and_takes_it_away(window: Window) -> None:
    window.as_at_first()
    for name in AT_FIRST:
        window.toggle(name)
    blank = window.picture(lambda now: (now == 255).all())
    for name in LAYERS:
        window.toggle(name)
        window.other_than(blank)
        window.toggle(name)
        window.picture(lambda now: (now == 255).all())
    assert window.faults == []


def of(there: Served) -> str | None:
    """Which object is shown."""
    seen = there.session.seen
    return seen.instance.object_id if seen else None


def until(tab: Any, true: Callable[[], bool]) -> None:
    """Wait for something that is not on the page."""
    end = time.monotonic() + PATIENCE / 1000
    while not true() and time.monotonic() < end:
        tab.wait_for_timeout(100)
    assert true()
