"""Colours of glTF and COLLADA, face by face, of files that are written here by hand."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh
from few import FEW
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from test_colours import TEXELS, bomb, png
from test_export_colours import in_gltf

import articugen as ag
from articugen.core.colours import srgb, srgb_linear
from articugen.core.errors import InvalidSource
from articugen.meshes import looks, read
from articugen.meshes.model_files import ModelFiles
from articugen.meshes.read import box, read_mesh

CUBE = box((1.0, 1.0, 1.0))
TURNED = np.array([[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1.0]])
MIRRORED = np.diag([-1.0, 1.0, 1.0, 1.0])
RED, GREEN, BLUE = (255, 0, 0), (51, 153, 0), (3, 0, 254)
QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
MEANS = [[50, 50, 100], [100, 25, 50]]  # of TEXELS over the halves, times (1, 128 / 255, 1)


class Gltf:
    """A glTF document that grows; what lies in its buffer is a list of arrays."""

    def __init__(self):
        self.arrays = []
        self.document = {"asset": {"version": "2.0"}, "meshes": [], "accessors": [], "nodes": []}
        self.document |= {"materials": [], "scenes": [{"nodes": []}], "bufferViews": []}

    def view(self, data):
        start = sum(map(len, self.arrays))
        self.arrays.append(data + bytes(-len(data) % 4))
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": start, "byteLength": len(data)}
        )
        return len(self.arrays) - 1

    def array(self, array):
        kinds = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
        columns = array.reshape(len(array), -1).shape[1]
        self.document["accessors"].append({
            "bufferView": self.view(array.tobytes()), "count": len(array),
            "componentType": kinds[array.dtype.name],
            "type": f"VEC{columns}" if columns > 1 else "SCALAR",
        })  # fmt: skip
        return len(self.document["accessors"]) - 1

    def primitive(self, vertices, faces, **more):
        return {
            "attributes": {"POSITION": self.array(np.asarray(vertices, np.float32))},
            "indices": self.array(np.asarray(faces, np.uint32).ravel()),
            **more,
        }

    def glb(self):
        blob = b"".join(self.arrays)
        self.document["buffers"] = [{"byteLength": len(blob)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(blob), b"BIN\0") + blob
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def gltf(self):
        blob = b"".join(self.arrays)
        uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
        self.document["buffers"] = [{"byteLength": len(blob), "uri": uri}]
        return json.dumps(self.document).encode()


def material(*rgb):
    """As glTF has it, of an sRGB colour of bytes."""
    light = srgb_linear("#" + bytes(rgb).hex()).tolist()
    return {"pbrMetallicRoughness": {"baseColorFactor": [*light, 1.0]}}


def coloured(path):
    """Triangles, colours and notes; all but the colours is the same without them."""
    plain, files = read_mesh(path), ModelFiles(path.parent)
    with looks.with_looks(wanted=True) as reader:
        mesh = read_mesh(path, files)
    np.testing.assert_array_equal(mesh.vertices, plain.vertices)
    np.testing.assert_array_equal(mesh.faces, plain.faces)
    assert plain.colours is None
    hashed = ModelFiles(path.parent)
    with read.wanting("hash"), looks.with_looks(wanted=True):
        read_mesh(path, hashed)
    assert hashed.sha256() == files.sha256()
    return mesh.triangles, None if mesh.colours is None else mesh.colours.tolist(), reader.notes()


def sides(triangles):
    """Of each triangle of the two cubes the colour that its place and its outside tell."""
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    center = triangles.mean(axis=1)
    second = np.abs(center - [5.0, 0.0, 2.0]).max(axis=1) < 0.51
    assert second.sum() == 12
    outward = across * (center - np.where(second[:, None], [5.0, 0.0, 2.0], 0.0))
    np.testing.assert_allclose(outward.sum(axis=1), 0.5, atol=1e-6)
    red = (np.abs(across[:, 0]) > 0.5) | (across[:, 1] < -0.5)
    return [BLUE if s else RED if r else GREEN for s, r in zip(second, red, strict=True)]


def two_cubes():
    """One of two colours, with points, lines and a face that is dropped between; the other stands
    under two nodes, mirrored."""
    gltf = Gltf()
    gltf.document["materials"] = [material(*colour) for colour in (RED, GREEN, BLUE)]
    red = np.concatenate([CUBE.faces[:3], [[0, 0, 1]], CUBE.faces[3:6]])
    gltf.document["meshes"] = [
        {"name": "cube", "primitives": [
            gltf.primitive(CUBE.vertices, [[0, 1, 2]], material=1, mode=0),
            gltf.primitive(CUBE.vertices, red, material=0),
            gltf.primitive(CUBE.vertices, [[0, 1, 2]], material=2, mode=2),
            gltf.primitive(CUBE.vertices, [[0, 1, 2]], material=2, mode=1),
            gltf.primitive(CUBE.vertices, CUBE.faces[6:], material=1),
        ]},
        {"name": "cube", "primitives": [gltf.primitive(CUBE.vertices, CUBE.faces, material=2)]},
    ]  # fmt: skip
    gltf.document["nodes"] = [
        {"matrix": TURNED.T.ravel().tolist(), "children": [1]},
        {"mesh": 1, "matrix": MIRRORED.T.ravel().tolist()},
        {"mesh": 0},
    ]
    gltf.document["scenes"][0]["nodes"] = [0, 2]
    return gltf


def dae_of(geometries, nodes, looks=""):
    """A document of geometries, each of its vertices and its primitives."""
    texts = []
    for name, (vertices, primitives) in geometries.items():
        numbers = " ".join(map(repr, np.asarray(vertices, float).ravel().tolist()))
        texts.append(
            f'<geometry id="{name}"><mesh><source id="{name}-s"><float_array id="{name}-f"'
            f' count="{3 * len(vertices)}">{numbers}</float_array><technique_common>'
            f'<accessor source="#{name}-f" count="{len(vertices)}" stride="3"><param name="X"'
            ' type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>'
            f'</accessor></technique_common></source><vertices id="{name}-v"><input'
            f' semantic="POSITION" source="#{name}-s"/></vertices>{primitives}</mesh></geometry>'
        )
    return (
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>'
        f"{looks}<library_geometries>{''.join(texts)}</library_geometries><library_visual_scenes>"
        f'<visual_scene id="w">{nodes}</visual_scene></library_visual_scenes><scene>'
        '<instance_visual_scene url="#w"/></scene></COLLADA>'
    )


def faces_of(name, faces, symbol):
    texts = " ".join(map(str, np.ravel(faces)))
    how = f'count="{len(faces)}" material="{symbol}"><input semantic="VERTEX" source="#{name}-v"'
    return how + f' offset="0"/><p>{texts}</p>'


def dae_looks(**colours):
    """Effects and materials of these names and sRGB bytes."""
    effects = "".join(
        f'<effect id="{name}-e"><profile_COMMON><technique sid="t"><lambert><diffuse>{stated}'
        "</diffuse></lambert></technique></profile_COMMON></effect>"
        for name, stated in colours.items()
    )
    materials = "".join(
        f'<material id="{name}"><instance_effect url="#{name}-e"/></material>' for name in colours
    )
    return (
        f"<library_effects>{effects}</library_effects>"
        f"<library_materials>{materials}</library_materials>"
    )


def in_dae(colour):
    return f"<color>{' '.join(str(byte / 255.0) for byte in colour)} 1</color>"


def bound(name, **symbols):
    some = "".join(f'<instance_material symbol="{s}" target="#{to}"/>' for s, to in symbols.items())
    return (
        f'<instance_geometry url="#{name}"><bind_material><technique_common>{some}'
        "</technique_common></bind_material></instance_geometry>"
    )


def two_cubes_in_dae():
    """The same: one geometry, of which the instances bind other materials to the same symbols."""
    red = np.concatenate([CUBE.faces[:3], [[0, 0, 1]], CUBE.faces[3:6]])
    primitives = f"<triangles {faces_of('c', red, 'one')}</triangles>"
    primitives += f"<lines {faces_of('c', [[0, 1]], 'other')}</lines>"
    primitives += f"<polygons {faces_of('c', CUBE.faces[6:7], 'other')}</polygons>"
    other = faces_of("c", CUBE.faces[7:], "other").replace("<p>", "<vcount>3 3 3 3 3</vcount><p>")
    primitives += f"<polylist {other}</polylist>"
    turned, mirrored = (" ".join(map(str, T.ravel())) for T in (TURNED, MIRRORED))
    nodes = f"<node><matrix>{turned}</matrix><node><matrix>{mirrored}</matrix>"
    nodes += f"{bound('c', one='blue', other='blue')}</node></node>"
    nodes += f"<node>{bound('c', one='red', other='green')}</node>"
    stated = dae_looks(red=in_dae(RED), green=in_dae(GREEN), blue=in_dae(BLUE))
    return dae_of({"c": (CUBE.vertices, primitives)}, nodes, stated).encode()


@pytest.mark.parametrize("kind", ["glb", "gltf", "dae"])
def test_each_face_of_a_scene_has_its_material_s_colour(tmp_path, kind):
    data = two_cubes_in_dae() if kind == "dae" else getattr(two_cubes(), kind)()
    (tmp_path / f"m.{kind}").write_bytes(data)
    triangles, colours, notes = coloured(tmp_path / f"m.{kind}")
    assert colours == list(map(list, sides(triangles)))
    assert len(colours) == 24
    assert notes == ()


def test_srgb_is_the_inverse_of_its_curve():
    for byte in range(256):
        light = srgb_linear("#" + bytes([byte, 0, 255]).hex())
        np.testing.assert_allclose(srgb(light), [byte / 255.0, 0.0, 1.0], atol=1e-7)


@FEW
@given(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=1, max_size=4))
def test_colours_are_those_that_others_write(tmp_path_factory, colours):
    """trimesh writes bytes as they are, in glTF as shares of light."""
    folder = tmp_path_factory.mktemp("m")
    cubes = []
    for n, colour in enumerate(colours):
        look = trimesh.visual.material.PBRMaterial(baseColorFactor=[*colour, 255])
        cube = trimesh.creation.box(bounds=[[3 * n, 0, 0], [3 * n + 1, 1, 1]])
        cube.visual = trimesh.visual.TextureVisuals(material=look)
        cubes.append(cube)
    (folder / "m.dae").write_bytes(trimesh.exchange.dae.export_collada(cubes))
    (folder / "m.glb").write_bytes(trimesh.Scene(cubes).export(file_type="glb"))
    for kind, stated in ("dae", colours), ("glb", srgb(np.array(colours) / 255.0) * 255.0):
        triangles, true, notes = coloured(folder / f"m.{kind}")
        which = (triangles.mean(axis=1)[:, 0] // 3.0).astype(int)
        np.testing.assert_array_equal(true, np.round(np.array(stated))[which])
        assert notes == ()


def textured(inside="view", uv=None, **more):
    """A square of two triangles with `TEXELS` on it, under a factor; v is down in glTF."""
    gltf = Gltf()
    places = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32) if uv is None else uv
    square = gltf.primitive(QUAD, HALVES, material=0)
    square["attributes"]["TEXCOORD_1"] = gltf.array(places)
    look = material(255, 128, 255)
    texture = {"index": 0, "texCoord": 1, **more}
    look["pbrMetallicRoughness"]["baseColorTexture"] = texture
    picture = png(Image.fromarray(TEXELS))
    uri = "data:image/png;base64," + base64.b64encode(picture).decode()
    images = {"view": {}, "data": {"uri": uri}, "file": {"uri": "t%201.png"}}
    image = images[inside] or {"bufferView": gltf.view(picture), "mimeType": "image/png"}
    gltf.document |= {"materials": [look], "textures": [{"source": 0}], "images": [image]}
    gltf.document |= {"meshes": [{"primitives": [square]}], "nodes": [{"mesh": 0}]}
    gltf.document["scenes"][0]["nodes"] = [0]
    return gltf


@pytest.mark.parametrize("inside", ["view", "data", "file"])
@pytest.mark.parametrize("kind", ["glb", "gltf"])
def test_a_face_has_its_texture_s_mean_times_the_factor(tmp_path, inside, kind):
    (tmp_path / "t 1.png").write_bytes(png(Image.fromarray(TEXELS)))
    ends = np.array([[0, 1], [1, 1], [1, 0], [0, 0]])
    for uv in (None, (255 * ends).astype(np.uint8), (65535 * ends).astype(np.uint16)):
        (tmp_path / f"m.{kind}").write_bytes(getattr(textured(inside, uv), kind)())
        assert coloured(tmp_path / f"m.{kind}")[1:] == (MEANS, ())


def test_places_in_a_texture_may_stand_between_other_numbers(tmp_path):
    gltf = textured()
    places = np.array([[0, 1, 7], [1, 1, 7], [1, 0, 7], [0, 0, 7]], np.float32)
    accessor = gltf.document["accessors"][-1] | {
        "bufferView": gltf.view(bytes(4) + places.tobytes())
    }
    gltf.document["accessors"][-1] = accessor | {"byteOffset": 4}
    gltf.document["bufferViews"][-1]["byteStride"] = 12
    (tmp_path / "m.glb").write_bytes(gltf.glb())
    assert coloured(tmp_path / "m.glb")[1:] == (MEANS, ())


def textured_dae(file="t.png", texture='<texture texture="sampler" texcoord="UV"/>'):
    primitive = (
        '<source id="t"><float_array id="tf" count="8">0 0 1 0 1 1 0 1</float_array>'
        '<technique_common><accessor source="#tf" count="4" stride="2"><param name="S"'
        ' type="float"/><param name="T" type="float"/></accessor></technique_common></source>'
        f"<triangles {faces_of('q', np.repeat(HALVES, 2, axis=1), 'm')}</triangles>"
    ).replace("<p>", '<input semantic="TEXCOORD" source="#t" offset="1" set="0"/><p>')
    primitive, triangles = primitive.split("<triangles")
    looks = f'<library_images><image id="i"><init_from>{file}</init_from></image></library_images>'
    looks += dae_looks(m=texture).replace(
        "<technique ",
        '<newparam sid="surface"><surface type="2D"><init_from>i</init_from></surface></newparam>'
        '<newparam sid="sampler"><sampler2D><source>surface</source></sampler2D></newparam>'
        "<technique ",
    )
    text = dae_of(
        {"q": (QUAD, f"<triangles{triangles}")}, f"<node>{bound('q', m='m')}</node>", looks
    )
    return text.replace('<vertices id="q-v"', f'{primitive}<vertices id="q-v"').encode()


def test_collada_has_a_texture_in_the_place_of_a_colour(tmp_path):
    (tmp_path / "t 1.png").write_bytes(png(Image.fromarray(TEXELS)))
    means = [[50, 100, 100], [100, 50, 50]]
    for file in ("t%201.png", "./t 1.png", "file:///home/x/t%201.png", "C:\\x\\t 1.png"):
        (tmp_path / "m.dae").write_bytes(textured_dae(file))
        assert coloured(tmp_path / "m.dae")[1:] == (means, ())
    for file in ("none.png", "../t 1.png", "/etc/passwd", "http://x/t.png", ""):
        (tmp_path / "m.dae").write_bytes(textured_dae(file))
        _, colours, (note,) = coloured(tmp_path / "m.dae")
        assert colours in (None, [[255, 255, 255]] * 2)
        assert "not read" in note


def test_a_mesh_on_several_nodes_has_its_colours_on_each(tmp_path):
    (tmp_path / "t.png").write_bytes(png(Image.fromarray(TEXELS)))
    gltf = textured()
    gltf.document["nodes"] += [{"mesh": 0, "scale": [-1, 1, 1]}, {"mesh": 0}]
    gltf.document["scenes"][0]["nodes"] = [0, 1, 2]
    (tmp_path / "m.glb").write_bytes(gltf.glb())
    assert coloured(tmp_path / "m.glb")[1:] == (MEANS * 3, ())
    text = textured_dae().decode().replace("<node>", '<node id="n">')
    again = '<node><scale>-1 1 1</scale><instance_node url="#n"/></node>' * 2
    (tmp_path / "m.dae").write_text(text.replace("</visual_scene>", f"{again}</visual_scene>"))
    assert coloured(tmp_path / "m.dae")[1:] == ([[50, 100, 100], [100, 50, 50]] * 3, ())


UNREAD = {
    "no such material": lambda d: d["meshes"][0]["primitives"][0].update(material=9),
    "no such texture": lambda d: d.update(textures=[]),
    "no such image": lambda d: d.update(images=[]),
    "no such view": lambda d: d["images"][0].update(bufferView=99),
    "materials that are none": lambda d: d.update(materials={"a": 1}),
    "a factor that is none": lambda d: d["materials"][0].update(pbrMetallicRoughness=[1]),
    "places without end": lambda d: d["accessors"][-1].update(count=2**60),
    "fewer places": lambda d: d["accessors"][-1].update(count=2),
    "places of three": lambda d: d["accessors"][-1].update(type="VEC3"),
    "places of a kind of its own": lambda d: d["accessors"][-1].update(componentType=1),
    "places beyond the buffer": lambda d: d["accessors"][-1].update(byteOffset=40),
    "places before it": lambda d: d["accessors"][-1].update(byteOffset=-8),
}


def refused(path):
    try:
        return read_mesh(path) and ""
    except InvalidSource as error:
        return str(error)


@pytest.mark.parametrize("edit", UNREAD.values(), ids=list(UNREAD))
def test_materials_that_lie_leave_the_mesh_as_it_is(tmp_path, edit):
    gltf = textured()
    gltf.document["accessors"].append(gltf.document["accessors"][-1].copy())
    number = len(gltf.document["accessors"]) - 1
    gltf.document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = number
    edit(gltf.document)
    (tmp_path / "m.glb").write_bytes(gltf.glb())
    if refusal := refused(tmp_path / "m.glb"):  # trimesh reads all accessors
        with looks.with_looks(wanted=True):
            assert refused(tmp_path / "m.glb") == refusal
        return
    assert coloured(tmp_path / "m.glb")[1:] == (
        None,
        ("1 materials or textures not read: 'm.glb'",),
    )


@pytest.mark.parametrize(
    "factor", [[], [1, "x", 0], [None] * 4, [10**400, 0, 0, 1], [float("nan"), -1, 1e999, 1]]
)
def test_a_factor_of_no_numbers_is_white_and_others_are_bounded(tmp_path, factor):
    gltf = textured()
    gltf.document["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": factor}
    (tmp_path / "m.glb").write_bytes(gltf.glb())
    white = [0, 0, 255] if len(factor) == 4 and factor[1] == -1 else [255, 255, 255]
    assert coloured(tmp_path / "m.glb")[1:] == ([white] * 2, ())


@pytest.mark.parametrize("data", [bomb(), b"", b"%!PS-Adobe-3.0 EPSF-3.0\n"])
def test_pictures_that_cannot_be_decoded_leave_the_factor(tmp_path, data):
    gltf = textured()
    gltf.document["images"][0]["bufferView"] = gltf.view(data)
    (tmp_path / "m.glb").write_bytes(gltf.glb())
    factor = [[255, 128, 255]] * 2
    notes = ("1 materials or textures not read: 'image 0'",)
    assert coloured(tmp_path / "m.glb")[1:] == (factor, notes)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('target="#red"', 'target="#none"'),
        ('url="#blue-e"', 'url="none"'),
        ("<lambert>", "<none>"),
        ("<diffuse>", "<diffuse><none/>"),
        ("<color>", "<color>x "),
    ],
)
def test_materials_of_collada_that_lie_leave_the_mesh_as_it_is(tmp_path, old, new):
    text = two_cubes_in_dae().decode()
    edited = text.replace(old, new)
    if new == "<none>":
        edited = edited.replace("</lambert>", "</none>")
    assert edited != text
    (tmp_path / "m.dae").write_text(edited)
    _, colours, notes = coloured(tmp_path / "m.dae")
    assert colours is None
    assert notes or old == "<diffuse>"  # which states none then


URDF = """\
<robot name="slide"><material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="wall"><visual><geometry><mesh filename="wall.glb"/></geometry>
    <material name="grey"/></visual></link>
  <link name="bolt"><visual><origin xyz="0 3 0"/><geometry><mesh filename="bolt.dae"/></geometry>
    <material name="grey"/></visual></link>
  <joint name="slide" type="prismatic"><parent link="wall"/><child link="bolt"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.5" effort="1" velocity="1"/></joint>
