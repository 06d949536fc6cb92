"""The functions of the package, and plain h5py as the pages read shards with it."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from instances import SMALL
from ppd_data import write_boxes
from test_maker import CABINET, TINY

import articugen as ag
from articugen.core.errors import ArticugenError, InvalidArgument
from articugen.core.recipe import Sampling
from articugen.pipeline.options import Options

README = Path(__file__).parents[1] / "README.md"
FORMAT = README.parent / "docs" / "format.md"


def blocks(page: Path) -> list[str]:
    """The Python of a page."""
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What README names: data/laptop, though its objects are boxes, and models of one's own."""
    folder = tmp_path_factory.mktemp("home")
    sampling = Sampling(grids=(8, 16, 32), partial_views=1, partial_resolution=64)
    recipe = SMALL.model_copy(update={"sampling": sampling})
    wanted = {"train": 2, "test": 1, "states": 8, "category": "laptop", "recipe": recipe}
    write_boxes(folder / "data" / "laptop", **wanted)
    (folder / "my" / "urdfs").mkdir(parents=True)
    for name in ("cabinet.urdf", "urdfs/first.urdf"):
        (folder / "my" / name).write_text(CABINET)
    return folder


def test_plain_h5py_reads_shards_as_the_pages_say(folder, tmp_path, monkeypatch):
    shutil.copytree(folder / "data", tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"scores": np.zeros(9)}
    for block in (blocks(README)[0], *blocks(FORMAT)):
        exec(compile(block, "page", "exec"), names)
    row = ag.open("data/laptop/train-00000.h5")[7]
    np.testing.assert_allclose(names["points"], row.surface.points, atol=1e-6)
    assert names["angle"][0] == row.joints[0].state


def test_generate_goes_on_replaces_and_refuses(folder, tmp_path):
    models = shutil.copytree(folder / "my" / "urdfs", tmp_path / "models")
    (models / "second.urdf").write_text(CABINET)

    def make(states=0, out=tmp_path, **options):
        recipe = TINY | {"articulation": {"states": states}}
        return ag.generate("cabinet", models, out, recipe, jobs=0, **options)

    told = []
    data = make(on_object=told.append, ids=["first"], seed=np.int64(0))
    assert ([report.reused for report in told], data.objects) == ([False], ("first",))
    told.clear()
    assert Options("box", ids=[10040], exclude=None).ids == ("10040",)
    one = make(ids="first", out=tmp_path / "one", movable="do*")
    assert [joint.name for joint in one[0].joints] == ["door", "lock"]  # which follows it
    assert len(make(on_object=told.append)) == 2
    assert [(report.object_id, report.reused) for report in told] == [
        ("first", True), ("second", False)]  # fmt: skip
    with pytest.raises(ArticugenError, match=r"recipe has changed.*or pass replace=True"):
        make(states=1)
    assert len(make(states=1, replace=True)) == 4
    report = ag.verify(tmp_path / "cabinet", replay=1, jobs=1)
    assert report.ok
    assert repr(report) == "Report(ok: 2 shards, 4 instances)"
    assert ag.verify(ag.open(tmp_path / "cabinet"), jobs=1).ok
    shard = ag.open(tmp_path / "cabinet").shards[0]
    shutil.copy(shard, shard.with_name("train-00009.h5"))
    report = ag.verify(tmp_path / "cabinet", jobs=1)
    assert not report.ok
    assert "Report(1 finding: " in repr(report)
    assert "train-00009.h5" in repr(report)
    with pytest.raises(InvalidArgument, match="'all' means 8 data sets"):
        ag.generate("all", out=tmp_path)


def test_what_was_made_is_where_its_model_is(folder, tmp_path):
    """A data set, a maker and the model's own frame agree about one object."""
    data = ag.generate("cabinet", folder / "my" / "urdfs", tmp_path, TINY, jobs=0, ids=["first"])
    maker = ag.Maker(ag.load(folder / "my" / "urdfs", "first", category="cabinet"), TINY)
    row = data[1]
    made = maker.at({name: value for name, value in maker[1].state.items() if name != "lock"})
    np.testing.assert_allclose(made.parts[1].motion, row.parts[1].motion, atol=1e-12)
    np.testing.assert_array_equal(made.labels(row.uniform.points), row.uniform.label)
    assert np.abs(row.flow_to(made)).max() < 1e-6
