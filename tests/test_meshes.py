"""Mesh readers against trimesh and closed forms; files that lie against their refusal."""

import json
import re
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from real_models import REAL_MODELS, needs_real_models

from articugen.core.errors import InvalidSource
from articugen.core.records import Mesh
from articugen.meshes import read, scenes
from articugen.meshes.model_files import ModelFiles
from articugen.meshes.read import (
    PRIMITIVE_FACES,
    NoMesh,
    box,
    capsule,
    cylinder,
    fans,
    read_mesh,
    scaled,
    sphere,
)
from tests.procedural_truth import is_closed

SQUARE_OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def triangles(mesh: Mesh) -> np.ndarray:
    """(F, 9) corners; each triangle starts at its smallest corner and the rows are sorted."""
    corners = mesh.vertices[mesh.faces].round(9)
    rows = [min(np.roll(t, -k, axis=0).ravel().tolist() for k in range(3)) for t in corners]
    return np.array(sorted(rows))


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def scene_with_nodes() -> trimesh.Scene:
    """A unit tetrahedron: turned and moved by two nested nodes, and mirrored and stretched."""
    tetrahedron = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        process=False,
    )
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])
    scene.graph.update(
        "outer", "world", matrix=trimesh.transformations.translation_matrix([5, 0, 0])
    )
    scene.graph.update("inner", "outer", matrix=turn, geometry="t")
    scene.graph.update("mirror", "world", matrix=np.diag([-2.0, 1.0, 3.0, 1.0]), geometry="t")
    scene.geometry["t"] = tetrahedron
    return scene


def test_obj_in_every_odd_form(tmp_path):
    text = "\ufeffv 0 0 0 1.0\r\n  v\t1 0 0 0.5 0.5 0.5\nv 1 \\\n 1 0\n\nv 0 1 0\n"
    text += "l 1 2\np 1\ns off\nf 1 2 3 4 # a quad\nf 1 1 2\nf 1 2\nf -4/1 -3/2 -2/3\n"
    mesh = read_mesh(write(tmp_path / "m.obj", text))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


@pytest.mark.parametrize(
    ("faces", "problem"),
    [
        ("f 1 2 5\n", "names a vertex that is not there"),
        ("f 0 1 2\n", "names a vertex that is not there"),
        ("f -5 1 2\n", "names a vertex that is not there"),
        ("f a b c\n", "'f a b c' is not OBJ"),
        ("v 1 2\nf 1 2 3\n", "'v 1 2' is not OBJ"),
        ("v nan 0 0\nf 1 2 3\n", "not finite"),
        ("v inf 0 0\nf 1 2 3\n", "not finite"),
        ("v 1e10 0 0\nf 1 2 3\n", "not finite, or beyond"),
        ("f 1 2 99999999999999999999\n", "'f 1 2 99999999999999999999' is not OBJ"),
        ("v\nf 1 2 3\n", "'v' is not OBJ"),
    ],
)
def test_broken_obj_is_refused(tmp_path, faces, problem):
    with pytest.raises(InvalidSource, match=problem) as caught:
        read_mesh(write(tmp_path / "m.obj", SQUARE_OBJ + faces))
    assert str(tmp_path / "m.obj") in str(caught.value)


_ODD = b"v 0.5 -1e-3 3\nvt 1 2\nv 1.25e2 +.5 5.\nv -0 1234567890123456789 0.12345678901234567 9\n" \
    b"f 1/2/3 2//3 3\n f -1 -2 1 # hi\nf 1 2 3\n\tv 1 2 3\no vf\n"  # fmt: skip


def read_line_by_line(data: bytes) -> tuple[list[float], list[list[int]]]:
    """The coordinates, and the triangles by the first of their corners, as the format has them."""
    coordinates: list[float] = []
    triangles: list[list[int]] = []
    text = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").replace(b"\r", b"\n")
    for line in text.split(b"\n"):
        words = line.split()
        if re.match(rb"[ \t\v\f]*v(\s|$)", line):
            x, y, z = words[1:4]
            coordinates += map(float, (x, y, z))
        elif re.match(rb"[ \t\v\f]*f(\s|$)", line):
            corners = [int(w.split(b"/")[0]) for w in line.split(b"#")[0].split()[1:]]
            known = len(coordinates) // 3
            corners = [i - 1 if i > 0 else known + i if i else -1 for i in corners]
            triangles += [[corners[0], *pair] for pair in pairwise(corners[1:])]
    return coordinates, triangles


