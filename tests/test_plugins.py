"""What other packages add: layouts and renderers; packages that are broken; any one model."""

import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from python_process import printed

from articugen.core.errors import BrokenPlugin, InvalidArgument, InvalidSource
from articugen.core.recipe import ViewSettings
from articugen.core.records import LabelledMesh
from articugen.export import formats
from articugen.rendering import render
from articugen.rendering.views import fusion_views
from articugen.sources import readers
from articugen.sources.readers import READERS, Maker
from articugen.sources.source import load_path, open_source
from articugen.sources.source_file import read_source_file

URDF = """<robot name="r"><link name="a"><visual><geometry><box size="1 2 3"/></geometry></visual>
</link><link name="b"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/></joint></robot>"""

CHESTS = '''
"""A made-up layout: a file <id>.chest holds the size of a box and how thick its lid is."""

import numpy as np

from articugen.core.geometry import transform
from articugen.core.records import ArticulatedObject, Joint, JointKind, Link, Mesh
from articugen.sources.folders import visible
from articugen.meshes.read import box
from articugen.meshes.model_files import ModelFiles
from articugen.sources.refs import Found


def detect(path):
    if path.suffix != ".chest":
        return None
    return Found(path.stem, path, path.stem, category="Box" if "box" in path.stem else "")


def find(base):
    return [found for path in visible(base) if (found := detect(path))]


def load(ref, settings):
    files = ModelFiles(ref.location.parent)
    x, y, z, lid = (float(word) for word in files.read(ref.location).split())
    hinge = transform(translation=(-x / 2, 0, z / 2))
    top = box((x, y, lid))
    return ArticulatedObject(
        object_id=ref.object_id,
        category=ref.category,
        links=(
            Link("body", box((x, y, z))),
            Link("lid", Mesh(top.vertices + (x / 2, 0, lid / 2), top.faces)),
        ),
        joints=(
            Joint("hinge", JointKind.REVOLUTE, "body", "lid", hinge, np.array([0, -1.0, 0]), 0, 2),
        ),
        T_world_root=settings.turn,
        sha256=files.sha256(),
        source=ref.source,
    )
'''

Install = Callable[..., None]


@pytest.fixture
def install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forget_plugins: Callable[[], None]
) -> Iterator[Install]:
    """Puts a package where Python finds it, as pip would: its module and its entry points."""
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(site)

    def put(package: str, module: str, code: str, group: str = "readers", **points: str) -> None:
        (site / f"{module}.py").write_text(code)
        folder = site / f"{package}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"[articugen.{group}]", *(f"{name} = {value}" for name, value in points.items())]
        (folder / "entry_points.txt").write_text("\n".join(lines) + "\n")
        forget_plugins()
        monkeypatch.delitem(sys.modules, module, raising=False)

    yield put
    monkeypatch.undo()
    forget_plugins()


def chests(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / f"{name}.chest").write_text("0.6 0.4 0.3 0.05")
    return folder


def test_a_package_adds_a_layout(install: Install, tmp_path: Path) -> None:
    install("chest-maker", "chests", CHESTS, chest="chests")
    folder = chests(tmp_path / "models", "a", "b")
    (folder / "c.urdf").write_text(URDF)
    refs = open_source(folder).objects("chest")
    assert [(ref.object_id, ref.reader) for ref in refs] == [
        ("a", "chest"), ("b", "chest"), ("c", "urdf")
    ]  # fmt: skip
    obj = readers.load(refs[0])
    assert (obj.object_id, obj.category, obj.source) == ("a", "chest", str(folder))
    assert [link.name for link in obj.links] == ["body", "lid"]
    np.testing.assert_array_equal(np.ptp(obj.links[0].mesh.vertices, axis=0), [0.6, 0.4, 0.3])
    single = load_path(folder / "b.chest")
    assert (single.object_id, single.category) == ("b", "object")
    assert single.sha256 != obj.sha256, "the name of the file counts"


