"""The viewer: what it shows beside what the generator stores, what it draws and says of it."""

import shutil
import socket
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from command_line import run
from instances import SMALL, assert_same, hinged_box
from ppd_data import shard
from test_html_report import HOSTILE, STATES, named
from test_maker import CABINET, TINY

import articugen as ag
from articugen.core.colours import PALETTE
from articugen.core.errors import (
    ArticugenError,
    CorruptShard,
    InvalidArgument,
    InvalidSource,
    NotOfCategory,
    installing,
)
from articugen.core.geometry import apply, look_along, rotation_about
from articugen.core.records import ENCLOSED, FREE, JointKind, dequantize
from articugen.core.schema import Instance
from articugen.inspection.viewer import layers, words
from articugen.inspection.viewer.layers import Lines, Points
from articugen.inspection.viewer.panel import MESHES, Wish
from articugen.inspection.viewer.serve import served
from articugen.inspection.viewer.shown import Joint, Shown
from articugen.inspection.viewer.sources import source_of
from articugen.inspection.viewer.stage import FIELD_OF_VIEW, FILL, eye_of
from articugen.inspection.viewer.words import Scale
from articugen.pictures.portrait import swept
from articugen.store.shards import open_shard

STUCK = """<robot name="stuck">
  <link name="body"><visual><geometry><box size="1 1 1"/></geometry></visual></link>
</robot>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, and a data set made of it in <folder>/data/cabinet."""
    folder = tmp_path_factory.mktemp("cabinets")
    (folder / "urdfs").mkdir()
    (folder / "urdfs" / "cabinet.urdf").write_text(CABINET)
    ag.generate("cabinet", folder / "urdfs", folder / "data", TINY, seed=3, jobs=0)
    return folder


@pytest.fixture(scope="module")
def shown(folder: Path) -> Shown:
    return source_of(str(folder / "data" / "cabinet")).shown("cabinet")


def stored(folder: Path) -> list[Instance]:
    (path,) = (folder / "data" / "cabinet").glob("*.h5")
    with open_shard(path) as opened:
        return [opened.instance(row) for row in range(len(opened))]


def test_a_stored_state_is_the_generators_to_the_byte(folder: Path, shown: Shown) -> None:
    assert shown.maker is not None
    model = source_of(str(folder / "urdfs" / "cabinet.urdf"), category="cabinet", seed=3)
    for state, instance in enumerate(stored(folder)):
        seen = shown.at(shown.states[state])
        assert (seen.state, seen.asked) == (state, True)
        assert_same(seen.instance, instance)
        assert_same(shown.maker[state].instance, instance)
    assert model.objects == ["cabinet"]


