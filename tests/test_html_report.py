"""The report of a data set: its figures against closed forms, its page in a real browser."""

import base64
import hashlib
import io
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import test_cli
from browser import LAPTOP, PHONE, alone
from command_line import run
from instances import SMALL, edited, hinged_box
from PIL import Image
from ppd_data import rewrite, shard

from articugen.core.errors import MachineFault
from articugen.core.geometry import apply, rotation_about
from articugen.core.records import dequantize
from articugen.core.schema import Instance
from articugen.inspection.report.facts import facts
from articugen.inspection.report.markup import el, text
from articugen.inspection.report.page import write_report
from articugen.inspection.report.skin import skin
from articugen.inspection.report.truth import measured
from articugen.pictures.surfels import OrientedPoints
from articugen.store.manifest import Manifest
from articugen.store.shards import open_shard

STATES = ((0.0, 0.0), (0.5, 0.1), (1.2, 0.25), (1.7, 0.02))
HOSTILE = "</title><img src=x onerror=alert(1)><script>alert(2)</script>\u202e'\"&"


def named(instance: Instance) -> Instance:
    """With names that would like to be code."""
    names = {"joint_name": (HOSTILE, "scharnier_ü"), "part_name": ("body", HOSTILE, "箱")}
    return replace(instance, **names, part_semantic=("", HOSTILE, ""))


def unusual_boxes(folder: Path) -> list[Path]:
    """Write two shards: of a box with such names, for training, and of a plain one."""
    boxes = [named(i) for i in hinged_box(STATES, object_id=HOSTILE)]
    plain = hinged_box(STATES, object_id="b", seed=1)
    return [shard(folder / "train-00000.h5", boxes), shard(folder / "test-00000.h5", plain, "test")]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boxes with ünusual names")
    shards, html = unusual_boxes(folder), folder / "report.html"
    assert write_report(folder, shards, html) == html.stat().st_size
    return html


def cube(half: float, count: int, seed: int = 0) -> OrientedPoints:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-half, half, (count, 3))
    axis, side = rng.integers(3, size=count), rng.choice((-1.0, 1.0), count)
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = side
    points[np.arange(count), axis] = half * side
    return OrientedPoints(points, normals, np.zeros(count, np.uint8))


def test_the_skin_of_a_cube_is_flat_and_its_edges_are_sharp() -> None:
    turn = rotation_about(np.array([0.6, 0.0, 0.8]), 0.5)  # in line with no axis of the grid
    points = cube(0.2, 20000)
    turned = replace(points, points=points.points @ turn.T, normals=points.normals @ turn.T)
    found = skin(turned, 0.02, 0.4 * np.sqrt(6 / 20000))
    at = found.vertices @ turn
    off = np.abs(np.abs(at).max(axis=1) - 0.2)
    assert off.max() < 0.008  # two fifths of a voxel, at a corner
    assert off.mean() < 1e-4
    edges = np.sort(np.abs(at), axis=1)[:, 1] > 0.19  # close to two faces: on the edge itself
    assert np.median(np.abs(np.sort(np.abs(at[edges]), axis=1)[:, 1] - 0.2)) < 0.002
    corners = at[found.faces]
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(0.4**3, rel=0.02)


def test_a_plate_thinner_than_a_voxel_has_two_sides() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (20000, 3))
    side = rng.choice((-1.0, 1.0), 20000)
    points[:, 2] = 0.002 * side
    normals = np.stack([0 * side, 0 * side, side], axis=1)
    found = skin(OrientedPoints(points, normals, np.zeros(20000, np.uint8)), 0.02, 0.006)
    middle = found.vertices[np.abs(found.vertices[:, :2]).max(axis=1) < 0.25]
    np.testing.assert_allclose(np.abs(middle[:, 2]), 0.002, atol=1e-4)
    assert 0.4 < (middle[:, 2] > 0).mean() < 0.6


def test_facts_are_those_of_the_boxes(page: Path) -> None:
    found = facts(sorted(page.parent.glob("*.h5")))
    assert found.instances == 8
    assert found.bytes == sum(path.stat().st_size for path in page.parent.glob("*.h5"))
    box = next(each for each in found.objects if each.object_id == "b")
    assert box.split == "test"
    np.testing.assert_allclose([box.joints[0].upper, box.joints[1].upper], [100.0, 0.3])
    np.testing.assert_allclose(box.joints[0].drawn, np.degrees([0.5, 1.2, 1.7]))
    np.testing.assert_allclose(box.joints[1].drawn, [0.1, 0.25, 0.02])
    np.testing.assert_allclose(box.parts[1].box, [0.6, 0.6, 0.06], atol=0.01)
    solid = 0.6 * 0.6 * (0.08 + 0.06) + 0.1 * 0.12 * 0.055
    assert box.occupied.mean() == pytest.approx(solid / box.scale**3, rel=0.15)