def test_it_is_as_good_as_ours_in_folders_and_in_source_files(install, tmp_path, monkeypatch):
    install("chest-maker", "chests", CHESTS, chest="chests")
    folder = chests(tmp_path / "mixed", "box1", "plain")
    chests(folder / "trunk", "one", "two")
    assert open_source(str(folder)).categories(["all"]) == ("box", "trunk", "object")
    for category, ids in {"box": ["box1"], "object": ["plain"]}.items():
        assert [r.object_id for r in open_source(folder).objects(category)] == ids

    own = chests(tmp_path / "own" / "mine" / "box", "a", "b").parent
    (own / "source.yaml").write_text(
        "{origin: x, licence: x, frame: x, reader: chest, categories: {box: {yaw_degrees: 90}}}"
    )
    monkeypatch.setenv("ARTICUGEN_SOURCES", str(own.parent))
    ref = open_source("mine").objects("box")[0]
    turned = readers.load(ref).T_world_root[:3, :3]
    np.testing.assert_allclose(turned @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_a_run_is_planned_with_it(install: Install, tmp_path: Path) -> None:
    """By the command line and its worker, processes that know nothing but what is installed."""
    install("chest-maker", "chests", CHESTS, chest="chests")
    folder = chests(tmp_path / "models", "a", "b")
    shown = printed(
        *("-c", "from articugen.cli import main; main()", "generate", "--category", "chest"),
        *("--source", folder, "--recipe", "quick", "--dry-run"),
        *("--jobs", 1, "--out", tmp_path / "data"),
        PYTHONPATH=os.pathsep.join(sys.path),
    )
    assert "2 objects" in " ".join(shown.split())


def test_packages_that_cannot_be_used_are_named_once_and_break_no_other(install, tmp_path, caplog):
    install("broken-one", "raises", "raise RuntimeError('odd\\nthing')", sad="raises")
    install("halfway", "half", "detect = find = print", half="half")
    install("gone", "nothing", "", away="nowhere_at_all")
    install("thief", "steals", CHESTS, urdf="steals")
    install("chest-maker", "chests", CHESTS, chest="chests")
    folder = chests(tmp_path / "models", "a")
    with caplog.at_level(logging.WARNING, "articugen"):
        for _ in range(2):
            assert [r.object_id for r in open_source(folder).objects("x")] == ["a"]
    said = sorted(caplog.messages)
    assert len(said) == 4, said
    assert all("\n" not in line for line in said)
    assert "package broken-one: its entry point 'sad' of articugen.readers cannot be" in said[0]
    assert "RuntimeError: odd thing); mend or uninstall it" in said[0]
    assert "package gone: its entry point 'away'" in said[1]
    assert "package halfway: its entry point 'half' " in said[2]
    assert "is half, which has no load;" in said[2]
    assert "package thief: its entry point 'urdf' of articugen.readers is left out" in said[3]
    for name, sentence in (("sad", "package broken-one"), ("half", "package halfway")):
        with pytest.raises(BrokenPlugin, match=sentence):
            readers.reader(name)
    assert readers.reader("urdf") is READERS["urdf"]
    path = tmp_path / "source.yaml"
    path.write_text("{origin: x, licence: x, frame: x, reader: sad, categories: {a: {}}}")
    with pytest.raises(BrokenPlugin, match="package broken-one"):
        read_source_file(path)


def test_of_two_packages_with_one_name_the_first_counts(install, caplog):
    for package in ("b-chests", "a-chests"):
        install(package, package[0], CHESTS, chest=package[0])
    with caplog.at_level(logging.WARNING, "articugen"):
        assert readers.reader("chest").__name__ == "a"  # type: ignore[attr-defined]
    (line,) = caplog.messages
    assert "package b-chests" in line
    assert "a-chests has one of that name" in line


def test_a_reader_that_raises_as_it_looks_is_one_sentence(install: Install, tmp_path: Path) -> None:
    install("clumsy", "clumsy", "load = find = detect = lambda path: 1 / 0", clumsy="clumsy")
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(InvalidSource, match=r"a\.txt: the reader 'clumsy' cannot .*ZeroDiv"):
        readers.detect(tmp_path / "a.txt")
    with pytest.raises(InvalidSource, match="the reader 'clumsy' cannot examine it"):
        readers.find("clumsy", tmp_path)


def test_the_name_of_no_reader_has_its_nearest(tmp_path: Path) -> None:
    path = tmp_path / "source.yaml"
    path.write_text("{origin: x, licence: x, frame: x, reader: shape2moton, categories: {a: {}}}")
    with pytest.raises(InvalidSource, match="reader: no reader 'shape2moton'; did you mean 'shape"):
        read_source_file(path)


def test_ours_say_what_they_are() -> None:
    assert [name for name, each in READERS.items() if isinstance(each, Maker)] == ["procedural"]
    for name, each in READERS.items():
        assert each.detect(Path(__file__)) is None
        assert readers.find(name, Path(__file__).parent / "fuzz") == []  # a folder of code


def test_a_package_adds_a_renderer(install: Install) -> None:
    code = (
        "from articugen.rendering import rasterizer\n"
        "from articugen.core.backends import Backend\n"
        "def render(mesh, views): return rasterizer.render(mesh, views)\n"
        "TABLE = Backend('fancy', tells_faces=True)\n"
    )
    install("fancy-renderer", "fancy", code, group="backends", fancy="fancy:TABLE")
    assert ViewSettings.model_validate({"backend": "fancy"}).backend == "fancy"
    mesh = LabelledMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], np.zeros(1, np.uint8))
    views = fusion_views(ViewSettings(count=4, resolution=16), np.array([[0, 0, 0], [1, 1, 1]]))
    theirs = render(mesh, views, backend="fancy")
    np.testing.assert_array_equal(theirs.depth, render(mesh, views).depth)
    install("no-renderer", "dull", "render = 1", group="backends", dull="dull")
    with pytest.raises(BrokenPlugin, match=r"package no-renderer: .* has no render_parts"):
        render(mesh, views, backend="dull")