def test_a_model_is_shown_as_a_data_set_would_hold_it(folder: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "tiny.yaml"
    recipe.write_text(str(TINY).replace("'", '"'))  # JSON, which YAML contains
    urdf = str(folder / "urdfs" / "cabinet.urdf")
    model = source_of(urdf, category="cabinet", recipe=str(recipe), seed=3).shown("cabinet")
    for state, instance in enumerate(stored(folder)):
        assert_same(model.at(model.states[state]).instance, instance)


def test_between_states_it_is_fused_anew_with_the_same_recipe(folder: Path, shown: Shown) -> None:
    assert shown.maker is not None
    door, _, slide = shown.joints
    q = np.array([0.7, 0.0, 0.11])
    seen = shown.at(q)
    assert (seen.state, seen.asked, seen.instance.state_index) == (None, True, len(shown.states))
    np.testing.assert_allclose(seen.q, [0.7, 0.35, 0.11])  # the latch follows the door
    np.testing.assert_allclose(
        seen.instance.part_motion[1][:3, :3], rotation_about([0, 0, 1], 0.7), atol=1e-9
    )
    assert seen.instance.part_motion[3][0, 3] == pytest.approx(0.11 / seen.instance.scale)
    # the same field that states are stored with: at one of theirs it gives their labels
    again = shown.maker.at(door=shown.states[1][0], slide=shown.states[1][2]).instance
    fixed = ("joint_state", "joint_pivot", "part_motion", "center", "scale", "occupancy_8")
    assert_same(again, stored(folder)[1], *fixed)
    assert (door.kind, slide.kind) == (JointKind.REVOLUTE, JointKind.PRISMATIC)
    assert [joint.follows for joint in shown.joints] == ["", "door", ""]


def test_part_meshes_enclose_the_parts(viser: Any, shown: Shown) -> None:
    body, leaf, latch, tray = shown.part_meshes
    for mesh, size in ((leaf, (0.02, 0.5, 0.4)), (tray, (0.3, 0.4, 0.02))):
        assert shown.maker is not None
        scale = shown.maker.prepared.unit.scale
        solid = trimesh.Trimesh(mesh.vertices * scale, mesh.faces)
        assert solid.is_watertight
        np.testing.assert_allclose(solid.extents, size, atol=1e-3)
    assert len(body.faces) > len(latch.faces) > 0


def test_without_its_source_the_nearest_state_is_shown(viser, folder, tmp_path):
    moved = Path(shutil.copytree(folder / "data" / "cabinet", tmp_path / "cabinet"))
    (path,) = moved.glob("*.h5")
    (moved / "manifest.json").unlink()
    alone = source_of(str(path)).shown("cabinet")
    assert "has no manifest.json that names the source" in alone.why
    seen = alone.at(alone.states[2] + [0.01, 0.0, -0.001])
    assert (seen.state, seen.asked) == (2, False)
    assert_same(seen.instance, stored(folder)[2])
    said = words.said_of(alone, seen, 0.0)
    assert "state 2, the nearest that is stored" in said
    assert "The sliders show the nearest state" in said
    grid = stored(folder)[0].occupancy[8]
    in_grid = [bool((grid == part + 1).any()) for part in range(4)]
    assert [len(mesh.faces) > 0 for mesh in alone.part_meshes] == in_grid


def test_where_it_would_stick_out_of_the_unit_frame_the_nearest_state_is_shown(tmp_path):
    (tmp_path / "cabinet.urdf").write_text(CABINET)
    few = {**TINY, "articulation": {**TINY.get("articulation", {}), "states": 0}}
    ag.generate("cabinet", tmp_path, tmp_path / "data", few, jobs=0)
    shut = source_of(str(tmp_path / "data" / "cabinet")).shown("cabinet")
    seen = shut.at(np.array([1.57, 0.0, 0.0]))
    assert (seen.state, seen.asked) == (0, False)
    said = words.said_of(shut, seen, 0.0)
    assert "sticks out of the unit frame" in said
    assert "raise padding or articulation.states in the recipe" in said
    assert shut.at(shut.states[0]).asked


def test_a_shard_beside_its_manifest_knows_its_source(folder: Path, shown: Shown) -> None:
    (path,) = (folder / "data" / "cabinet").glob("*.h5")
    one = source_of(str(path)).shown("cabinet")
    assert (one.why, one.joints) == ("", shown.joints)


def test_a_source_that_changed_is_not_taken_for_what_it_was(tmp_path: Path) -> None:
    (tmp_path / "cabinet.urdf").write_text(CABINET)
    ag.generate("cabinet", tmp_path, tmp_path / "data", TINY, jobs=0, states=0)
    (tmp_path / "cabinet.urdf").write_text(CABINET.replace("0.2 0 0.2", "0.2 0 0.3") + "\n")
    changed = source_of(str(tmp_path / "data" / "cabinet")).shown("cabinet")
    assert changed.maker is None
    assert "have changed since" in changed.why


@pytest.fixture(scope="module")
def box() -> Instance:
    return hinged_box()[2]


def only(drawn: list[Any], kind: type) -> Any:
    (found,) = [each for each in drawn if isinstance(each, kind)]
    return found


def test_voxels_are_points_in_their_middles() -> None:
    grid = np.zeros((4, 4, 4), np.uint8)
    grid[1, 2, 0] = 1
    grid[3, 3, 3] = ENCLOSED
    drawn = only(layers.voxels(replace(hinged_box()[0], occupancy={4: grid}), 4), Points)
    np.testing.assert_allclose(drawn.points, [[-0.125, 0.125, -0.375], [0.375, 0.375, 0.375]])
    np.testing.assert_array_equal(drawn.colours, layers.LABEL_COLOURS[[1, ENCLOSED]])
    assert drawn.size == 0.25


def test_query_points_are_inside_or_outside(box: Instance) -> None:
    inside, outside = (only(layers.queries(box, inside=side), Points) for side in (True, False))
    label = np.concatenate([box.uniform_label, box.near_label])
    assert (len(inside.points), len(outside.points)) == ((label > 0).sum(), (label == FREE).sum())
    np.testing.assert_array_equal(inside.colours, PALETTE[label[label > 0] - 1])


def test_frusta_have_their_corners_at_the_corners_of_the_pictures(box: Instance) -> None:
    edges = only(layers.partial(box, 64), Lines).ends.reshape(-1, 8, 2, 3)
    assert len(edges) == len(box.partial_points)
    for mine, T, (fx, fy, cx, cy) in zip(
        edges, box.partial_T_camera_world, box.partial_intrinsics, strict=True
    ):
        rays = apply(T, mine[:4])
        np.testing.assert_allclose(rays[:, 0], 0.0, atol=1e-12)
        x, y, z = rays[:, 1].T
        pixels = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)
        np.testing.assert_allclose(pixels, [[0, 0], [64, 0], [64, 64], [0, 64]], atol=1e-9)


