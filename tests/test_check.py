"""The checker of models against closed forms, an exact oracle and hostile files."""

import json
from fractions import Fraction
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_line import run
from hypothesis import given
from hypothesis import strategies as st

import articugen as ag
from articugen.core.errors import InvalidSource
from articugen.inspection.check.faces import Soup
from articugen.inspection.check.model import FINDINGS, Checked
from articugen.meshes.crossings import crossings
from tests.shapes import box, labelled, rotated, sheet, two_sided

CUBE = box((0.5, 0.5, 0.5))


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)


def of_faces(mesh: trimesh.Trimesh, faces) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def checked(mesh: trimesh.Trimesh, folder: Path) -> Checked:
    """Return what is found of a mesh, written as a file."""
    mesh.export(folder / "mesh.ply")
    (model,) = ag.check(folder / "mesh.ply", jobs=0).models
    return model


def kinds(model: Checked) -> list[str]:
    assert model.problem is None
    return [finding.kind for finding in model.findings]


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e3])
def test_a_closed_cube_is_sound(tmp_path, size):
    model = checked(box((size, size, size), (3 * size, 0, 0)), tmp_path)
    (part,) = model.parts
    assert model.verdict == "sound"
    assert (part.triangles, part.open_edges, part.crossings, part.iou) == (12, 0, 0, 1.0)
    assert part.area == pytest.approx(6 * size**2)
    assert part.volume == pytest.approx(size**3)
    assert part.thickness == pytest.approx(size, rel=1e-2)
    assert model.enclosed == part.enclosed == 0.0


def counted(mesh: trimesh.Trimesh):
    return Soup(labelled(mesh)).counted()


def test_a_missing_face_leaves_its_three_edges_open(tmp_path):
    model = checked(of_faces(CUBE, CUBE.faces[1:]), tmp_path)
    assert model.parts[0].open_edges == 3
    assert model.parts[0].iou is model.parts[0].enclosed is None
    assert kinds(model)[0] == "open"


def test_a_face_without_area_closes_the_crack_that_it_fills():
    """An edge cut in the middle for one of its faces alone, as simplifying meshes do."""
    a, b, c = CUBE.faces[0]
    vertices = np.concatenate([CUBE.vertices, CUBE.vertices[[a, b]].mean(axis=0)[None]])
    halves = [(a, 8, c), (8, b, c)]
    crack = counted(trimesh.Trimesh(vertices, [*halves, *CUBE.faces[1:]], process=False))
    assert (crack.open_edges, crack.flat) == (3, 0)
    filled = [*halves, (a, b, 8), *CUBE.faces[1:]]
    found = counted(trimesh.Trimesh(vertices, filled, process=False))
    assert (found.open_edges, found.turned_edges, found.flat, found.is_closed) == (0, 0, 1, True)


def test_a_turned_face_disagrees_with_its_three_neighbours():
    faces = CUBE.faces.copy()
    faces[4] = faces[4][::-1]
    found = counted(of_faces(CUBE, faces))
    assert (found.turned_edges, found.flipped_pieces, found.open_edges) == (3, 0, 0)


def test_a_doubled_cube_is_closed_but_winds_around_nothing(tmp_path):
    model = checked(two_sided(CUBE), tmp_path)
    (part,) = model.parts
    assert kinds(model) == ["two-sided"]
    assert (part.two_sided, part.open_edges, part.turned_edges) == (1.0, 0, 0)
    assert (part.iou, part.enclosed) == (0.0, None)
    assert part.volume == pytest.approx(0.125)
    assert counted(joined(CUBE, CUBE)).repeated == 12


def test_pieces_inside_out_are_counted_and_walls_of_cavities_are_not():
    small = box((0.1, 0.1, 0.1))
    beside = box((0.1, 0.1, 0.1), (0.4, 0, 0))
    assert counted(inside_out(CUBE)).flipped_pieces == 1
    assert counted(joined(CUBE, inside_out(small))).flipped_pieces == 0
    assert counted(joined(CUBE, inside_out(small), inside_out(beside))).flipped_pieces == 1


def test_a_cavity_is_enclosed_space(tmp_path):
    model = checked(joined(CUBE, inside_out(box((0.25, 0.25, 0.25)))), tmp_path)
    (part,) = model.parts
    assert kinds(model) == ["unlike"]
    assert part.enclosed == pytest.approx(1 / 64, rel=1e-6)
    assert part.volume == pytest.approx(1 / 8)
    assert part.iou == pytest.approx(7 / 8)


def test_boxes_that_run_into_one_another_cross_and_boxes_that_touch_do_not(tmp_path):
    other = rotated(box((0.3, 0.3, 0.3), (0.2, 0.15, 0.1)), 0.3, (1, 2, 3))
    model = checked(joined(CUBE, other), tmp_path)
    assert kinds(model) == ["crossing"]
    assert model.parts[0].crossings >= 6
    assert counted(joined(CUBE, box((0.5, 0.5, 0.5), (0.5, 0, 0)))).crossings == 0
    assert counted(joined(CUBE, box((0.2, 0.2, 0.2), (0.35, 0.1, 0)))).crossings == 0