@settings(deadline=None, max_examples=300)
@given(
    st.lists(
        st.tuples(
            st.integers(0, len(_ODD) - 1),
            st.sampled_from(b"vf 0123456789.-+e/#\n\t\x0b\x0c\r\\_xn"),
            st.booleans(),
        ),
        max_size=3,
    )
)
def test_an_obj_is_read_as_a_loop_over_its_lines_reads_it(edits):
    text = bytearray(_ODD)
    for at, byte, insert in edits:
        text[at : at + (not insert)] = bytes([byte])
    try:
        coordinates, triangles = read_line_by_line(bytes(text))
    except ValueError:
        with pytest.raises(InvalidSource, match=r"the line '.+' is not OBJ"):
            read._read_obj(bytes(text), Path("m.obj"), None)  # type: ignore[arg-type]
        return
    vertices, faces, _ = read._read_obj(bytes(text), Path("m.obj"), None)  # type: ignore[arg-type]
    assert vertices.tobytes() == np.array(coordinates).tobytes()
    assert faces.tolist() == triangles


def test_coordinates_of_objs_are_the_nearest_doubles():
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(2000, 3)) * 10.0 ** rng.integers(-12, 6, (2000, 1))
    forms = ("%r %r %r", "%.7f %.9g %.3e")
    for form in forms:
        lines = [form % tuple(row) for row in numbers.tolist()]
        text = "".join(f"v {line}\n" for line in lines).encode()
        vertices, *_ = read._read_obj(text, Path("m.obj"), None)  # type: ignore[arg-type]
        assert vertices.tolist() == [[float(word) for word in line.split()] for line in lines]


@pytest.mark.parametrize("text", ["", SQUARE_OBJ, SQUARE_OBJ + "l 1 2\nf 1 1 2\n"])
def test_mesh_without_triangles_is_refused(tmp_path, text):
    with pytest.raises(NoMesh, match="no triangle"):
        read_mesh(write(tmp_path / "m.obj", text))


@given(st.lists(st.integers(0, 6), min_size=1, max_size=8))
def test_fans_equal_the_naive_loop(counts):
    corners = np.arange(100, 100 + sum(counts))
    naive, start = [], 0
    for count in counts:
        polygon = corners[start : start + count]
        naive += [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, count - 1)]
        start += count
    assert fans(corners, np.array(counts)).tolist() == naive


@pytest.mark.parametrize("suffix", ["stl", "ply", "glb", "gltf", "dae", "obj", "ascii.stl"])
def test_every_format_gives_the_same_box(tmp_path, suffix):
    wanted = box((1.0, 2.0, 4.0))
    source = trimesh.Trimesh(wanted.vertices, wanted.faces, process=False)
    path = tmp_path / f"box.{suffix}"
    if suffix == "gltf":
        for name, content in source.export(file_type="gltf").items():
            write(tmp_path / name, content)
        path = tmp_path / "model.gltf"
    else:
        kind = "stl_ascii" if suffix == "ascii.stl" else suffix
        write(path, source.export(file_type=kind))
    files, hashed = ModelFiles(tmp_path), ModelFiles(tmp_path)
    np.testing.assert_allclose(triangles(read_mesh(path, files)), triangles(wanted), atol=1e-6)
    with read.wanting("hash"):
        read_mesh(path, hashed)
    assert hashed.sha256() == files.sha256()  # of all files that count, a glTF's buffers too