def test_axes_go_through_their_pivots(box: Instance) -> None:
    drawn = layers.joints(box)
    np.testing.assert_array_equal(only(drawn, Points).points, box.joint_pivot)
    hinge, slide = only(drawn, Lines).ends[:2]
    np.testing.assert_allclose(hinge.mean(axis=0), box.joint_pivot[0])
    np.testing.assert_allclose(slide[0], box.joint_pivot[1])
    for line, axis in zip((hinge, slide), box.joint_axis, strict=True):
        along = line[1] - line[0]
        np.testing.assert_allclose(along / np.linalg.norm(along), axis)


def test_surface_points_and_normals_are_the_stored_ones(box: Instance) -> None:
    points = only(layers.surface(box), Points).points
    np.testing.assert_array_equal(points, dequantize(box.surface_points))
    ends = only(layers.normals(box), Lines).ends
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    np.testing.assert_allclose(length, layers.NORMAL_LENGTH, rtol=0.02)


def test_all_that_joints_do_is_framed() -> None:
    shut, open_wide = hinged_box(((0.0, 0.0), (np.radians(100.0), 0.3)))
    points, part = dequantize(shut.surface_points), shut.surface_part
    everywhere = swept(shut)
    np.testing.assert_allclose(everywhere[: len(points)], points[np.argsort(part, kind="stable")])
    for k, T in enumerate(open_wide.part_motion):
        moved = apply(T, points[part == k])
        apart = np.abs(everywhere[-len(points) :, None] - moved[:1]).max(axis=2).min(axis=0)
        np.testing.assert_allclose(apart, 0.0, atol=1e-6)


@pytest.mark.parametrize(("aspect", "free"), [(1.6, 1.0), (0.4, 1.0), (0.46, 0.4)])
def test_what_is_framed_fills_the_free_part_of_the_window(aspect, free) -> None:
    points, toward = swept(hinged_box()[0]), np.array([0.6, 0.64, 0.48])
    eye = eye_of(points, toward, aspect, free)
    x, y, z = look_along(-toward)[:3, :3] @ (points - eye).T
    assert (z > 0.0).all()
    high = np.tan(FIELD_OF_VIEW / 2.0)
    right, up = x / z / high / aspect, (-y / z / high - (1.0 - free)) / free
    np.testing.assert_allclose([right.min(), up.min()], [-right.max(), -up.max()], atol=1e-6)
    assert max(right.max(), up.max()) == pytest.approx(FILL)


def test_an_object_opens_a_little_open() -> None:
    states = np.array([[0.0, 0.0], [1.57, 0.2], [0.5, -0.1], [0.6, 0.08]])
    joints = (
        Joint("door", JointKind.REVOLUTE, 0.0, 1.57),
        Joint("slide", JointKind.PRISMATIC, -0.3, 0.2),
    )
    shown = Shown("x", joints, states, lambda _: hinged_box()[0], image_size=8)
    assert shown.ajar == 2  # of the slide, the farther end is the negative one
    assert Shown("x", (), np.zeros((1, 0)), shown.read, image_size=8).ajar == 0


def test_without_a_grid_or_a_source_the_surface_is_shown(viser: Any, tmp_path: Path) -> None:
    recipe = SMALL.model_copy(update={"sampling": SMALL.sampling.model_copy(update={"grids": ()})})
    path = shard(tmp_path / "train-00000.h5", hinged_box(recipe=recipe))
    with served(source_of(str(path))) as there:
        assert there.session.wait(60)
        assert there.session.fault == ""
        (drawn,) = [d for d, _ in there.session._stage._layers[MESHES]]
        assert isinstance(drawn, Points)


