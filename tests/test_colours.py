"""The colours of models: in closed form, and of textures that are made to do harm."""

import io
import os
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

import articugen as ag
from articugen.core.colours import plain_colour
from articugen.core.records import LabelledMesh
from articugen.fusion import origins
from articugen.instance.maker import models
from articugen.meshes import looks
from articugen.meshes.model_files import ModelFiles
from articugen.meshes.read import read_mesh
from articugen.sources import readers
from tests.shapes import labelled, sheet, two_sided

URDF = """\
<robot name="slide"><material name="blue"><color rgba="0 0 1 1"/></material>
  <link name="wall"><visual><geometry><mesh filename="box.obj"/></geometry></visual></link>
  <link name="bolt"><visual><origin xyz="2 0 0"/><geometry><box size="0.4 0.4 0.4"/></geometry>
    <material name="blue"/></visual></link>
  <joint name="slide" type="prismatic"><parent link="wall"/><child link="bolt"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.5" effort="1" velocity="1"/></joint>
</robot>
"""
BOX = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
BOX = f"mtllib box.mtl\n{BOX}usemtl  red\nf 1 2 4 3\n\tf 1 5 6 2\nf 3 4 8 7\nusemtl green paint\n"
BOX += "f 5 7 8 6\nf\t1 3 7 5\nf 2 6 8 4\n"
MTL = "newmtl red\nKd 1 0 0\n\nnewmtl green paint\nKd 0.2 .6 0\nmap_Kd none.png\n"
RECIPE = {
    "articulation": {"states": 1}, "views": {"count": 20, "resolution": 64},
    "sampling": {"grids": [], "surface_points": 1000, "surface_color": True},
    "images": {"views": 2, "resolution": 64, "colours": "model"},
}  # fmt: skip
QUAD = "mtllib m.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
QUAD += "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/-4/1 3/-2/1 4/-1/1\nf 1 2 4\n"
TEXELS = np.array([[[200, 0, 0], [0, 200, 0]], [[0, 0, 200], [100, 100, 100]]], np.uint8)


def png(image: Image.Image) -> bytes:
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def textured(folder, texture: bytes | None, line: str = "map_Kd t.png"):
    """The colours of a quad's three faces, the last of which names no place in the texture."""
    (folder / "m.obj").write_text(QUAD)
    (folder / "m.mtl").write_text(f"newmtl m\nKd 1 .5 1\n{line}\n")
    if texture is not None:
        (folder / "t.png").write_bytes(texture)
    with looks.with_looks(wanted=True) as reader:
        return read_mesh(folder / "m.obj", ModelFiles(folder)).colours.tolist(), reader.notes()


@pytest.fixture
def slide(tmp_path):
    for name, text in {"slide.urdf": URDF, "box.obj": BOX, "box.mtl": MTL}.items():
        (tmp_path / name).write_text(text)
    return tmp_path / "slide.urdf"


def test_points_and_pixels_have_the_colour_of_their_side(slide):
    maker = ag.Maker(ag.load(slide), RECIPE)
    assert maker.obj.notes == ("1 materials or textures not read: 'none.png'",)
    for row in (maker[0].instance, maker[1].instance):
        red = (row.surface_normals[:, :1] < 0) | (row.surface_normals[:, 1:2] != 0)
        true = np.where(red, [255, 0, 0], [51, 153, 0])
        true[row.surface_part == 1] = [0, 0, 255]
        np.testing.assert_array_equal(row.surface_color, true)
        shades = row.image_rgba[row.image_part > 0, :3] > 0
        assert {tuple(s) for s in shades.tolist()} <= {(1, 0, 0), (1, 1, 0), (0, 0, 1)}


def test_of_faces_that_coincide_the_one_counts_that_looks_the_same_way():
    soup = labelled(two_sided(sheet()))  # faces 0 and 2 are one place, 1 and 3 as well
    turned = LabelledMesh(soup.vertices, soup.faces[:, ::-1], soup.part_of_face)
    origin = np.array([0, 1, 0, 1])
    assert origins(soup, origin, soup).tolist() == [0, 1, 2, 3]
    assert origins(turned, origin, soup).tolist() == [2, 3, 0, 1]


def test_a_face_has_its_texture_s_mean_times_kd(tmp_path):
    """Half of it lies in one texel, a quarter in each of two others."""
    for texture in (Image.fromarray(TEXELS), Image.fromarray(TEXELS).quantize(4)):
        for line in ("map_Kd t.png", "map_Kd -s 1 1 1 C:\\x\\t.png"):
            colours, notes = textured(tmp_path, png(texture), line)
            assert colours == [[50, 50, 100], [100, 25, 50], [255, 128, 255]]
            assert notes == ()
    clear = Image.new("RGBA", (600, 1200))
    assert textured(tmp_path, png(clear))[0] == [[255, 128, 255]] * 3
    assert looks.decoded(png(clear)).shape == (400, 200, 3)


def bomb() -> bytes:
    """A PNG of 10^9 pixels, by its header."""
    chunks = {b"IHDR": struct.pack(">IIBBBBB", 40_000, 25_000, 8, 2, 0, 0, 0), b"IDAT": bytes(9)}
    checks = {kind: struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks.items()}
    body = (struct.pack(">I", len(d)) + kind + d + checks[kind] for kind, d in chunks.items())
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


HOSTILE = {
    "bomb": bomb(), "torn": png(Image.fromarray(TEXELS))[:45], "empty": b"",
    "program": b"%!PS-Adobe-3.0 EPSF-3.0\n", "../../../etc/passwd": None, "/etc/passwd": None,
    "t\0.png": None, "x" * 999: None, "pipe": None,
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_texture_that_cannot_be_read_leaves_kd(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    line = "map_Kd t.png" if HOSTILE[name] is not None else f"map_Kd {name}"
    colours, (note,) = textured(tmp_path, HOSTILE[name], line)
    assert colours == [[255, 128, 255]] * 3
    assert note.startswith("1 materials or textures not read: '")


def test_without_the_key_nothing_of_materials_is_read(slide):
    (ref,) = models(slide)
    plain, coloured = readers.load(ref), readers.load(ref, colours=True)
    assert all(link.mesh.colours is None for link in plain.links)
    assert readers.digest(ref) == plain.sha256
    assert readers.digest(ref, colours=True) == coloured.sha256
    slide.with_name("box.mtl").write_text("newmtl red\nKd nan x\n")
    assert readers.digest(ref) == plain.sha256
    assert readers.digest(ref, colours=True) != coloured.sha256
    slide.with_name("box.mtl").unlink()
    assert readers.load(ref, colours=True).links[0].mesh.colours is None


def test_a_data_set_with_colours_is_the_same_again(tmp_path):
    for name in "ab":
        ag.generate("drawer", out=tmp_path / name, recipe=RECIPE, objects=1, jobs=0)
    one, other = (ag.open(tmp_path / name / "drawer") for name in "ab")
    assert one.manifest.shards == other.manifest.shards
    assert {tuple(c) for c in one[0].surface.color.tolist()} == {
        plain_colour("drawer", name) for name in ("body", "drawer")
    }
    assert ag.verify(tmp_path / "a" / "drawer", jobs=1).ok