@pytest.mark.parametrize("suffix", ["glb", "dae"])
def test_nodes_of_a_scene_are_baked_in(tmp_path, suffix):
    if suffix == "dae":
        flat = scene_with_nodes().to_mesh()
        mesh = read_mesh(write(tmp_path / "s.dae", flat.export(file_type="dae")))
    else:
        mesh = read_mesh(write(tmp_path / "s.glb", scene_with_nodes().export(file_type="glb")))
    corners = mesh.vertices[np.unique(mesh.faces)]
    np.testing.assert_allclose(corners.min(axis=0), [-2, 0, 0], atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0), [5, 1, 3], atol=1e-6)
    assert solid(mesh).volume == pytest.approx(
        1 / 6 + 6 / 6
    )  # both outside out, the mirrored one too


def test_stl_that_lies_is_refused(tmp_path):
    good = trimesh.creation.box().export(file_type="stl")
    for bad in (
        good[:80] + struct.pack("<I", 4_000_000_000) + good[84:],
        good[:-10],
        good + b"more",
        b"\0" * 50,
        b"\0" * 34,
        b"",
        b"solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nendloop\nendfacet\n",
        b"solid\nouter loop\nvertex 0 0 x\nvertex 1 0 0\nvertex 1 1 0\nendloop\nendfacet\n",
    ):
        with pytest.raises(InvalidSource, match="export it again"):
            read_mesh(write(tmp_path / "m.stl", bad))
    for short in (b"", b"\0" * 15, b"\1" * 40):
        with pytest.raises(InvalidSource, match="does not fit its header; export it again"):
            read_mesh(write(tmp_path / "m.msh", short))
    nan = bytearray(good)
    signalling = b"\1\0\x80\x7f"  # numpy warns of such a one
    for number in (struct.pack("<f", np.nan), signalling):
        nan[96:100] = number
        with pytest.raises(InvalidSource, match="not finite"):
            read_mesh(write(tmp_path / "m.stl", bytes(nan)))


def test_stl_of_text_is_read_in_capitals_too(tmp_path):
    plain = trimesh.creation.box().export(file_type="stl_ascii").encode()
    first, second = (read_mesh(write(tmp_path / "m.stl", s)) for s in (plain, plain.upper()))
    assert np.array_equal(first.vertices[first.faces], second.vertices[second.faces])


def test_ply_that_lies_is_refused(tmp_path):
    good = trimesh.creation.box().export(file_type="ply", encoding="ascii")
    assert len(read_mesh(write(tmp_path / "m.ply", good)).faces) == 12
    for bad in (
        good.replace(b"vertex 8", b"vertex 800000000"),
        good.replace(b"face 12", b"face 400000000"),
        good.replace(b"face 12", b"face 13"),
        good[:-9],
        good[10:],
    ):
        assert bad != good
        with pytest.raises(InvalidSource, match=r"m\.ply"):
            read_mesh(write(tmp_path / "m.ply", bad))


def test_dae_unit_is_applied_and_doctype_refused(tmp_path):
    good = trimesh.creation.box().export(file_type="dae")
    in_centimetres = good.replace(b"<asset>", b'<asset><unit name="cm" meter="0.01"/>')
    assert in_centimetres != good
    mesh = read_mesh(write(tmp_path / "m.dae", in_centimetres))
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), 0.01)
    root = good.index(b"<COLLADA")
    with pytest.raises(InvalidSource, match="DOCTYPE"):
        read_mesh(write(tmp_path / "m.dae", good[:root] + b"<!DOCTYPE COLLADA>" + good[root:]))


def test_a_dae_s_polygons_with_holes_are_refused_not_dropped(tmp_path):
    good = trimesh.creation.box().export(file_type="dae")
    pierced = good.replace(b"</mesh>", b"<polygons><ph><p>0 1 2</p><h>3</h></ph></polygons></mesh>")
    with pytest.raises(InvalidSource, match="has polygons with holes, which are not read"):
        read_mesh(write(tmp_path / "m.dae", pierced))


@pytest.mark.parametrize("word", ["lookat", "skew"])
def test_a_dae_s_shapes_that_lookat_or_skew_would_place_are_refused(tmp_path, word):
    good = trimesh.creation.box().export(file_type="dae")
    placed = good.replace(b"<instance_geometry", f"<{word}/><instance_geometry".encode())
    with pytest.raises(InvalidSource, match=f"has shapes placed by <{word}>, which are not read"):
        read_mesh(write(tmp_path / "m.dae", placed))


