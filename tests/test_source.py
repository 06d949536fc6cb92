"""Which objects a source has, their splits, and that each is read by the right reader."""

import errno
import os
import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from few import FEW
from hypothesis import given
from hypothesis import strategies as st
from real_models import REAL_MODELS, needs_real_models
from source_models import URDF, add, add_partnet

from articugen.core.content import SOURCES
from articugen.core.errors import InvalidSource, MachineFault
from articugen.pipeline.door import jobs_of
from articugen.pipeline.options import Options
from articugen.procedural import CATEGORIES
from articugen.sources import urdf_files
from articugen.sources.folders import meta_category
from articugen.sources.readers import load
from articugen.sources.refs import ObjectRef
from articugen.sources.source import named_sources, open_source
from articugen.sources.source_file import read_source_file
from articugen.sources.urdf import load_urdf
from tests.procedural_truth import object_id

PAPER = {
    "drawer": (24, 6),
    "eyeglasses": (35, 7),
    "laptop": (73, 13),
    "oven": (30, 7),
    "washing_machine": (39, 6),
}


def ids(refs: tuple[ObjectRef, ...], split: str | None = None) -> list[str]:
    return [ref.object_id for ref in refs if split in (None, ref.split)]


@pytest.mark.parametrize("source", ["procedural", "procedural_messy"])
@pytest.mark.parametrize("category", PAPER)
def test_procedural_counts_are_the_papers(source, category):
    refs = open_source(source).objects(category)
    counts = Counter(ref.split for ref in refs)
    assert (counts["train"], counts["test"]) == PAPER[category]
    assert ids(refs) == [object_id(category, i) for i in range(len(refs))]
    assert {ref.location.name for ref in refs} == set(ids(refs))


@FEW
@given(category=st.sampled_from(sorted(PAPER)), objects=st.integers(1, 400))
def test_any_number_of_procedural_objects_keeps_the_ratio(category, objects):
    train, test = PAPER[category]
    refs = open_source("procedural").objects(category, objects=objects)
    assert len(refs) == len(set(ids(refs))) == objects
    tests = len(ids(refs, "test"))
    assert abs(tests - objects * test / (train + test)) <= 1
    assert (tests >= 1 and tests < objects) or objects == 1
    more = open_source("procedural").objects(category, objects=objects + 50)
    split_of = {ref.object_id: ref.split for ref in more}
    assert all(split_of.get(ref.object_id, ref.split) == ref.split for ref in refs)