def test_three_leaves_at_an_edge_are_not_manifold():
    found = counted(of_faces(trimesh.Trimesh(np.eye(5, 3) * 0.2, [(0, 1, 2)]), [(0, 1, 2)]))
    assert found.crowded_edges == 0
    vertices = [(0, 0, 0), (0, 0, 0.3), (0.3, 0, 0), (0, 0.3, 0), (-0.3, -0.1, 0)]
    leaves = trimesh.Trimesh(vertices, [(0, 1, 2), (0, 1, 3), (0, 1, 4)], process=False)
    assert (counted(leaves).crowded_edges, counted(leaves).open_edges) == (1, 6)


def test_sheets_and_walls_have_a_thickness(tmp_path):
    assert checked(sheet(), tmp_path).parts[0].sheets == 1.0
    (plate,) = checked(box((0.6, 0.5, 0.03)), tmp_path).parts
    assert plate.sheets == 0.0
    assert plate.thickness == pytest.approx(0.03, abs=2e-4)


@given(st.permutations(range(12)), st.integers(0, 2))
def test_the_order_of_faces_and_their_first_corners_do_not_matter(order, turn):
    odd = joined(CUBE, rotated(box((0.3, 0.3, 0.3), (0.2, 0.15, 0.1)), 0.3, (1, 2, 3)))
    odd = of_faces(odd, odd.faces[3:])
    mixed = odd.faces.copy()
    mixed[:12] = np.roll(mixed[list(order)], turn, axis=1)
    assert counted(of_faces(odd, mixed)) == counted(odd)


def volume(a, b, c, d) -> Fraction:
    """Return six times the signed volume of a tetrahedron, exactly."""
    u, v, w = ([Fraction(int(x) - int(y)) for x, y in zip(p, a, strict=True)] for p in (b, c, d))
    return (
        u[0] * (v[1] * w[2] - v[2] * w[1])
        - u[1] * (v[0] * w[2] - v[2] * w[0])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
    )


def pierces(edges, face) -> bool:
    """Whether an edge of one triangle goes through the inside of another, by exact signs."""
    a, b, c = face
    for p, q in combinations(edges, 2):
        around = [volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)]
        same = all(x > 0 for x in around) or all(x < 0 for x in around)
        if volume(a, b, c, p) * volume(a, b, c, q) < 0 and same:
            return True
    return False


@given(st.lists(st.tuples(*[st.integers(0, 7)] * 9), min_size=2, max_size=14))
def test_crossings_are_those_of_an_exact_oracle(rows):
    faces = np.array(rows).reshape(-1, 3, 3)
    expected = {
        (i, j)
        for i, j in combinations(range(len(faces)), 2)
        if pierces(faces[i], faces[j]) or pierces(faces[j], faces[i])
    }
    found = crossings(faces / 8.0 - 0.5, 1000)
    assert {tuple(sorted(pair)) for pair in found.tolist()} == expected
    assert len(crossings(faces / 8.0 - 0.5, 2)) == min(len(expected), 2)


URDF = """<robot name="box">
<link name="base"><visual><geometry><box size="1 1 0.5"/></geometry></visual></link>
<link name="lid"><visual><origin xyz="{away} 0 0.06"/>
<geometry><box size="1 1 0.1"/></geometry></visual></link>
<joint name="hinge" type="{kind}"><parent link="base"/><child link="lid"/>
<origin xyz="-0.5 0 0.26"/><axis xyz="{axis}"/>{limit}</joint></robot>"""
LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'
OPENS = LIMIT.format(-1.5, 0)


def of_urdf(folder: Path, *, limit=OPENS, kind="revolute", axis="0 1 0", away=0.5) -> Checked:
    (folder / "box.urdf").write_text(URDF.format(limit=limit, kind=kind, axis=axis, away=away))
    (model,) = ag.check(folder / "box.urdf", jobs=0).models
    return model


def test_a_box_whose_lid_opens_is_sound(tmp_path):
    model = of_urdf(tmp_path)
    assert model.verdict == "sound", model.findings
    assert [part.name for part in model.parts] == ["base", "lid"]
    assert model.volume == pytest.approx(0.6)
    (joint,) = model.joints
    assert (joint.lower, joint.upper, joint.colliding, joint.axis_length) == (-1.5, 0.0, 0.0, 1.0)
    assert joint.pivot_distance < 0.02