def edited_glb(edit) -> bytes:
    """The GLB of a box with its JSON changed by `edit(document)`."""
    good = trimesh.creation.box().export(file_type="glb")
    length = struct.unpack_from("<I", good, 12)[0]
    document = json.loads(good[20 : 20 + length])
    edit(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = good[20 + length :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


def position_in(document) -> int:
    return document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (lambda d: d.update(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}]), "loop"),
        (lambda d: d.update(nodes=[{"children": [2]}, {"children": [2]}, {"mesh": 0}]), "tree"),
        (lambda d: [accessor.update(count=2**31) for accessor in d["accessors"]], "too many"),
        (lambda d: [a.pop("bufferView") for a in d["accessors"]], "compressed or sparse"),
        (lambda d: d["accessors"][position_in(d)].update(componentType=5123), "quantised"),
        (lambda d: d["bufferViews"][-1].update(byteLength=10**5), "export it again"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-4), "negative"),
        (lambda d: d["meshes"][0]["primitives"][0].update(mode=6), "fans"),
        (lambda d: d["nodes"][-1].update(skin=0), "skinned"),
        (lambda d: d["meshes"][0].update(weights=[0.0, 0.5]), "morphed"),
        (lambda d: d["nodes"][-1].update(extensions={"EXT_mesh_gpu_instancing": {}}), "instanced"),
        (lambda d: d["buffers"][0].update(uri="../outside.bin"), "leads out of"),
        (lambda d: d.pop("accessors"), "not a glTF document"),
        (lambda d: d.pop("scenes"), "has no scene, which would say what is shown; export it"),
    ],
)
def test_glb_that_lies_is_refused(tmp_path, edit, problem):
    with pytest.raises(InvalidSource, match=problem):
        read_mesh(write(tmp_path / "m.glb", edited_glb(edit)))


def test_glb_header_must_fit(tmp_path):
    good = edited_glb(lambda document: None)
    assert len(read_mesh(write(tmp_path / "m.glb", good)).faces) == 12
    for bad in (good[:-4], good + b"more", b"GLTF" + good[4:], good[:10], good[:16] + good):
        with pytest.raises(InvalidSource, match="header"):
            read_mesh(write(tmp_path / "m.glb", bad))