recipe, laptops = test_cli.recipe, test_cli.made


def test_labels_agree_with_the_exact_solids_and_wrong_ones_do_not(laptops, tmp_path):
    manifest = Manifest.read(laptops)
    found = measured(facts(sorted(laptops.glob("*.h5"))).objects, manifest)
    assert len(found.instances) == 4, found.why_not
    for name, least in (("uniform", 0.9), ("near", 0.9), ("part", 0.99), ("surface", 0.98)):
        assert found.total(name) >= least
    path = next(laptops.glob("train*.h5"))
    still = Path(shutil.copy(path, tmp_path))
    rewrite(
        still,
        lambda rows: [
            edited(r, "part_motion", lambda T: np.tile(np.eye(4), (len(T), 1, 1))) for r in rows
        ],
    )
    wrong = measured(facts([still]).objects, manifest)
    assert wrong.total("surface") < found.total("surface") - 0.1
    assert "shard alone" in measured(facts([path]).objects, None).why_not
    others = manifest.model_copy(update={"objects": ()})  # of a shard that it does not list
    assert "is generated otherwise" in measured(facts([path]).objects, others).why_not


def test_real_models_have_no_exact_solids(laptops: Path) -> None:
    theirs = Manifest.read(laptops).model_copy(update={"source": "partnet_mobility"})
    found = measured(facts(sorted(laptops.glob("*.h5"))).objects, theirs)
    assert "no exact solids are known" in found.why_not


def test_text_is_never_markup() -> None:
    assert text(HOSTILE).count("<") == 0
    assert "\u202e" not in text(HOSTILE)
    written = el("p", HOSTILE, title=HOSTILE, hidden=True, class_=None)
    assert written.startswith("<p title=")
    assert written.count("<") == 2
    assert "hidden>" in written


