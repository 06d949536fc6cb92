"""Objects chosen by category and by the kinds of their joints, from a folder of many."""

import json
from pathlib import Path

import pytest
from command_line import run

from articugen.core.errors import InvalidSource
from articugen.sources.readers import load
from articugen.sources.source import open_source

MODELS = {
    "100": ("Table", ["prismatic", "prismatic"]),
    "101": ("Table", ["revolute", "prismatic"]),
    "102": ("Table", ["revolute", "fixed"]),
    "103": ("Table", ["fixed"]),
    "104": ("Table", ["continuous"]),
    "105": ("Laptop", ["revolute"]),
}


def add(folder: Path, category: str, kinds: list[str]) -> None:
    """A model in PartNet-Mobility's layout, one unit square a link."""
    folder.mkdir()
    shape = '<visual><geometry><mesh filename="square.obj"/></geometry></visual>'
    links = "".join(f'<link name="l{k}">{shape}</link>' for k in range(len(kinds)))
    joints = "".join(
        f'<joint name="j{k}" type="{kind}"><parent link="base"/><child link="l{k}"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1"/></joint>'
        for k, kind in enumerate(kinds)
    )
    (folder / "mobility.urdf").write_text(f'<robot><link name="base"/>{links}{joints}</robot>')
    (folder / "meta.json").write_text(json.dumps({"model_cat": category}))
    (folder / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")


@pytest.fixture
def folder(tmp_path):
    base = tmp_path / "models"
    base.mkdir()
    for name, (category, kinds) in MODELS.items():
        add(base / name, category, kinds)
    return base


def ids(refs) -> list[str]:
    return [ref.object_id for ref in refs]


@pytest.mark.parametrize(
    ("joints", "chosen"),
    [
        ([], ["100", "101", "102", "103", "104"]),
        (["prismatic"], ["100"]),
        (["revolute"], ["102"]),
        (["prismatic", "revolute"], ["100", "101", "102"]),
        (["continuous", "revolute"], ["102", "104"]),
    ],
)
def test_all_joints_that_move_are_of_the_kinds_asked_for(folder, joints, chosen):
    assert ids(open_source(folder).objects("Table", joints=joints)) == chosen


def test_the_splits_of_the_others_stay_what_they_are(folder):
    split = {ref.object_id: ref.split for ref in open_source(folder).objects("Table")}
    for ref in open_source(folder).objects("Table", joints=["prismatic", "revolute"]):
        assert ref.split == split[ref.object_id]


def test_no_mesh_is_opened_to_choose(folder):
    (folder / "100" / "square.obj").write_bytes(b"\xff" * 9)
    (chosen,) = open_source(folder).objects("Table", joints=["prismatic"])
    with pytest.raises(InvalidSource, match=r"square\.obj"):
        load(chosen)


def test_what_cannot_be_read_stays_to_be_refused(folder):
    (folder / "104" / "mobility.urdf").write_text("<robot><link")
    assert ids(open_source(folder).objects("Table", joints=["prismatic"])) == ["100", "104"]


@pytest.mark.parametrize(
    ("joints", "sentence"),
    [
        (["hinge"], "no kind of joint 'hinge'; there are: revolute, continuous, prismatic"),
        (["revolut"], "did you mean 'revolute'"),
        (["prismatic"], "no object of 'Laptop' has prismatic joints alone; name more of"),
    ],
)
def test_refusals_name_the_cure(folder, joints, sentence):
    with pytest.raises(InvalidSource, match=sentence):
        open_source(folder).objects("Laptop", joints=joints)


def test_the_command_makes_those_alone(folder, tmp_path):
    arguments = f"-c Table -s {folder} -r quick -j 0 -o {tmp_path} --joints prismatic --dry-run"
    told = run("generate", *arguments.split())
    assert told.exit_code == 0, told.output
    assert "1 object (100)" in told.output