</robot>
"""
RECIPE = {
    "articulation": {"states": 1}, "views": {"count": 20, "resolution": 64},
    "sampling": {"grids": [], "surface_points": 1000, "surface_color": True},
}  # fmt: skip


def test_points_and_exports_have_them_over_those_of_the_urdf(tmp_path):
    (tmp_path / "slide.urdf").write_text(URDF)
    (tmp_path / "wall.glb").write_bytes(two_cubes().glb())
    (tmp_path / "bolt.dae").write_bytes(two_cubes_in_dae())
    plain, maker = (
        ag.Maker(ag.load(tmp_path / "slide.urdf"), recipe)
        for recipe in ({**RECIPE, "sampling": {"grids": [], "surface_points": 1000}}, RECIPE)
    )
    assert plain.obj.sha256 == maker.obj.sha256  # of the same files
    assert all(link.mesh.colours is None for link in plain.obj.links)
    row, without = maker[0].instance, plain[0].instance
    np.testing.assert_array_equal(row.surface_points, without.surface_points)
    beyond, normals = row.surface_points[:, 0] > 2**15, row.surface_normals
    red = (normals[:, 0] != 0) | (normals[:, 1] < 0)
    true = np.where(beyond[:, None], BLUE, np.where(red[:, None], RED, GREEN))
    np.testing.assert_array_equal(row.surface_color, true)
    assert set(row.surface_part.tolist()) == {0, 1}
    assert min(beyond.sum(), (red & ~beyond).sum(), (~red & ~beyond).sum()) > 50
    source = str(tmp_path / "slide.urdf")
    ag.generate("slide", source=source, out=tmp_path / "data", recipe=RECIPE, jobs=0)
    ag.export(tmp_path / "data" / "slide", "glb", tmp_path / "glb", resolution=64)
    (path,) = (tmp_path / "glb").glob("**/*.glb")
    for _, colours in in_gltf(path):
        assert set(map(tuple, colours.tolist())) == {RED, GREEN, BLUE}
    _, again, notes = coloured(path)
    assert set(map(tuple, again)) == {RED, GREEN, BLUE}
    assert notes == ()
