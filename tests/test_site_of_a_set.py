"""A set as a folder of static files: what is in it, whose folder it may be, and in a browser."""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import quote

import pytest
import test_cli
from browser import LAPTOP, PHONE, alone
from command_line import run
from instances import hinged_box
from ppd_data import shard
from test_html_report import HOSTILE, STATES, unusual_boxes

from articugen.core.errors import ArticugenError, CorruptShard, MachineFault, printable
from articugen.inspection.report.site import site
from articugen.store.manifest import Manifest

KEY = printable(f"train/{HOSTILE}")
FOLLOWED = """() => { const { joints, camera } = articugen.opened()[0].view.get();
  const says = (name, at) => `${name}=${at.map((x) => +x.toPrecision(6))}`;
  return location.hash.endsWith(`&${says("joints", joints)}&${says("camera", camera)}`); }"""


recipe, laptops = test_cli.recipe, test_cli.made


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boxes, ünusual")
    unusual_boxes(folder)
    return folder


@pytest.fixture(scope="module")
def made(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sites") / "a set #1"
    done = site(data, out, jobs=0)
    files = [path for path in out.rglob("*") if path.is_file()]
    assert (done.objects, done.bytes) == (2, sum(path.stat().st_size for path in files))
    return out


def test_it_is_made_again_in_its_own_folder_alone(made: Path, data: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
    stale = made / "objects" / "0123456789abcdef.js"
    theirs = made / "CNAME"
    for path in (stale, theirs):
        path.write_text("x")
    done = run("site", data, "--out", made, "--jobs", 1)
    assert done.exit_code == 0, done.output
    assert theirs.read_text() == "x"
    theirs.unlink()
    assert {path: path.read_bytes() for path in made.rglob("*") if path.is_file()} == before
    mine = tmp_path / "index.html"
    mine.write_text("my page")
    with pytest.raises(ArticugenError, match=r"holds something else \(index.html\)"):
        site(data, tmp_path, jobs=0)
    assert mine.read_text() == "my page"
    linked = tmp_path / "linked"
    linked.mkdir()
    shutil.copy(made / "index.html", linked)
    (tmp_path / "elsewhere").mkdir()
    (linked / "objects").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(MachineFault, match="symbolic link"):
        site(data, linked, jobs=0)
    assert not list((tmp_path / "elsewhere").iterdir())


class Counted(tuple):
    """Objects of a manifest, and how often somebody went through all of them."""

    times = 0

    def __iter__(self) -> Iterator[Any]:
        Counted.times += 1
        return super().__iter__()


def test_no_object_goes_through_the_whole_manifest(laptops: Path, tmp_path: Path, monkeypatch):
    manifest = Manifest.read(laptops)
    entries = [o.model_copy(update={"notes": (o.key.object_id * 2,)}) for o in manifest.objects]
    manifest = manifest.model_copy(update={"objects": Counted(entries)})
    monkeypatch.setattr(Manifest, "read", lambda _: manifest)
    site(laptops, tmp_path / "site", jobs=0)
    assert Counted.times == 2  # for the pages of objects, and for the table of all
    pages = [path.read_text() for path in tmp_path.glob("site/objects/*.js")]
    assert len(pages) == len(entries) == 2
    for entry in entries:
        assert [entry.notes[0] in page for page in pages].count(True) == 1


def test_a_damaged_shard_leaves_the_former_site_whole(made: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
    shard(tmp_path / "a.h5", hinged_box(STATES, object_id="new"))
    (tmp_path / "b.h5").write_bytes(b"no shard")
    with pytest.raises(CorruptShard, match=r"b\.h5"):
        site(tmp_path, made, jobs=0)
    assert all(path.read_bytes() == content for path, content in before.items())


def opened(chromium: Any, address: str, screen: dict[str, int], count: int) -> tuple[Any, list]:
    tab, faults = alone(chromium, screen, "http://127.0.0.1")
    tab.goto(address)
    if count:
        tab.wait_for_selector(f".viewer[data-ready] >> nth={count - 1}")
    return tab, faults


def test_objects_are_searched_opened_and_linked_to_offline(chromium: Any, made: Path) -> None:
    index = (made / "index.html").as_uri()
    tab, faults = opened(chromium, index, LAPTOP, 0)
    assert tab.locator(".tile:visible").count() == 2
    tab.fill("input[type=search]", "ONERROR")
    assert tab.locator(".tile:visible").count() == 1
    tab.fill("input[type=search]", "")
    tab.select_option("select >> nth=0", "test")
    assert tab.locator("output >> nth=0").inner_text() == "1 of 2"
    tab.select_option("select >> nth=0", "")
    tab.select_option("select >> nth=1", "Largest first")
    tab.focus(f".tile[href='#object={quote(KEY)}']")
    tab.keyboard.press("Enter")
    tab.wait_for_selector(".viewer[data-ready]")
    assert tab.locator("h3 >> nth=0").inner_text() == f"{printable(HOSTILE)} train"
    assert "Not measured" in tab.inner_text(".shown dl")
    step = tab.get_by_label("Stored state")
    step.focus()
    step.press("End")
    values = tab.evaluate("articugen.opened()[0].view.get().joints")
    assert values == pytest.approx([97.403, 0.02], abs=1e-2)
    tab.click("text=Play stored states")
    tab.wait_for_timeout(500)
    tab.click("text=Play stored states")
    tab.focus("canvas")
    tab.keyboard.press("ArrowLeft")
    tab.wait_for_function(FOLLOWED)  # the address follows once nothing moves
    link, state = tab.url, tab.evaluate("articugen.opened()[0].view.get()")
    tab.select_option("nav.tools select", "test/b")
    tab.wait_for_selector(".viewer[data-ready] >> nth=1")
    tab.keyboard.press("Escape")
    tab.wait_for_selector(".wall")  # the address changes first, then what is shown
    assert faults == []
    again, faults = opened(chromium, link, PHONE, 1)
    found = again.evaluate("articugen.opened()[0].view.get()")
    for name in ("joints", "camera"):
        assert found[name] == pytest.approx(state[name], abs=1e-3)
    assert again.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    lost, _ = opened(chromium, f"{index}#object=train/none", PHONE, 0)
    assert "There is no train/none" in lost.inner_text("[role=alert]")
    assert faults == []


@contextmanager
def hosted(folder: Path) -> Iterator[str]:
    """Its address at a server of this machine."""

    class Quiet(SimpleHTTPRequestHandler):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args, directory=str(folder))

        def log_message(self, format: str, *args: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def test_a_host_serves_it_as_well(chromium: Any, made: Path) -> None:
    with hosted(made) as address:
        tab, faults = opened(chromium, f"{address}#object=test/b&object=test/b", LAPTOP, 2)
        assert tab.locator("canvas").count() == 2
    assert faults == []


SCRIPTS = re.compile(r"/objects/\w+\.js$")


def test_what_failed_to_load_is_fetched_again(chromium: Any, made: Path) -> None:
    with hosted(made) as address:
        tab, _ = opened(chromium, address, LAPTOP, 0)
        tab.route(SCRIPTS, lambda route: route.fulfill(status=503))
        tab.evaluate("location.hash = 'object=test/b'")
        assert "is missing" in tab.inner_text(".shown [role=alert]")
        tab.unroute(SCRIPTS)
        tab.evaluate("location.hash = 'all'")
        tab.wait_for_selector(".wall", state="visible")
        tab.evaluate("location.hash = 'object=test/b'")
        tab.wait_for_selector(".viewer[data-ready]")


def test_an_object_is_put_beside_one_that_still_loads(chromium: Any, made: Path) -> None:
    with hosted(made) as address:
        tab, faults = opened(chromium, address, LAPTOP, 0)
        tab.route(SCRIPTS, lambda _: None)  # they wait until there is no route
        first = "object=test/b&joints=50,0.1&camera=1,0.5,2"
        tab.evaluate(f"location.hash = '{first}'")
        tab.select_option("nav.tools select", KEY)
        assert tab.evaluate("location.hash").startswith(f"#{first}&object=train")
        tab.unroute(SCRIPTS)
        tab.wait_for_selector(".viewer[data-ready] >> nth=1")
        found = tab.evaluate("articugen.opened()[0].view.get()")
    assert found == {"joints": pytest.approx([50, 0.1]), "camera": [1, 0.5, 2]}
    assert faults == []


def test_a_link_has_small_slides_and_those_of_the_object_that_moves(chromium, made) -> None:
    bare = 'articugen.loaded({"name": "b", "split": "test", "lines": [], "views": null})'
    script = re.findall(
        r'data-key="test/b".*?data-script="([^"]+)"', (made / "index.html").read_text()
    )
    with hosted(made) as address:
        tab, _ = alone(chromium, LAPTOP)
        tab.route(f"**/{script[0]}", lambda route: route.fulfill(body=bare))
        tab.goto(f"{address}#object=test/b&object={quote(KEY)}")
        tab.wait_for_selector(".viewer[data-ready]")
        tab.evaluate("articugen.opened()[1].view.set([12.5, 4.2e-5], [1, 0.5, 2])")
        tab.wait_for_function("() => location.hash.includes('joints=12.5,0.000042&')")
        tab.reload()
        tab.wait_for_selector(".viewer[data-ready]")
        found = tab.evaluate("articugen.opened().map(({ view }) => view && view.get())")
    assert found[0] is None
    assert found[1] == {"joints": pytest.approx([12.5, 4.2e-5]), "camera": [1, 0.5, 2]}


def test_a_card_that_is_closed_while_it_unpacks_takes_no_context(chromium: Any, made: Path) -> None:
    tab, faults = alone(chromium, LAPTOP)
    tab.add_init_script("""window.contexts = new Set();
      const get = HTMLCanvasElement.prototype.getContext, read = Response.prototype.arrayBuffer;
      HTMLCanvasElement.prototype.getContext = function (...of) {
        const context = get.apply(this, of);
        contexts.add(context);
        return context; };
      const open = new Promise((resolve) => (window.release = resolve));
      Response.prototype.arrayBuffer = async function () { await open; return read.apply(this); };
    """)
    tab.goto(f"{(made / 'index.html').as_uri()}#object=test/b")
    tab.wait_for_selector("canvas", state="attached")
    tab.evaluate(f"location.hash = 'object={quote(KEY)}'")
    tab.wait_for_selector(f"canvas[aria-label^={printable(HOSTILE)[0]!r}]", state="attached")
    tab.evaluate("release()")
    tab.wait_for_selector(".viewer[data-ready]")
    assert tab.evaluate("contexts.size") == 1
    assert faults == []


def test_names_are_text_and_only_its_own_scripts_run(made: Path) -> None:
    html = (made / "index.html").read_text()
    assert "<img src=x" not in html
    assert "unsafe" not in html[:3000]
    assert re.search(r"script-src &#x27;self&#x27; file: &#x27;sha256-", html)