def test_loading_a_procedural_object_writes_it(own_sources):
    add(
        own_sources / "procedural" / "source.yaml",
        "{origin: x, licence: x, frame: x, reader: procedural,"
        " categories: {drawer: {train: 1, test: 1, yaw_degrees: 90}}}",
    )
    ref = open_source("procedural").objects("drawer")[0]
    assert ref.location == own_sources / "procedural" / "drawer" / "drawer_0000"
    obj = load(ref)
    assert (obj.object_id, obj.category, obj.source) == ("drawer_0000", "drawer", "procedural")
    assert [str(j.kind) for j in obj.moving_joints] == ["prismatic"] * 3
    np.testing.assert_allclose(obj.T_world_root[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    assert load(pickle.loads(pickle.dumps(ref))).sha256 == obj.sha256


def test_folder_of_urdfs_in_many_layouts(tmp_path):
    add(tmp_path / "plain.urdf")
    add(tmp_path / "single" / "urdf" / "whatever.urdf", URDF.format('<mesh filename="../m.obj"/>'))
    add(tmp_path / "single" / "m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    add(tmp_path / "several" / "one.urdf")
    add(tmp_path / "several" / "deep" / "two.urdf")
    add(tmp_path / "meshes" / "none.obj", "")
    add(tmp_path / ".hidden" / "x.urdf")
    add(tmp_path / "single" / "urdf" / "._whatever.urdf")
    add(tmp_path / "single" / ".backup" / "old.urdf")
    refs = open_source(str(tmp_path)).objects("anything")
    assert ids(refs) == ["plain", "several.deep.two", "several.one", "single"]
    assert len({ref.split for ref in refs if ref.object_id.startswith("several")}) == 1
    assert {ref.split for ref in refs} == {"train", "test"}
    for ref in refs:
        obj = load(ref)
        assert (obj.object_id, obj.category, len(obj.joints)) == (ref.object_id, "anything", 1)
    assert open_source(tmp_path).objects("anything") == refs
    assert len(open_source(tmp_path).objects("anything", objects=99)) == 4
    assert len(ids(open_source(tmp_path).objects("anything", objects=2), "test")) == 1


def test_a_urdf_that_lies_too_deep_is_named(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path)
    folder = tmp_path / "a" / "b" / "c" / "d"
    for name in ("no.obj", "e.URDF"):
        add(folder / name)
        with pytest.raises(InvalidSource) as caught:
            open_source(tmp_path).objects("lamp")
        depth = f" up to 3 folders down in what is in it, though {folder / name} lies deeper"
        depth = depth if name == "e.URDF" else ""
        assert f"{tmp_path}: holds no URDF, MJCF or USD{depth}; put each model" in str(caught.value)
    add(folder.parent / "f.urdf")
    assert ids(open_source(tmp_path).objects("lamp")) == ["a"]


def test_single_file_and_category_folder(tmp_path):
    path = add(tmp_path / "lamp" / "a.urdf")
    add(tmp_path / "chair" / "b.urdf")
    assert ids(open_source(path).objects("anything")) == ["a"]
    assert ids(open_source(tmp_path).objects("lamp")) == ["a"]
    assert ids(open_source(tmp_path).objects("table")) == ["chair", "lamp"]


def test_folders_are_read_by_the_reader_they_look_like(tmp_path, monkeypatch):
    add_partnet(tmp_path / "100", "Laptop")
    add_partnet(tmp_path / "200", "Oven")
    add(tmp_path / "300" / "motion_attributes.json", "{}")
    (tmp_path / "300" / "part_objs").mkdir()
    add(tmp_path / "400" / "x.urdf")
    refs = [r for c in ("laptop", "object") for r in open_source(tmp_path).objects(c)]
    assert ids(refs) == ["100", "300", "400"]
    seen = []

    def reader(ref, settings):
        seen.append((ref.location.name, ref.object_id, settings))
        return load_urdf(box, object_id=ref.object_id, category="x", source="x")

    box = add(tmp_path.parent / "box.urdf")

    for name in ("partnet_mobility", "shape2motion"):
        monkeypatch.setattr(f"articugen.sources.{name}.load", reader)
    digests = [load(ref).sha256 for ref in refs]
    assert digests[0] != digests[1], "what source.yaml says of laptops counts in the digest"
    assert load(refs[2]).object_id == "400"
    assert [found[:2] for found in seen] == [("100", "100"), ("300", "300")]
    partnet = read_source_file(SOURCES / "partnet_mobility" / "source.yaml")
    assert seen[0][2] == partnet.categories["laptop"]
    with pytest.raises(InvalidSource, match="no category 'chair'; there are: Laptop, Oven"):
        open_source(tmp_path).objects("chair")
    (alone,) = open_source(tmp_path / "200").objects("anything")
    assert (alone.object_id, alone.settings.model_cat) == ("200", ("Oven",))


@pytest.mark.parametrize("layout", ["flat", "sorted"])
def test_named_source_finds_its_models(own_sources, layout):
    for name, category in [("1", "Laptop"), ("2", "Laptop"), ("3", "Oven")]:
        below = category.lower() if layout == "sorted" else "."
        add_partnet(own_sources / "partnet_mobility" / below / name, category)
    assert ids(open_source("partnet_mobility").objects("laptop")) == ["1", "2"]
    assert ids(open_source("partnet_mobility").objects("oven")) == ["3"]
    source = open_source("partnet_mobility")
    assert source.folder == own_sources / "partnet_mobility"
    counts = {name: splits.total() for name, splits in source.counts().items() if splits}
    assert counts == {"laptop": 2, "oven": 1}


def test_own_source_with_lists_of_ids(own_sources, tmp_path):
    for name in ("a", "b", "c", "d"):
        add(tmp_path / "models" / "lamp" / f"{name}.urdf")
    add(
        own_sources / "mine" / "source.yaml",
        "{origin: x, licence: x, frame: x, path: ../../models,"
        " categories: {lamp: {test: [b, zz], canonical: upper}}}",
    )
    for source in ("mine", str(own_sources / "mine"), own_sources / "mine"):
        refs = open_source(source).objects("lamp")
        assert ids(refs, "train") == ["a", "c", "d"]
        assert ids(refs, "test") == ["b"]
        assert load(refs[0]).source == str(source)
        assert open_source(source).find("lamp", "b").settings == refs[0].settings
        assert refs[0].settings.canonical == "upper"
    with pytest.raises(InvalidSource, match=r"no object 'q' of 'lamp'; there are: a, b, c, d$"):
        open_source("mine").objects("lamp", ids=["q"])


def test_a_folder_has_one_name_however_its_path_ends(tmp_path, monkeypatch):
    add(tmp_path / "plain" / "lamp" / "a.urdf")
    add(tmp_path / "own" / "lamp" / "a.urdf")
    add(
        tmp_path / "own" / "source.yaml",
        "{origin: x, licence: x, frame: x, categories: {lamp: {}}}",
    )
    add(tmp_path / "procedural" / "lamp" / "a.urdf")  # as a source is called
    monkeypatch.chdir(tmp_path)
    for source in ("./procedural", Path("procedural"), "procedural/"):
        job, *_ = jobs_of(Options("lamp", source))
        assert job.source == open_source(job.source).objects("lamp")[0].source == "./procedural"
    for folder in (tmp_path / "plain", tmp_path / "own"):
        job, *_ = jobs_of(Options("lamp", f"{folder}/./"))
        assert job.source == str(folder) == open_source(job.source).objects("lamp")[0].source


def add_many(folder: Path) -> None:
    """Category folders as people have them, one model of each but two dishwashers."""
    for name in ("12552", "12553"):
        add_partnet(folder / "Dishwasher" / name, "Dishwasher")
    add_partnet(folder / "StorageFurniture" / "40147", "StorageFurniture")
    add_partnet(folder / "Table" / "25913", "Table")
    add_partnet(folder / "Washing Machine" / "103480", "WashingMachine")
    add(folder / "notes" / "readme.txt", "x")


def add_flat(folder: Path) -> None:
    """The same models side by side, as the data set is shipped."""
    kinds = {"12552": "Dishwasher", "12553": "Dishwasher", "40147": "StorageFurniture"}
    for name, kind in (kinds | {"25913": "Table", "103480": "WashingMachine"}).items():
        add_partnet(folder / name, kind)


@pytest.mark.parametrize("lay", [add_many, add_flat])
@pytest.mark.parametrize("as_source", [True, False])
@pytest.mark.parametrize(
    ("asked", "own", "wanted"),
    [
        ("dishwasher", "dishwasher", ["12552", "12553"]),
        ("Dishwasher", "dishwasher", ["12552", "12553"]),
        ("washing_machine", "washing_machine", ["103480"]),
        ("WASHINGMACHINE", "washing_machine", ["103480"]),
        ("cabinet", "storage_furniture", ["40147"]),
        ("StorageFurniture", "storage_furniture", ["40147"]),
        ("table", "table", ["25913"]),
        ("drawer", "drawer", ["25913", "40147"]),
    ],
)
def test_a_category_by_any_of_its_names(lay, as_source, asked, own, wanted, own_sources, tmp_path):
    folder = own_sources / "partnet_mobility" if as_source else tmp_path / "models"
    lay(folder)
    source = "partnet_mobility" if as_source else str(folder)
    assert open_source(source).categories([asked]) == (own,)
    for name in (asked, own):
        refs = open_source(source).objects(name)
        assert ids(refs) == wanted
        assert refs[0].settings.model_cat
    assert open_source(source).categories([f"{asked}, {own}"]) == (own,)


@pytest.mark.parametrize("lay", [add_many, add_flat])
def test_a_category_that_is_not_there_names_the_nearest_and_all(lay, tmp_path):
    lay(tmp_path)
    with pytest.raises(InvalidSource, match=r"no category 'dishwsher'; did you mean 'dishwasher'"):
        open_source(tmp_path).objects("dishwsher")
    with pytest.raises(InvalidSource, match=r"there are: .*StorageFurniture, Table, Washing"):
        open_source(tmp_path).objects("laptop")


@pytest.mark.parametrize("lay", [add_many, add_flat])
def test_all_categories_are_those_that_are_there(lay, tmp_path, own_sources):
    lay(tmp_path / "models")
    lay(own_sources / "partnet_mobility")
    four = ("dishwasher", "storage_furniture", "table", "washing_machine")
    assert open_source(tmp_path / "models").categories(["all"]) == four
    assert set(open_source("partnet_mobility").categories(["all"])) == {*four, "drawer"}
    assert open_source("procedural").categories(["oven", "all"])[0] == "oven"
    assert open_source("procedural").categories(["all"]) == tuple(CATEGORIES)


def test_a_plain_folder_takes_any_name_but_does_not_know_all(tmp_path):
    add(tmp_path / "a.urdf")
    add(tmp_path / "laptop" / "urdf" / "laptop.urdf")
    assert open_source(str(tmp_path)).categories(["Cabinet,thing", "thing"]) == ("Cabinet", "thing")
    assert ids(open_source(tmp_path).objects("Cabinet")) == ["a", "laptop"]
    with pytest.raises(InvalidSource, match="does not state the categories"):
        open_source(str(tmp_path)).categories(["all"])
    with pytest.raises(InvalidSource, match="no category is asked for"):
        open_source(str(tmp_path)).categories([" , "])


def test_plain_urdfs_in_folders_called_like_categories(tmp_path):
    for name in ("lamp/a", "lamp/b", "Chair/c", "Chair/d"):
        add(tmp_path / f"{name}.urdf")
    assert ids(open_source(tmp_path).objects("chair")) == ["c", "d"]
    assert open_source(tmp_path).categories(["all"]) == ("chair", "lamp")
    with pytest.raises(InvalidSource, match="no category 'table'; there are: Chair, lamp"):
        open_source(tmp_path).objects("table")


@pytest.mark.parametrize("source", ["procedural", "folder"])
def test_chosen_objects_keep_their_splits(source, tmp_path):
    for k in range(20):
        add(tmp_path / f"laptop_{k:04d}.urdf")
    where = tmp_path if source == "folder" else source
    split = {ref.object_id: ref.split for ref in open_source(where).objects("laptop")}
    some = ("laptop_0003", "laptop_0006", "laptop_0011")
    refs = open_source(where).objects("laptop", ids=some)
    assert ids(refs) == list(some)
    assert all(ref.split == split[ref.object_id] for ref in refs)
    rest = open_source(where).objects("laptop", exclude=some)
    assert ids(rest) == [name for name in split if name not in some]
    assert all(ref.split == split[ref.object_id] for ref in rest)
    assert ids(open_source(where).objects("laptop", ids=some, exclude=some[:1])) == list(some[1:])
    assert len(open_source(where).objects("laptop", ids=some, objects=2)) == 2
    with pytest.raises(InvalidSource, match=r"no object 'laptop_3'.*did you mean 'laptop_00"):
        open_source(where).objects("laptop", ids=["laptop_3"])
    with pytest.raises(InvalidSource, match="no object 'x' of 'laptop'; there are: laptop_0000,"):
        open_source(where).objects("laptop", exclude=["x"])
    with pytest.raises(InvalidSource, match="no object of 'laptop' is left"):
        open_source(where).objects("laptop", ids=some, exclude=some)


def test_a_procedural_object_past_the_papers_number_can_be_asked_for():
    (ref,) = open_source("procedural").objects("laptop", ids=["laptop_0123"])
    more = open_source("procedural").objects("laptop", objects=200)
    assert ref in more


def test_models_of_others_stay_inside_their_limits(tmp_path):
    assert open_source("partnet_mobility").clips
    assert open_source(str(tmp_path)).clips
    assert not open_source("procedural").clips
    assert not open_source("procedural_messy").clips


def test_one_bad_object_stops_no_other(tmp_path):
    """Each is found, and its own reading tells what is wrong with it."""
    add(tmp_path / "good.URDF")
    os.mkfifo(tmp_path / "fifo.urdf")
    (tmp_path / "gone.urdf").symlink_to("nowhere")
    os.makedirs(os.fsencode(tmp_path) + b"/caf\xe9")
    add(Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9/m.urdf")))
    add(tmp_path / "a\nb.urdf")
    deep = tmp_path / ("x" * 200)
    add(deep / "one.urdf")
    add(deep / ("y" * 200) / "two.urdf")
    (tmp_path / "closed").mkdir(mode=0)
    told = {}
    for ref in open_source(tmp_path).objects("thing"):
        try:
            told[ref.object_id] = load(ref).object_id
        except InvalidSource as error:
            told[ref.object_id] = str(error)
    assert all(map(str.isprintable, told.values()))
    assert told["good"] == "good"
    assert "it is a FIFO, not a regular file" in told["fifo"]
    assert "put the file there" in told["gone"]
    assert "is not UTF-8; rename" in told["caf\udce9"]
    assert "control characters" in told["a\nb"]
    assert "its id has more than 255 bytes" in told[f"{'x' * 200}.{'y' * 200}.two"]
    assert told[f"{'x' * 200}.one"] == f"{'x' * 200}.one"


def test_what_a_reader_did_not_expect_is_the_objects_fault(tmp_path, monkeypatch):
    ref = open_source(add(tmp_path / "a.urdf")).objects("thing")[0]

    def raising(error):
        def read(*_args, **_kinds):
            raise error

        return read

    for error, kind in (
        (ValueError("odd\nthing"), InvalidSource),
        (RecursionError(), InvalidSource),
        (MemoryError(), MemoryError),
        (OSError(errno.EIO, "Input/output error"), MachineFault),
        (OSError(errno.EMFILE, "Too many open files"), MachineFault),
    ):
        monkeypatch.setattr("articugen.sources.urdf.load_urdf", raising(error))
        with pytest.raises(kind) as caught:
            load(ref)
        assert "\n" not in str(caught.value)


def test_objects_of_one_name_are_called_by_their_path(tmp_path):
    """However contrived, they stay distinct, and together in a split."""
    for name in ("a.urdf", "a/x.urdf", "a.x.urdf.urdf", "b/a.urdf", "a.URDF"):
        add(tmp_path / name)
    add(tmp_path / "C.URDF")
    refs = open_source(tmp_path).objects("thing")
    assert sorted(ids(refs)) == ["C", "a.URDF", "a.urdf", "a.x.urdf", "a.x.urdf~", "b"]
    assert len({ref.split for ref in refs if ref.object_id in ("a.urdf", "a.x.urdf")}) == 1


def test_a_source_that_cannot_be_written_down_is_refused(tmp_path):
    with pytest.raises(InvalidSource, match="is not UTF-8; rename it"):
        open_source(tmp_path / "caf\udce9").objects("thing")
    with pytest.raises(InvalidSource, match="no source"):
        open_source("a" * 5000).objects("thing")


@pytest.mark.parametrize("to", ["/dev/zero", "../secret.json"])
def test_a_meta_json_that_is_a_link_out_of_the_model_is_not_read(tmp_path, to):
    add(tmp_path / "secret.json", '{"model_cat": "secret"}')
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "meta.json").symlink_to(to)
    assert meta_category(tmp_path / "1") == ""


@pytest.mark.parametrize(
    ("source", "category", "objects", "problem"),
    [
        ("procedurl", "laptop", None, "no source 'procedurl'; did you mean 'procedural'"),
        ("./nowhere", "laptop", None, "no source './nowhere'; there are: "),
        ("procedural", "lapto", None, "no category 'lapto'; did you mean 'laptop'"),
        ("procedural", "laptop", 0, "ask for one at least"),
        ("tests/test_source.py", "laptop", None, "is no URDF, nor an MJCF"),
        ("articugen/sources", "laptop", None, "holds no URDF"),
    ],
)
def test_what_is_not_there(source, category, objects, problem, monkeypatch):
    monkeypatch.chdir(SOURCES.parent)
    with pytest.raises(InvalidSource, match=problem):
        open_source(source).objects(category, objects=objects)


def test_named_source_without_models_names_its_readme(own_sources):
    add(
        own_sources / "mine" / "source.yaml",
        "{origin: x, licence: x, frame: x, categories: {lamp: {}}}",
    )
    with pytest.raises(InvalidSource, match=r"no model of 'lamp' under .*mine; .*README\.md says"):
        open_source("mine").objects("lamp")
    assert not any(open_source("mine").counts().values())


def test_sources_folder_that_is_none(monkeypatch):
    monkeypatch.setenv("ARTICUGEN_SOURCES", "/nowhere/at/all")
    with pytest.raises(InvalidSource, match="ARTICUGEN_SOURCES=/nowhere/at/all is not a folder"):
        named_sources()


@pytest.mark.parametrize(
    ("yaml", "problem"),
    [
        ("licens: x", "unknown key 'licens'; did you mean 'licence'"),
        (
            "categories: {a: {yaw_degree: 1}}",
            "unknown key 'categories.a.yaw_degree'; did you mean 'yaw_degrees'",
        ),
        ("categories: {a: {canonical: middle}}", "categories.a.canonical"),
        ("categories: {a: {train: 3}}", "both numbers, or neither"),
        ("categories: {a: {train: 0, test: 0}}", "both 0"),
        ("categories: {a: {train: [x], test: [x]}}", "object 'x' is in train and in test"),
        ("categories: {a: {test: [10040]}}", "ids are text, in quotes"),
        ("categories: {}", "categories"),
        ("reader: procedural", "a procedural category needs counts"),
        ("reader: pickle", "reader"),
        ("[", "not YAML that can be read"),
    ],
)
def test_wrong_source_file(tmp_path, yaml, problem):
    good = "origin: x\nlicence: x\nframe: x\n"
    good += "" if yaml.startswith("categories") else "categories: {a: {}}\n"
    path = add(tmp_path / "source.yaml", good + yaml)
    with pytest.raises(InvalidSource, match=problem) as caught:
        read_source_file(path)
    assert str(path) in str(caught.value)


@needs_real_models
@pytest.mark.parametrize("named", [True, False])
def test_every_real_model_loads(monkeypatch, named):
    monkeypatch.setenv("ARTICUGEN_SOURCES", str(REAL_MODELS))
    loaded = Counter()
    for source in ("partnet_mobility", "shape2motion"):
        for category in sorted(path.name for path in (REAL_MODELS / source).iterdir()):
            for ref in open_source(source if named else REAL_MODELS / source).objects(category):
                obj = load(ref)
                loaded[source] += 1
                assert len(obj.moving_joints) > 0
                assert all(np.isfinite(link.mesh.vertices).all() for link in obj.links)
    assert loaded == {"partnet_mobility": 19, "shape2motion": 2 if named else 4}


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda o: replace(o, links=(replace(o.links[0], mesh=_far(o)), *o.links[1:])), "link"),
        (lambda o: replace(o, joints=(replace(o.joints[0], upper=np.nan),)), "its range is"),
        (lambda o: replace(o, joints=(replace(o.joints[0], lower=1.0, upper=0.5),)), "its range"),
    ],
)
def test_what_a_reader_makes_is_looked_at(tmp_path: Path, monkeypatch, harm, reason: str) -> None:
    """Whoever wrote the reader: numbers that nobody can work with are the model's fault."""
    (ref,) = open_source(add(tmp_path / "box.urdf").parent).objects("box")
    sound = load(ref)
    monkeypatch.setattr(urdf_files, "load", lambda *_: harm(sound))
    with pytest.raises(InvalidSource, match=rf"box\.urdf: .*{reason}"):
        load(ref)


def _far(obj):
    mesh = obj.links[0].mesh
    return replace(mesh, vertices=mesh.vertices * np.inf)
