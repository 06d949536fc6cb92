"""The colours of models: in closed form, and of textures that are made to do harm."""

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import articugen as ag
from articugen.core.colours import plain_colour
from articugen.core.errors import MachineFault
from articugen.instance.maker import models
from articugen.meshes import looks, pixels
from articugen.meshes.model_files import ModelFiles
from articugen.meshes.read import read_mesh
from articugen.sources import readers

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
BOX += "f 5 7 8 6\nf 1 3 7 5\nf 2 6 8 4\n"
MTL = "newmtl red\nKd 1 0 0\n\nnewmtl green paint\nKd 0.2 .6 0\nmap_Kd none.png\n"
RECIPE = {
    "articulation": {"states": 1}, "views": {"count": 20, "resolution": 64},
    "sampling": {"grids": [], "surface_points": 1000, "surface_color": True},
    "images": {"views": 2, "resolution": 64, "colours": "model"},
}  # fmt: skip
QUAD = (
    "mtllib m.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
)
QUAD += "f 1/1 2/2 3/3\nf 1/-4/1 3/-2/1 4/-1/1\nf 1 2 4\n"
TEXELS = np.array([[[200, 0, 0], [0, 200, 0]], [[0, 0, 200], [100, 100, 100]]], np.uint8)


def slide(folder: Path) -> Path:
    for name, text in {"slide.urdf": URDF, "box.obj": BOX, "box.mtl": MTL}.items():
        (folder / name).write_text(text)
    return folder / "slide.urdf"


def picture(array, kind: str = "PNG", **options) -> bytes:
    file = io.BytesIO()
    Image.fromarray(array).save(file, kind, **options)
    return file.getvalue()


def faces_of(folder: Path, texture: bytes | None, line: str = "map_Kd t.png") -> tuple:
    """Colours of a textured quad's three faces, or None, and the notes."""
    (folder / "m.obj").write_text(QUAD)
    (folder / "m.mtl").write_text(f"newmtl m\nKd 1 .5 1\n{line}\n")
    if texture is not None:
        (folder / "t.png").write_bytes(texture)
    with looks.with_looks(wanted=True) as reader:
        mesh = read_mesh(folder / "m.obj", ModelFiles(folder))
    return None if mesh.colours is None else mesh.colours.tolist(), reader.notes()


def test_points_and_pixels_have_the_colour_of_their_side(tmp_path):
    maker = ag.Maker(ag.load(slide(tmp_path)), RECIPE)
    (note,) = maker.obj.notes
    assert note == "1 materials or textures not read: 'none.png'"
    for row in (maker[0].instance, maker[1].instance):
        normal = np.round(row.surface_normals / 127.0).astype(int)
        red = (normal[:, 0] < 0) | (normal[:, 1] != 0)
        true = np.where(red[:, None], [255, 0, 0], [51, 153, 0])
        true[row.surface_part == 1] = [0, 0, 255]
        np.testing.assert_array_equal(row.surface_color, true)
        hue = row.image_rgba[..., :3].reshape(-1, 3).astype(int)
        assert {tuple(c) for c in (hue[hue.any(1)] > 0).tolist()} <= {
            (True, False, False), (True, True, False), (False, False, True)
        }  # fmt: skip


def test_a_face_has_its_texture_s_mean_times_kd(tmp_path):
    parts = [TEXELS[1, 0] / 4 + TEXELS[1, 1] / 2 + TEXELS[0, 1] / 4,
             TEXELS[1, 0] / 4 + TEXELS[0, 0] / 2 + TEXELS[0, 1] / 4]  # fmt: skip
    true = [*(np.round(mean * [1, 0.5, 1] + 1e-9).tolist() for mean in parts), [255, 128, 255]]
    assert faces_of(tmp_path, picture(TEXELS)) == (true, ())
    assert faces_of(tmp_path, picture(TEXELS), "map_Kd -s 1 1 1 C:\\x\\t.png") == (true, ())
    palette = Image.fromarray(TEXELS).quantize(4)
    assert faces_of(tmp_path, picture(np.asarray(palette.convert("RGB"))))[0] == true
    file = io.BytesIO()
    palette.save(file, "PNG")
    assert faces_of(tmp_path, file.getvalue())[0] == true
    clear = np.zeros((600, 300, 4), np.uint8)
    (white, *_), _ = faces_of(tmp_path, picture(clear))
    assert white == [255, 128, 255]
    assert looks.decoded(picture(clear)).shape == (200, 100, 3)


def bomb(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(10**6))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "texture",
    [bomb(40_000, 25_000), picture(TEXELS)[:45], b"", b"%!PS-Adobe-3.0 EPSF-3.0\n"],
    ids=["bomb", "torn", "empty", "program"],
)
def test_a_texture_that_cannot_be_decoded_leaves_kd(tmp_path, texture):
    colours, (note,) = faces_of(tmp_path, texture)
    assert colours == [[255, 128, 255]] * 3
    assert "'t.png'" in note


@pytest.mark.parametrize(
    "name", ["../../../etc/passwd", "/etc/passwd", "t\0.png", "x" * 999, "pipe"]
)
def test_a_texture_that_is_no_file_of_the_model_leaves_kd(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    colours, (note,) = faces_of(tmp_path, None, f"map_Kd {name}")
    assert colours == [[255, 128, 255]] * 3
    assert note.startswith("1 materials or textures not read")


def test_where_no_process_can_run_that_is_the_machine_s_fault(monkeypatch, tmp_path):
    monkeypatch.setattr(pixels, "__file__", str(tmp_path / "none.py"))
    with pytest.raises(MachineFault, match=r"none\.py"):
        looks.decoded(picture(TEXELS))


def test_without_the_key_nothing_of_materials_is_read(tmp_path):
    path = slide(tmp_path)
    (ref,) = models(path)
    plain, coloured = readers.load(ref), readers.load(ref, colours=True)
    assert all(link.mesh.colours is None for link in plain.links)
    assert (readers.digest(ref), readers.digest(ref, colours=True)) == (
        plain.sha256,
        coloured.sha256,
    )
    (tmp_path / "box.mtl").write_text("newmtl red\nKd nan x\n")
    assert readers.digest(ref) == plain.sha256 != readers.digest(ref, colours=True)
    (tmp_path / "box.mtl").unlink()
    assert readers.load(ref, colours=True).links[0].mesh.colours is None


def test_a_data_set_with_colours_is_the_same_again(tmp_path):
    for name in "ab":
        ag.generate("drawer", out=tmp_path / name, recipe=RECIPE, objects=1, jobs=0)
    row = ag.open(tmp_path / "a" / "drawer")[0]
    assert row.surface.color.dtype == np.uint8
    assert {tuple(c) for c in row.surface.color.tolist()} == {
        plain_colour("drawer", name) for name in ("body", "drawer")
    }
    assert ag.verify(tmp_path / "a" / "drawer").ok
    shards = [ag.open(tmp_path / name / "drawer").manifest.shards for name in "ab"]
    assert shards[0] == shards[1]