def test_an_axis_through_the_middle_of_a_face_is_on_its_part(tmp_path):
    """A lid that turns like a tray: all its corners are far from the axis."""
    of_urdf(tmp_path, axis="0 0 1", away=0.0)
    text = (tmp_path / "box.urdf").read_text().replace("-0.5 0 0.26", "0 0 0.26")
    (tmp_path / "box.urdf").write_text(text)
    (model,) = ag.check(tmp_path / "box.urdf", jobs=0).models
    assert model.joints[0].pivot_distance < 0.03
    assert "pivot" not in kinds(model)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"limit": LIMIT.format(-1.5, 1.5)}, "collides"),
        ({"axis": "0 2 0"}, "axis"),
        ({"limit": ""}, "limits"),
        ({"limit": LIMIT.format(0, 0)}, "limits"),
        ({"limit": LIMIT.format(-1.5, -0.5)}, "rest"),
        ({"away": 1.2, "limit": LIMIT.format(-0.1, 0)}, "pivot"),
        ({"kind": "prismatic", "axis": "0 0 1", "limit": LIMIT.format(-0.2, 0)}, "collides"),
    ],
)
def test_what_is_amiss_with_a_joint_is_found(tmp_path, change, kind):
    model = of_urdf(tmp_path, **change)
    assert kind in kinds(model)
    assert {finding.text.split()[0] for finding in model.findings} == {"hinge"}


def test_a_lid_hits_its_base_in_half_of_a_range_that_lies_half_in_it(tmp_path):
    (joint,) = of_urdf(tmp_path, limit=LIMIT.format(-1.5, 1.5)).joints
    assert joint.colliding == 0.5
    assert set(joint.between) == {"base", "lid"}
    assert joint.depth > 0.05
    free = of_urdf(tmp_path, kind="continuous", limit="")
    assert "limits" not in kinds(free)


@pytest.mark.parametrize(("reach", "found"), [(1.0, ["together"]), (0.5, []), (1.5, ["collides"])])
def test_blocks_that_meet_only_if_both_slide_are_found(tmp_path, reach, found):
    block = '<visual><geometry><box size="1 1 1"/></geometry></visual></link>'
    slide = """<joint name="{0}" type="prismatic"><parent link="floor"/><child link="{0}"/>
        <origin xyz="{1} 0 0.8"/><axis xyz="{2} 0 0"/>{3}</joint>"""
    limit = LIMIT.format(0, reach)
    (tmp_path / "two.urdf").write_text(
        '<robot name="two"><link name="floor"><visual><geometry><box size="4 1 0.1"/></geometry>'
        f'</visual></link><link name="a">{block}<link name="b">{block}'
        f"{slide.format('a', -1.1, 1, limit)}{slide.format('b', 1.1, -1, limit)}</robot>"
    )
    (model,) = ag.check(tmp_path / "two.urdf", jobs=0).models
    assert kinds(model) == found
    assert (model.together > 0.02) == (found == ["together"])


def test_folders_hold_models_or_meshes_and_what_is_hostile_gets_a_line(tmp_path):
    CUBE.export(tmp_path / "a.stl")
    (tmp_path / "b").mkdir()
    two_sided(CUBE).export(tmp_path / "b" / "c.obj")
    (tmp_path / "d.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9")
    (tmp_path / "e.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "f.obj").write_text("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n")
    checks = ag.check(tmp_path, jobs=1)
    assert [model.name for model in checks.models] == [
        "a.stl", "c.obj", "d.ply", "e.obj", "f.obj",
    ]  # fmt: skip
    words = [model.verdict for model in checks.models]
    assert words == ["sound", "findings", *["unreadable"] * 3]
    assert "no extent" in (checks.models[-1].problem or "")
    of_urdf(tmp_path)
    assert [model.name for model in ag.check(tmp_path, jobs=0).models] == ["box"]
    (tmp_path / "none").mkdir()
    with pytest.raises(InvalidSource):
        ag.check(tmp_path / "none")


def test_the_command_writes_numbers_and_a_page_and_its_exit_status_is_the_verdict(tmp_path):
    models = tmp_path / "models"
    models.mkdir()
    CUBE.export(models / "<i>.ply")
    two_sided(CUBE).export(models / "b.ply")
    numbers, page = tmp_path / "checks.json", tmp_path / "checks.html"
    done = run("check", models, "--json", numbers, "--html", page, "--jobs", 1)
    assert done.exit_code == 3, done.output
    assert "two-sided" in done.output
    assert "2 models: 1 sound, 1 findings, 1 two-sided" in done.output
    written = json.loads(numbers.read_text())["models"]
    assert [model["verdict"] for model in written] == ["sound", "findings"]
    assert written[1]["findings"] == [{"kind": "two-sided", "text": "b 100%"}]
    assert written[0]["parts"][0]["volume"] == pytest.approx(0.125)
    text = page.read_text()
    assert "data:image/webp" in text
    assert "<i>" not in text
    assert FINDINGS["two-sided"] in text
    (models / "b.ply").write_text("ply")
    for path, status in ((models / "<i>.ply", 0), (models / "b.ply", 1)):
        assert run("check", path, "--jobs", 1).exit_code == status
    refused = run("check", models, "--html", tmp_path / "checks.txt")
    assert refused.exit_code == 1
    assert not (tmp_path / "checks.txt").exists()