def test_a_package_adds_an_export_format(install: Install) -> None:
    code = "from dataclasses import replace\nfrom articugen.export.ply import FORMAT\n"
    install(
        "plain", "plain", f"{code}OWN = replace(FORMAT, what='x')", "formats", plain="plain:OWN"
    )
    assert formats.names() == (*formats.FORMATS, "plain")
    assert formats.format_named("plain").what == "x"
    install("dull", "dull", "items = write = 1", "formats", dull="dull", ply="dull")
    with pytest.raises(BrokenPlugin, match=r"package dull: .* has no what"):
        formats.format_named("dull")
    assert formats.format_named("ply").what != "x"
    with pytest.raises(InvalidArgument, match=r"no format 'plian'; did you mean 'plain'.*artgs, "):
        formats.format_named("plian")


def test_one_model_by_its_path(tmp_path: Path) -> None:
    urdf = tmp_path / "lamp" / "urdf" / "lamp.urdf"
    urdf.parent.mkdir(parents=True)
    urdf.write_text(URDF)
    partnet = tmp_path / "100"
    partnet.mkdir()
    shutil.copy(urdf, partnet / "mobility.urdf")
    (partnet / "meta.json").write_text(json.dumps({"model_cat": "Oven"}))
    raw = tmp_path / "200"
    (raw / "part_objs").mkdir(parents=True)
    (raw / "part_objs" / "none_motion.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    root = {"dof_name": "r", "motion_type": "none", "center": [0, 0, 0], "direction": [0, 0, 0]}
    (raw / "motion_attributes.json").write_text(json.dumps(root))
    for path, object_id, category in (
        (urdf, "lamp", "object"),
        (urdf.parent, "lamp", "object"),
        (urdf.parent.parent, "urdf", "object"),
        (partnet, "100", "Oven"),
        (raw, "200", "object"),
    ):
        obj = load_path(path)
        assert (obj.object_id, obj.category) == (object_id, category)
        assert load_path(str(path), "thing").category == "thing"
    turned = load_path(partnet).T_world_root
    assert turned[0, 0] == -1.0, "what source.yaml says of ovens"


def test_what_is_no_single_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidSource, match=r"nowhere: there is no such file or folder"):
        load_path(tmp_path / "nowhere")
    with pytest.raises(
        InvalidSource, match=r"is no model, nor a folder of one; name a URDF, MJCF or USD file"
    ):
        load_path(tmp_path)
    for name in ("a", "b"):
        (tmp_path / f"{name}.urdf").write_text(URDF)
    with pytest.raises(InvalidSource, match=r"holds 2 models; name one, such as .*a\.urdf"):
        load_path(tmp_path)
    with pytest.raises(InvalidSource, match="is no model"):
        load_path(__file__)