def test_gltf_buffers_stay_in_the_folder_and_count_in_the_hash(tmp_path):
    for name, content in trimesh.creation.box().export(file_type="gltf").items():
        write(tmp_path / name, content)
    path = tmp_path / "model.gltf"
    buffer = next(tmp_path.glob("*.bin"))
    files = ModelFiles(tmp_path)
    read_mesh(path, files)
    before = files.sha256()
    buffer.write_bytes(buffer.read_bytes()[:-4] + b"\0\0\0\0")
    files = ModelFiles(tmp_path)
    files.read(path), files.read(buffer)
    assert files.sha256() != before
    buffer.unlink()
    with pytest.raises(InvalidSource, match=r"buffer .* is missing"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("uri", "problem"),
    [
        (5, "the uri of a buffer is 5, not a text"),
        (None, "the uri of a buffer is None, not a text"),
        ("%00", "is no name of a file"),
        ("\ud800", "is no name of a file"),
        ("a" * 300, "has a name of more than 255 bytes"),
        ("../secret.bin", "leads out of"),
        ("/etc/passwd", "leads out of"),
    ],
)
def test_a_gltf_buffer_of_a_strange_name_is_refused(tmp_path, uri, problem):
    path = write(tmp_path / "m.gltf", json.dumps({"buffers": [{"uri": uri}]}))
    with pytest.raises(InvalidSource, match=problem) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_unknown_format_names_the_known_ones(tmp_path):
    with pytest.raises(InvalidSource, match=r"convert it to one of \.obj, \.stl"):
        read_mesh(write(tmp_path / "m.3ds", b""))


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` with bits flipped, cut off, a piece moved, or a strange value put in."""
    i, j = sorted(int(k) for k in rng.integers(len(data), size=2))
    strange = [b"999999999", b"nan", b"-1", b'"', b"\0", b"1e999", b"<", b"[]"]
    return [
        data[:i] + bytes([data[i] ^ (1 << int(rng.integers(8)))]) + data[i + 1 :],
        data[:i],
        data[:i] + data[j:],
        data[:j] + data[i:],
        data[:i] + strange[int(rng.integers(len(strange)))] + data[i + 1 :],
    ][int(rng.integers(5))]


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "dae", "glb"])
def test_a_damaged_file_is_read_or_refused_and_nothing_else(tmp_path, suffix):
    rng = np.random.default_rng(0)
    good = trimesh.creation.box().export(file_type=suffix)
    good = good.encode() if isinstance(good, str) else good
    refused = 0
    for _ in range(200):
        try:
            mesh = read_mesh(write(tmp_path / f"m.{suffix}", damaged(good, rng)))
        except InvalidSource:
            refused += 1
        else:
            assert len(mesh.faces) > 0
            assert mesh.faces.max() < len(mesh.vertices)
            assert np.isfinite(mesh.vertices).all()
    assert 50 < refused < 200


def test_too_many_triangles_are_refused_before_any_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(scenes, "MAX_FACES", 10)
    for suffix in ("obj", "stl", "ply", "dae", "glb"):
        path = write(tmp_path / f"m.{suffix}", trimesh.creation.box().export(file_type=suffix))
        with pytest.raises(InvalidSource, match=r"more than 10 triangles .*; simplify it"):
            read_mesh(path)
    ascii_stl = trimesh.creation.box().export(file_type="stl_ascii")
    with pytest.raises(InvalidSource, match="more than 10 triangles"):
        read_mesh(write(tmp_path / "m.stl", ascii_stl))
    with pytest.raises(InvalidSource, match="more than 10 triangles"):
        read_mesh(write(tmp_path / "m.obj", SQUARE_OBJ + " f" + " 1 2 3 4" * 5))


def test_comments_and_long_lines_of_an_obj_cost_nothing(tmp_path):
    text = "#\n" * 1_000_000 + SQUARE_OBJ + "f 1 2 3\n"
    assert len(read_mesh(write(tmp_path / "m.obj", text)).faces) == 1
    with pytest.raises(InvalidSource, match=r"a line has 1,2.* bytes"):
        read_mesh(write(tmp_path / "m.obj", SQUARE_OBJ + "f" + " 1" * 600_000))


def test_a_dae_s_polygon_of_countless_corners_is_refused_before_room_is_made(tmp_path):
    """pycollada would set 16 GiB aside for a number."""
    good = trimesh.creation.box().export(file_type="dae").decode()
    for counts, problem in (("2147483647", "more than 1,000,000"), ("3 many", "not a number")):
        polygon = f"<polylist count='1'><vcount>{counts}</vcount><p>0 1 2</p></polylist></mesh>"
        with pytest.raises(InvalidSource, match=problem):
            read_mesh(write(tmp_path / "m.dae", good.replace("</mesh>", polygon)))


def test_nodes_of_a_dae_that_double_are_counted_not_built(tmp_path):
    """Thirty nodes, each with the next one twice: a thousand million boxes."""
    good = trimesh.creation.box().export(file_type="dae").decode()
    start, end = good.index("<node "), good.index("</visual_scene>")
    start = good.index("<instance_geometry", start)
    geometry = good[start : good.index("</instance_geometry>", start)] + "</instance_geometry>"
    twice = "".join(
        f'<node id="n{i}">' + f'<instance_node url="#n{i + 1}"/>' * 2 + "</node>" for i in range(30)
    )
    library = f'<library_nodes>{twice}<node id="n30">{geometry}</node></library_nodes>'
    scene_start = good.index("<visual_scene")
    inside = good.index(">", scene_start) + 1
    before = good.index("<library_visual_scenes")
    bomb = good[:before] + library + good[before:inside] + '<node><instance_node url="#n0"/></node>'
    with pytest.raises(InvalidSource, match="more than 1,000,000 triangles"):
        read_mesh(write(tmp_path / "m.dae", bomb + good[end:]))
    chain = "".join(f'<node id="n{i}"><instance_node url="#n{i + 1}"/></node>' for i in range(5000))
    deep = bomb.replace(twice, chain + '<node id="n5000"/>')
    with pytest.raises(InvalidSource, match="nested more than 100 deep"):
        read_mesh(write(tmp_path / "m.dae", deep + good[end:]))
    loop = bomb.replace('<instance_node url="#n2"/>', '<instance_node url="#n1"/>')
    with pytest.raises(InvalidSource, match="node 'n1' holds itself"):
        read_mesh(write(tmp_path / "m.dae", loop + good[end:]))


def test_a_dae_with_textures_that_are_not_there_says_nothing(tmp_path, capfd, caplog):
    good = trimesh.creation.box().export(file_type="dae").decode()
    image = (
        '<newparam sid="f"><surface type="2D"><init_from>i</init_from></surface></newparam>'
        '<newparam sid="s"><sampler2D><source>f</source></sampler2D></newparam>'
    )
    images = '<library_images><image id="i"><init_from>no.png</init_from></image></library_images>'
    text = good.replace("<library_effects>", f"{images}<library_effects>")
    text = text.replace("<technique sid", f"{image}<technique sid")
    looks = '<emission><texture texture="s" texcoord="u"/></emission>'
    text = text.replace("<phong>", f"<phong>{looks}").replace("<lambert>", f"<lambert>{looks}")
    assert looks in text
    mesh = read_mesh(write(tmp_path / "m.dae", text))
    plain = read_mesh(write(tmp_path / "g.dae", good))
    np.testing.assert_array_equal(mesh.vertices, plain.vertices)
    assert len(mesh.faces) == 12
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def test_primitives_are_closed_with_the_right_volume_and_area():
    known = {
        "box": (box((1, 2, 3)), 6, 22, 1e-9),
        "cylinder": (cylinder(0.5, 2.0), np.pi * 0.5, 2.5 * np.pi, 2e-3),
        "sphere": (sphere(0.5), np.pi / 6, np.pi, 5e-3),
        "capsule": (capsule(0.5, 2.0), np.pi * (0.5 + 1 / 6), 3 * np.pi, 3e-3),
    }
    for name, (mesh, volume, area, off) in known.items():
        assert solid(mesh).volume == pytest.approx(volume, rel=off)
        assert solid(mesh).area == pytest.approx(area, rel=off)
        assert is_closed(mesh.faces)
        assert len(mesh.faces) == PRIMITIVE_FACES[name]
    assert known.keys() == PRIMITIVE_FACES.keys()
    np.testing.assert_allclose(np.linalg.norm(sphere(0.5).vertices, axis=1), 0.5)
    np.testing.assert_allclose(np.abs(cylinder(0.5, 2.0).vertices[:, 2]), 1.0)


@given(st.tuples(*[st.sampled_from([-2.0, -1.0, 0.5, 3.0])] * 3))
def test_scaling_keeps_the_outside_outside(scale):
    assert solid(scaled(box((1, 1, 1)), scale)).volume == pytest.approx(abs(np.prod(scale)))


@needs_real_models
def test_every_real_obj_agrees_with_trimesh():
    paths = sorted(REAL_MODELS.rglob("*.obj"))[::5]
    assert len(paths) > 100
    for path in paths:
        mine = read_mesh(path)
        theirs = trimesh.load(path, process=False, force="mesh", skip_materials=True)
        whole = theirs.faces[[len({*face}) == 3 for face in theirs.faces.tolist()]]
        assert mine.faces.shape == whole.shape, path  # a face that repeats a vertex is none
        corners = (mine.vertices[mine.faces], theirs.vertices[whole])
        a, b = (np.sort(c.reshape(-1, 3), axis=0) for c in corners)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12, err_msg=str(path))