def test_a_state_of_one_object_is_not_wished_for_of_the_next(viser: Any, tmp_path: Path) -> None:
    path = shard(tmp_path / "train-00000.h5", hinged_box())
    with served(source_of(str(path))) as there:
        assert there.session.wait(60)
        panel, first = there.session._panel, there.session.wish
        chosen = panel._to_state(first, words.state_of(1)).q
        assert chosen is not None
        np.testing.assert_allclose(chosen, [0.5, 0.1])
        other = Wish("other")  # its joints may be of another number
        assert panel._to_state(other, words.state_of(1)) is other


@pytest.mark.parametrize(
    ("kind", "lower", "upper", "label"),
    [
        (JointKind.REVOLUTE, 0.0, np.radians(110.0), "lid: 0 to 110°"),
        (JointKind.REVOLUTE, -np.pi, 0.0, "lid: -180 to 0°"),
        (JointKind.PRISMATIC, 0.0, 0.3109, "lid: 0 to 0.311"),
        (JointKind.PRISMATIC, 0.0, 0.002, "lid: 0 to 0.002"),
        (JointKind.PRISMATIC, 0.0, 0.0, "lid: 0 to 1e-06"),
    ],
)
def test_a_slider_reaches_its_joints_range_and_no_more(kind, lower, upper, label) -> None:
    joint = Joint("lid", kind, float(lower), float(upper))
    scale = Scale.of(joint)
    assert words.label_of(0, joint) == label
    assert scale.meant(joint, scale.lower) == pytest.approx(lower)
    assert scale.meant(joint, scale.upper) == pytest.approx(upper)
    for value in np.linspace(lower, upper, 13):
        step = scale.shown(joint, float(value))
        assert scale.lower <= step <= scale.upper
        assert scale.meant(joint, step) == pytest.approx(value, abs=0.51 * scale.step)
        assert scale.shown(joint, scale.meant(joint, step)) == step


def test_names_are_printable_short_and_no_two_alike() -> None:
    ids = ["a", "a\n", HOSTILE, "x" * 300, "x" * 301, "", "箱"]
    names = words.names_of(ids)
    assert list(names.values()) == ids
    assert all(name.isprintable() and 0 < len(name) < 40 for name in names)


def test_names_are_text_in_html() -> None:
    html = words.legend(named(hinged_box()[0]))
    assert "<script" not in html
    assert "<img" not in html
    assert "箱" in html


def test_what_cannot_be_shown_is_said_in_a_sentence(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "stuck.urdf").write_text(STUCK)
    (tmp_path / "broken.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    (whole,) = (folder / "data" / "cabinet").glob("*.h5")
    (tmp_path / "cut.h5").write_bytes(whole.read_bytes()[:-5000])
    with pytest.raises(InvalidSource, match="no such shard, folder, URDF or source"):
        source_of(str(tmp_path / "nowhere"))
    for of_models in ({"category": "box"}, {"recipe": "quick"}, {"seed": 3}):
        with pytest.raises(InvalidArgument, match="cabinet is a data set: no --category, --recipe"):
            source_of(str(folder / "data" / "cabinet"), **of_models)  # type: ignore[arg-type]
    with h5py.File(shard(tmp_path / "old.h5", hinged_box(STATES)), "r+") as file:
        file.attrs["schema_version"] = 99
    for name in ("broken.h5", "cut.h5", "old.h5: schema version 99, this articugen reads"):
        with pytest.raises(CorruptShard, match=name):
            source_of(str(tmp_path / name.partition(":")[0]))
    with pytest.raises(InvalidArgument, match="open one of: cabinet"):
        source_of(str(folder / "data"))
    with pytest.raises(NotOfCategory, match=r"^stuck: no joint moves"):
        source_of(str(tmp_path / "stuck.urdf")).shown("stuck")


def test_without_viser_one_learns_how_to_get_it(folder: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    done = run("view", folder / "data" / "cabinet")
    assert done.exit_code == 1
    assert f"viser is not installed; run: {installing('view')}\n" in done.stderr


def test_a_port_that_is_taken_is_said(viser: Any, folder: Path) -> None:
    source = source_of(str(folder / "data" / "cabinet"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(ArticugenError, match=rf"127.0.0.1:{port}: cannot listen there .*--port"),
            served(source, port=port),
        ):
            pass
    with (
        pytest.raises(ArticugenError, match=r"cannot listen there .*--host"),
        served(source, host="203.0.113.7"),
    ):
        pass


def test_a_model_that_cannot_move_ends_the_command(viser: Any, tmp_path: Path) -> None:
    (tmp_path / "stuck.urdf").write_text(STUCK)
    done = run("view", tmp_path / "stuck.urdf")
    assert done.exit_code == 1
    assert "no joint moves" in done.stderr