class _Elements(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_the_page_runs_its_own_script_alone_and_asks_for_nothing(page: Path) -> None:
    html = page.read_text()
    parsed = _Elements(html)
    scripts = [attributes for tag, attributes in parsed.found if tag == "script"]
    assert scripts == [{"type": "application/json", "id": "scene"}, {}]
    policy = next(a["content"] for t, a in parsed.found if t == "meta" and "http-equiv" in a) or ""
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    for tag in ("style", "script"):
        inside = re.findall(f"<{tag}>(.*?)</{tag}>", html, re.DOTALL)[-1].encode()
        assert base64.b64encode(hashlib.sha256(inside).digest()).decode() in policy
    for tag, attributes in parsed.found:
        assert not any(name.startswith("on") or name == "style" for name in attributes), tag
        for name in ("src", "href"):
            assert re.match(r"data:image/|#", attributes.get(name) or "#"), attributes
        if tag in ("img", "canvas"):
            assert attributes.get("alt") or attributes.get("aria-label")
    assert "<" not in re.findall(r"<script type[^>]*>(.*?)</script>", html, re.DOTALL)[0]


def test_a_single_shard_and_one_without_points_have_reports_too(tmp_path: Path) -> None:
    one = shard(tmp_path / "one.h5", hinged_box(STATES[:1]))
    write_report(one, [one], tmp_path / "one.html")
    assert "Without a manifest" in (tmp_path / "one.html").read_text()
    bare = SMALL.model_copy(
        update={"sampling": SMALL.sampling.model_copy(update={"surface_points": 1})}
    )
    none = shard(tmp_path / "none.h5", hinged_box(STATES, recipe=bare))
    write_report(none, [none], tmp_path / "none.html")
    assert "nothing to turn" in (tmp_path / "none.html").read_text()
    with pytest.raises(MachineFault, match="make it first"):
        write_report(one, [one], tmp_path / "nowhere" / "one.html")


def test_a_report_and_a_sheet_overwrite_nothing_but_their_like(laptops, tmp_path):
    data = Path(shutil.copytree(laptops, tmp_path / "laptop"))
    mine = next(data.glob("*.h5"))
    before = mine.read_bytes()
    for option, cure in (
        ("--html", "a name ending in .html"),
        ("--image", "a name ending in .png"),
    ):
        for file in (mine, data / "manifest.json", data):
            done = run("inspect", data, option, file)
            assert done.exit_code == 1
            assert cure in " ".join(done.stderr.split())
    assert mine.read_bytes() == before
    assert Manifest.read(data)


@pytest.mark.parametrize("option", ["--html", "--image"])
def test_damaged_and_foreign_shards_are_refused_in_a_sentence(tmp_path: Path, option: str) -> None:
    out = tmp_path / ("x.html" if option == "--html" else "x.png")
    old = shard(tmp_path / "old.h5", hinged_box(STATES))
    with h5py.File(old, "r+") as file:
        file.attrs["schema_version"] = 99
    cut = shard(tmp_path / "cut.h5", hinged_box(STATES))
    cut.write_bytes(cut.read_bytes()[:-3000])
    (tmp_path / "empty.h5").write_bytes(b"")
    for name, says in (
        ("old.h5", "schema version 99, this articugen reads"),
        ("cut.h5", "cut short; make it again or fetch it again"),
        ("empty.h5", "cut short; make it again or fetch it again"),
    ):
        done = run("inspect", tmp_path / name, option, out)
        assert done.exit_code == 1
        assert name in done.stderr
        assert says in " ".join(done.stderr.split())
    assert not out.exists()


def test_five_hundred_objects_have_one_report(tmp_path: Path) -> None:
    few = {"grids": (8,), "surface_points": 256, "uniform_points": 64, "near_points": 256}
    recipe = SMALL.model_copy(update={"sampling": SMALL.sampling.model_copy(update=few)})
    one = hinged_box(STATES[:1], recipe=recipe)
    every = [replace(row, object_id=f"箱 {k}") for k in range(500) for row in one]
    path = shard(tmp_path / "train-00000.h5", every)
    html = tmp_path / "report.html"
    assert write_report(path, [path], html) < 5_000_000
    said = html.read_text()
    assert "500 objects in 500 joint states" in said.replace(",", "")
    assert "箱 0" in said
    assert "箱 499" in said


def test_inspect_writes_a_report_with_what_was_left_out(laptops: Path, tmp_path: Path) -> None:
    html = tmp_path / "report.html"
    done = run("inspect", laptops, "--html", html, "--objects", 1, "--states", 2)
    assert done.exit_code == 0, done.output
    assert f"report: {html}" in done.stdout
    said = html.read_text()
    manifest = Manifest.read(laptops)
    for word in (manifest.content_sha256, manifest.manifest_sha256, manifest.shards[0].sha256,
                 "every object that was asked for", "IoU", "procedural", "MIT"):  # fmt: skip
        assert word in said
    assert len(said) < 5_000_000


def opened(chromium: Any, html: Path, screen: dict[str, int], **context: Any) -> tuple[Any, list]:
    """The page, once its object can be turned, and what the console and dialogs say against it."""
    tab, faults = alone(chromium, screen, **context)
    tab.goto(html.as_uri())
    tab.wait_for_selector("#viewer[data-ready], #viewer[data-failed]", state="attached")
    assert tab.get_attribute("#viewer", "data-ready"), tab.inner_text("#viewer [role=status]")
    return tab, faults


def set_joint(tab: Any, joint: int, value: float) -> None:
    tab.eval_on_selector(
        f"#viewer .joint input >> nth={joint}",
        "(slider, value) => { slider.value = value; slider.dispatchEvent(new Event('input')); }",
        value,
    )


def picture(tab: Any) -> bytes:
    tab.evaluate(
        "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    return tab.locator("canvas").screenshot()


def test_a_slider_moves_its_part_as_the_shard_says(chromium: Any, page: Path) -> None:
    tab, faults = opened(chromium, page, PHONE)
    made = hinged_box(STATES)
    unit = np.array([np.degrees(1.0), made[0].scale])
    seen = [picture(tab)]
    for instance in made:
        for joint, value in enumerate(instance.joint_state * unit):
            set_joint(tab, joint, float(value))
        found = np.array(tab.evaluate("articugen.motions(articugen.states())"))
        np.testing.assert_allclose(
            found.reshape(-1, 4, 4).transpose(0, 2, 1), instance.part_motion, atol=1e-4
        )
        seen.append(picture(tab))
    assert len(set(seen)) == len(made) + 1  # as it opens, then each pose
    assert tab.inner_text("#viewer output >> nth=1") == "0.02"
    tab.click("#viewer button >> nth=0")
    assert picture(tab) == seen[0]
    assert faults == []


def test_it_opens_a_little_open_in_the_stored_state_that_its_slider_says(
    chromium: Any, page: Path
) -> None:
    tab, _ = opened(chromium, page, PHONE)
    values = [float(tab.input_value(f"#viewer .joint input >> nth={j}")) for j in (0, 1)]
    made = hinged_box(STATES)
    states = [one.joint_state * [np.degrees(1.0), one.scale] for one in made]
    stored = int(tab.input_value("#viewer .joint input >> nth=2"))
    np.testing.assert_allclose(values, states[stored - 1], atol=1e-3)
    assert tab.inner_text("#viewer output >> nth=2") == f"{stored} of {len(states)}"
    assert stored > 1
    set_joint(tab, 0, 99.0)
    assert tab.inner_text("#viewer output >> nth=2") == f"none of {len(states)}"


@pytest.mark.parametrize("screen", [LAPTOP, PHONE], ids=["laptop", "phone"])
def test_nothing_that_moves_is_cut_off(chromium, laptops, tmp_path, screen):
    shards = sorted(laptops.glob("test*.h5"))
    write_report(laptops, shards, tmp_path / "report.html", objects=1, states=1)
    with open_shard(shards[0]) as opened_shard:
        shut = opened_shard.instance(0)
    tab, _ = opened(chromium, tmp_path / "report.html", screen)
    points, part = dequantize(shut.surface_points), shut.surface_part
    for share in (0.0, 0.5, 1.0):
        set_joint(tab, 0, share * float(tab.get_attribute("#viewer .joint input >> nth=0", "max")))
        T = np.array(tab.evaluate("articugen.motions(articugen.states())")).reshape(-1, 4, 4)
        view = np.array(tab.evaluate("articugen.view()")).reshape(4, 4).T
        at = np.concatenate([apply(T[k].T, points[part == k]) for k in range(len(T))])
        clip = np.concatenate([at, np.ones((len(at), 1))], axis=1) @ view.T
        assert np.abs(clip[:, :2] / clip[:, 3:]).max() < 1.0


def test_on_paper_every_picture_and_column_is_there(chromium: Any, page: Path) -> None:
    tab, _ = alone(chromium, {"width": 720, "height": 400})
    tab.goto(page.as_uri())
    tab.emulate_media(media="print")
    drawn = "[...document.images].map(i => [i.complete && i.naturalWidth > 0, i.clientWidth > 0])"
    assert tab.evaluate(drawn) == [[True, True]] * (1 + 2 * 3)
    cut = """[...document.querySelectorAll('.scroll')].filter(s => s.scrollWidth > s.clientWidth)
             .map(s => [s.ariaLabel, s.scrollWidth, s.clientWidth])"""
    assert tab.evaluate(cut) == []
    assert not tab.is_visible("canvas")


def test_a_table_that_is_too_wide_is_shaded_where_it_goes_on(chromium: Any, page: Path) -> None:
    tab, _ = opened(chromium, page, PHONE)
    wide = tab.get_by_role("region", name="Parts and their sizes")
    assert wide.evaluate("w => w.scrollWidth > w.clientWidth")

    def shade() -> tuple[int, int]:
        """How much darker than the card the table is at its left and right rims."""
        seen = np.asarray(Image.open(io.BytesIO(wide.screenshot())).convert("L"), np.int64)
        seen = seen[2:-2]  # a rim may lie half on what is around
        return int(255 - seen[:, 1].max()), int(255 - seen[:, -2].max())

    left, right = shade()
    assert (left < 5, right > 20) == (True, True)
    wide.evaluate("w => { w.scrollLeft = w.scrollWidth }")
    left, right = shade()
    assert (left > 20, right < 5) == (True, True)


def test_keys_and_buttons_turn_it(chromium: Any, page: Path) -> None:
    tab, faults = opened(chromium, page, PHONE, color_scheme="dark")
    seen = [picture(tab)]
    tab.focus("canvas")
    for key in ("ArrowLeft", "ArrowUp", "+"):
        tab.keyboard.press(key)
        seen.append(picture(tab))
    tab.uncheck("#viewer .check input >> nth=0")
    seen.append(picture(tab))
    assert len(set(seen)) == len(seen)
    tab.check("#viewer .check input >> nth=0")
    tab.click("#viewer button >> nth=0")
    assert picture(tab) == seen[0]
    tab.click("#viewer button >> nth=1")
    for _ in range(100):
        tab.wait_for_timeout(100)
        if float(tab.input_value("#viewer .joint input >> nth=0")) > 2.0:
            break
    assert float(tab.input_value("#viewer .joint input >> nth=0")) > 2.0
    assert tab.get_attribute("#viewer button >> nth=1", "aria-pressed") == "true"
    assert faults == []


@pytest.mark.parametrize("screen", [LAPTOP, PHONE], ids=["laptop", "phone"])
def test_nothing_is_wider_than_the_screen_nor_wants_its_data_set_or_the_net(
    chromium: Any, page: Path, tmp_path: Path, screen: dict[str, int]
) -> None:
    alone = Path(shutil.copy(page, tmp_path / "alone.html"))
    tab, faults = opened(chromium, alone, screen, offline=True)
    tab.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert tab.evaluate("document.documentElement.scrollWidth") <= screen["width"]
    small = (
        "[...document.querySelectorAll('button, summary')].filter(b => b.clientHeight < 28).length"
    )
    assert tab.evaluate(small) == 0
    assert faults == []


def test_without_webgl_the_page_says_so_and_shows_a_picture(page: Path, chromium: Any) -> None:
    tab, _ = alone(chromium, PHONE)
    tab.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    tab.goto(page.as_uri())
    tab.wait_for_selector("#viewer[data-failed]", state="attached")
    assert "no WebGL 2" in tab.inner_text("#viewer [role=status]")
    assert tab.is_visible("#viewer .stage img")
