"""Colours within a face: what points and pixels show, by hand and beside another renderer."""

import itertools

import numpy as np
import pytest
import trimesh
from few import FEW
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from test_backends import cameras, why_not
from test_colours import TEXELS, png
from test_scene_colours import HALVES, QUAD, Gltf, coloured, material, refused, textured
from test_scene_colours import textured_dae as dae

import articugen as ag
from articugen.core.colours import srgb
from articugen.core.geometry import nearest_weights
from articugen.core.records import LabelledMesh, dequantize
from articugen.core.texture import Texture
from articugen.instance.painted import Paint
from articugen.meshes import looks
from articugen.meshes.model_files import ModelFiles
from articugen.meshes.read import read_mesh, scaled
from articugen.rendering.images import images

RNG = np.random.default_rng(7)
FRONT, BACK, SIDE = RNG.permutation(4096)[: 3 * 16].reshape(3, 4, 4, 1) // [256, 16, 1] % 16
FRONT, BACK, SIDE = (np.uint8(17 * board) for board in (FRONT, BACK, SIDE))
"""Boards of 4 x 4 colours, no two alike."""

URDF = """\
<robot name="door">
  <link name="body"><visual><geometry><mesh filename="box.obj"/></geometry></visual></link>
  <link name="door"><visual><geometry><mesh filename="door.obj"/></geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="body"/><child link="door"/>
    <origin xyz="0 -0.25 0"/><axis xyz="0 0 1"/>
    <limit lower="-1.5" upper="0" effort="1" velocity="1"/></joint>
</robot>
"""
RECIPE = {
    "articulation": {"states": 3}, "views": {"count": 30, "resolution": 96},
    "sampling": {"grids": [], "surface_points": 3000, "surface_color": True},
    "images": {"views": 3, "resolution": 96, "colours": "model"},
}  # fmt: skip


def quads(*groups):
    """An OBJ of squares, each a material and four corners, whose places in its texture are their
    coordinates but for one axis."""
    lines, n = ["mtllib m.mtl"], itertools.count(1)
    for name, axis, corners in groups:
        lines.append(f"usemtl {name}")
        for corner in corners:
            lines.append("v {} {} {}\nvt {} {}".format(*corner, *np.delete(corner, axis)))
        lines.append("f " + " ".join(f"{k}/{k}" for _, k in zip(range(4), n, strict=False)))
    return "\n".join(lines) + "\n"


def square(axis, at):
    """Four corners of a unit square that looks along an axis, or against it where `at` is 0."""
    plane = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    corners = list(np.insert(plane, axis, at, axis=1))
    return corners if (at == 1) != (axis == 1) else corners[::-1]


@pytest.fixture(scope="module")
def door(tmp_path_factory):
    """A cube with a picture on each side, and a door before it that has two others."""
    folder = tmp_path_factory.mktemp("door")
    sides = [("side", axis, square(axis, at)) for axis in range(3) for at in (0, 1)]
    outer = square(1, 0)
    leaf = [
        ("front", 1, outer),
        ("back", 1, [outer[k] for k in (0, 3, 2, 1)]),
    ]  # the same triangles
    texts = {"box.obj": quads(*sides), "door.obj": quads(*leaf), "door.urdf": URDF, "m.mtl": ""}
    for name, board in (("front", FRONT), ("back", BACK), ("side", SIDE)):
        texts["m.mtl"] += f"newmtl {name}\nKd 1 1 1\nmap_Kd {name}.png\n"
        (folder / f"{name}.png").write_bytes(png(Image.fromarray(board)))
    for name, text in texts.items():
        (folder / name).write_text(text)
    maker = ag.Maker(ag.load(folder / "door.urdf"), RECIPE)
    return [maker[n].instance for n in range(4)]


def texel(board, uv):
    """The naive reading of a picture at places (n, 2), v up, and whether these are clear of the
    borders between texels."""
    size = len(board)
    at = [(min(max(u, 0.0), 0.999999), min(max(v, 0.0), 0.999999)) for u, v in uv.tolist()]
    colours = [board[int((1.0 - v) * size), int(u * size)] for u, v in at]
    off = np.abs(uv * size - np.round(uv * size))
    inner = (np.round(uv * size) == 0) | (np.round(uv * size) == size)  # the picture's own edge
    return np.array(colours, np.uint8).reshape(-1, 3), ((off > 1e-3) | inner).all(axis=1)


def turned_back(row, points):
    """Points and vectors of the door in its own axes."""
    np.testing.assert_allclose(np.abs(row.joint_axis[0]), [0, 0, 1], atol=1e-12)
    q = row.joint_state[0] * row.joint_axis[0, 2]
    return points @ np.array([[np.cos(q), -np.sin(q), 0], [np.sin(q), np.cos(q), 0], [0, 0, 1]])


def test_points_have_the_texel_of_their_place_in_every_state(door):
    assert len({float(row.joint_state[0]) for row in door}) == 4
    for row in door:
        world = dequantize(row.surface_points) * row.scale + row.center
        normals, colours = row.surface_normals / 127.0, row.surface_color
        for axis in range(3):
            on = (row.surface_part == 0) & (np.abs(normals[:, axis]) > 0.99)
            true, clear = texel(SIDE, np.delete(world[on], axis, axis=1))
            assert clear.sum() > 200
            np.testing.assert_array_equal(colours[on][clear], true[clear])
        own = turned_back(row, world - [0.0, -0.25, 0.0])
        facing, leaf = turned_back(row, normals)[:, 1], row.surface_part == 1
        for board, on in ((FRONT, facing < -0.9), (BACK, facing > 0.9)):
            true, clear = texel(board, own[leaf & on][:, [0, 2]])
            assert clear.sum() > 100
            np.testing.assert_array_equal(colours[leaf & on][clear], true[clear])
        rim = leaf & (np.abs(facing) < 0.1)  # of the sheet, which has a thickness
        (one, clear), (other, _) = (texel(board, own[rim][:, [0, 2]]) for board in (FRONT, BACK))
        some = (colours[rim] == one).all(axis=1) | (colours[rim] == other).all(axis=1)
        assert clear.sum() > 5
        assert some[clear].all()


def test_pixels_have_the_shaded_texel_that_their_ray_meets(door):
    lamp = np.array([-0.48, -0.64, -0.6])
    for row, k in itertools.product(door[:2], range(3)):
        T = row.image_T_camera_world[k]
        fx, fy, cx, cy = row.image_intrinsics[k]
        j, i = np.meshgrid(np.arange(96) + 0.5, np.arange(96) + 0.5)
        rays = np.stack([(j - cx) / fx, (i - cy) / fy, np.ones_like(i)], -1) @ T[:3, :3]
        eye = (-T[:3, 3] @ T[:3, :3]) * row.scale + row.center
        low, high = np.sort(np.stack([-eye / rays, (1.0 - eye) / rays]), axis=0)
        enter, axis = low.max(axis=-1), low.argmax(axis=-1)
        box = (enter < high.min(axis=-1)) & (row.image_part[k] == 1)
        for a in range(3):
            on = box & (axis == a)
            met = eye + rays[on] * enter[on][:, None]
            true, clear = texel(SIDE, np.delete(met, a, axis=1))
            clear &= (np.abs(np.delete(met, a, axis=1) - 0.5) < 0.49).all(axis=1)
            outward = np.eye(3)[a] * -np.sign(rays[on][:, a][:, None])
            light = 0.4 + 0.6 * np.maximum(outward @ (lamp @ T[:3, :3]), 0.0)
            shade = 255.0 * ((true / 255.0) ** 2.2 * light[:, None]).clip(0, 1) ** (1 / 2.2)
            seen = row.image_rgba[k][on][:, :3]
            assert np.abs(seen - shade)[clear].max(initial=0) < 1.0
            if on.sum() > 200:
                assert len(np.unique(seen[clear], axis=0)) > 8


def painted(path, data):
    path.write_bytes(data)
    with looks.with_looks(wanted=True):
        return read_mesh(path, ModelFiles(path.parent))


def test_pictures_lie_on_mirrored_meshes_as_on_others(tmp_path):
    """Corners of a mirrored face come in the other order; all are |x|, y of their picture."""
    (tmp_path / "t.png").write_bytes(png(Image.fromarray(TEXELS)))
    gltf = textured()
    faces = np.array([[0, 0, 1], *HALVES], np.uint32)  # the first of which is dropped
    gltf.document["meshes"][0]["primitives"][0]["indices"] = gltf.array(faces.ravel())
    gltf.document["nodes"] += [{"mesh": 0, "scale": [-1, 1, 1]}]
    gltf.document["scenes"][0]["nodes"] = [0, 1]
    again = '<node><scale>-1 1 1</scale><instance_node url="#n"/></node></visual_scene>'
    text = dae().decode().replace("<node>", '<node id="n">').replace("</visual_scene>", again)
    for mesh in painted(tmp_path / "m.glb", gltf.glb()), painted(tmp_path / "m.dae", text.encode()):
        assert (mesh.triangles[..., 0].min(), mesh.triangles[..., 0].max()) == (-1.0, 1.0)
        for one in (mesh, scaled(mesh, (1, 1, -1)), scaled(mesh, (-1, 1, 1))):
            np.testing.assert_allclose(one.texture.places, np.abs(one.triangles[..., :2]))


@FEW
@given(st.integers(0, 2**32 - 1))
def test_joined_meshes_keep_their_own_pictures(seed):
    rng = np.random.default_rng(seed)
    shared = [rng.integers(0, 256, (*rng.integers(1, 5, 2), 3), np.uint8) for _ in range(4)]
    textures, counts = [], rng.integers(0, 6, rng.integers(1, 5))
    for n in counts:
        own = tuple(shared[k] for k in rng.permutation(4)[: rng.integers(1, 4)])
        which, places = rng.integers(-1, len(own), n), rng.normal(size=(n, 3, 2))
        one = Texture(own, which, places, rng.random((n, 3, 3)))
        textures.append(one if rng.random() < 0.7 else None)
    whole = Texture.joined(textures, counts.tolist())
    first = np.cumsum([0, *counts])
    assert (whole is None) == all(t is None for t in textures)
    for texture, start, n in zip(textures, first, counts, strict=False):
        if whole is None or texture is None:
            assert whole is None or (whole.which[start : start + n] == -1).all()
            continue
        face, weights = np.repeat(np.arange(n), 5), rng.dirichlet([1, 1, 1], 5 * n)
        true = texture.colours(face, weights)
        np.testing.assert_array_equal(whole.colours(face + start, weights), true)
        np.testing.assert_array_equal(whole.which[start : start + n] < 0, texture.which < 0)
        for f in range(len(face)):  # one at a time, as one would by hand
            colour = weights[f] @ texture.tint[face[f]]
            if (k := texture.which[face[f]]) >= 0:
                u, v = weights[f] @ texture.places[face[f]] % 1.0
                h, w = texture.pictures[k].shape[:2]
                colour = colour * texture.pictures[k][int((1.0 - v) * h), int(u * w)] / 255.0
            np.testing.assert_allclose(true[f], 255.0 * colour, atol=0.51)


def test_weights_are_those_of_the_nearest_place_in_the_plane():
    corners = np.tile([[0.0, 0, 0], [2, 0, 0], [0, 4, 0]], (4, 1, 1))
    corners[3] = [[1, 1, 1]] * 3
    points = np.array([[0.5, 1, 0], [0.5, 1, 7], [5, 0, 1], [0, 0, 0]])
    weights = nearest_weights(corners, points)
    true = [[0.5, 0.25, 0.25]] * 2 + [[0, 1, 0], [1 / 3] * 3]
    np.testing.assert_allclose(weights, true, atol=2e-6)
    corners[:, 1] = corners[:, 0]  # and one as thin as can be
    corners[1, 1, 0] += 5e-324
    np.testing.assert_array_equal(nearest_weights(corners, points), [[1 / 3] * 3] * 4)


SQUARE = [[0, 0], [1, 0], [0, 1], [1, 1]]


@pytest.mark.parametrize(
    ("stated", "uv", "moved"),
    [
        ({"offset": [0.5, 0.25]}, SQUARE, [[0.5, 0.25], [1.5, 0.25], [0.5, 1.25], [1.5, 1.25]]),
        ({"scale": [2, -1]}, SQUARE, [[0, 0], [2, 0], [0, -1], [2, -1]]),
        # the extension's own examples: a quadrant on the lower left, and v up
        (
            {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]},
            SQUARE,
            [[0, 1], [0, 0.5], [0.5, 1], [0.5, 0.5]],
        ),
        ({"offset": [0, 1], "scale": [1, -1]}, SQUARE, [[0, 1], [1, 1], [0, 0], [1, 0]]),
        # scaled, then turned by 3-4-5, then moved
        (
            {"offset": [1, 2], "rotation": np.arctan2(4, 3), "scale": [10, 5]},
            SQUARE,
            [[1, 2], [7, -6], [5, 5], [11, -3]],
        ),
    ],
)
def test_a_texture_transform_scales_turns_and_moves_places(tmp_path, stated, uv, moved):
    gltf = textured(uv=np.array(uv, np.float32), extensions={"KHR_texture_transform": stated})
    mesh = painted(tmp_path / "m.glb", gltf.glb())
    true = np.array(moved)[HALVES] * [1, -1] + [0, 1]
    np.testing.assert_allclose(mesh.texture.places, true, atol=1e-6)
    gltf = textured(
        uv=np.array(uv, np.float32),
        texCoord=7,
        extensions={"KHR_texture_transform": stated | {"texCoord": 1}},
    )
    again = painted(tmp_path / "m.glb", gltf.glb())
    np.testing.assert_array_equal(again.texture.places, mesh.texture.places)


LIGHT = np.array([[0, 0.2, 1], [1, 0, 0.5], [0.4, 1, 0], [0.6, 0.6, 0.6]])


def at_vertices(light, **more):
    """A square of two triangles with linear light at its vertices."""
    gltf = Gltf()
    square = gltf.primitive(QUAD, HALVES, **more)
    square["attributes"]["COLOR_0"] = gltf.array(light)
    gltf.document |= {"materials": [material(255, 128, 0)], "meshes": [{"primitives": [square]}]}
    gltf.document |= {"nodes": [{"mesh": 0}]}
    gltf.document["scenes"][0]["nodes"] = [0]
    return gltf


@pytest.mark.parametrize("columns", [3, 4])
@pytest.mark.parametrize("kind", [np.float32, np.uint8, np.uint16])
@pytest.mark.parametrize("factor", [None, np.array([255, 128, 0]) / 255.0])
def test_vertices_have_colours_that_multiply_the_material(tmp_path, columns, kind, factor):
    one = 1 if kind is np.float32 else np.iinfo(kind).max
    light = (LIGHT * one).astype(kind)
    light = light if columns == 3 else np.c_[light, np.zeros(4, kind)]
    gltf = at_vertices(light, **({} if factor is None else {"material": 0}))
    mesh = painted(tmp_path / "m.glb", gltf.glb())
    corners = srgb(light[:, :3].astype(np.float64) / one)[HALVES]
    corners = corners * (1.0 if factor is None else factor)
    np.testing.assert_allclose(mesh.colours, 255 * corners.mean(axis=1), atol=0.51)
    weights = np.array([[1, 0, 0], [0, 0, 1], [0.5, 0.25, 0.25], [1 / 3] * 3])
    for face in (0, 1):
        seen = mesh.texture.colours(np.full(4, face), weights)
        np.testing.assert_allclose(seen, 255 * weights @ corners[face], atol=0.51)


def test_alike_vertices_are_a_colour_of_the_face_and_pictures_are_tinted(tmp_path):
    alike = at_vertices(np.float32(LIGHT[[1] * 4]))
    assert painted(tmp_path / "m.glb", alike.glb()).texture is None
    gltf = textured()
    gltf.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = gltf.array(
        np.float32([[1, 1, 1], [1, 1, 1], [0, 1, 1], [0, 1, 1]])
    )
    mesh = painted(tmp_path / "m.glb", gltf.glb())
    seen = mesh.texture.colours(np.array([0]), np.array([[0.4, 0.35, 0.25]]))  # at 0.6, 0.25
    np.testing.assert_allclose(seen, [[75, 50, 100]], atol=1)
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 20_000)
    for face in (0, 1):
        mean = mesh.texture.colours(np.full(len(weights), face), weights).mean(axis=0)
        np.testing.assert_allclose(mesh.colours[face], mean, atol=2.0)


WRONG = {
    "colours of two": {"type": "VEC2"},
    "colours of a kind of their own": {"componentType": 5122},
    "colours beyond the buffer": {"byteOffset": 40},
    "colours without a view": {"bufferView": None},
    "fewer colours": {"count": 2},
    "colours without end": {"count": 2**60},
    "sparse colours": {"sparse": {"count": 1}},
    "no type": {"type": ""},
}


@pytest.mark.parametrize("edit", WRONG.values(), ids=list(WRONG))
def test_colours_of_vertices_that_lie_leave_the_mesh_as_it_is(tmp_path, edit):
    gltf = at_vertices(np.float32(LIGHT), material=0)
    gltf.document["accessors"][-1] |= edit
    (tmp_path / "m.glb").write_bytes(gltf.glb())
    if refusal := refused(tmp_path / "m.glb"):  # trimesh reads all accessors
        with looks.with_looks(wanted=True):
            assert refused(tmp_path / "m.glb") == refusal
        return
    note = "1 materials or textures not read: 'm.glb'"
    assert coloured(tmp_path / "m.glb")[1:] == (None, (note,))


def test_colours_of_vertices_that_are_no_numbers_are_black_or_bounded(tmp_path):
    light = np.float32([[np.nan, -1, np.inf]] * 3 + [[1, -np.inf, 3]])
    assert coloured_in(tmp_path, at_vertices(light)) == [[0, 0, 255], [85, 0, 255]]


def coloured_in(folder, gltf):
    (folder / "m.glb").write_bytes(gltf.glb())
    return coloured(folder / "m.glb")[1]


@pytest.mark.parametrize(
    "stated",
    [
        *[{"offset": wrong} for wrong in ([1], None, "ab", [1e999, 0], [10**400, 0], {})],
        *[{"rotation": wrong} for wrong in ([1], None, "ab", float("nan"), 1e300, 10**400)],
        *[{"scale": wrong} for wrong in (2, [float("nan"), 1], [1, 2, 3], [[1], 2])],
        [1],
        "ab",
    ],
)
def test_texture_transforms_that_lie_leave_the_mesh_as_it_is(tmp_path, stated):
    gltf = textured(extensions={"KHR_texture_transform": stated})
    (tmp_path / "m.glb").write_bytes(gltf.glb())
    note = "1 materials or textures not read: 'm.glb'"
    assert coloured(tmp_path / "m.glb")[1:] == (None, (note,))


def test_places_far_away_show_the_factor(tmp_path):
    far = np.float32([[np.inf, 0], [0, np.nan], [3e38, 0], [0, 0]])
    stated = {"scale": [1e308, 1e308]}
    for more in ({}, {"extensions": {"KHR_texture_transform": stated}}):
        assert coloured_in(tmp_path, textured(uv=far, **more)) == [[255, 128, 255]] * 2


def test_the_layout_is_that_of_pyrender(tmp_path):
    """Read from the same files by trimesh, and drawn by OpenGL without light."""
    if reason := why_not("opengl"):
        pytest.skip(reason)
    import pyrender  # noqa: PLC0415 - optional
    from OpenGL import GL  # noqa: PLC0415 - comes with it

    codes = np.array([[1, 2, 4, 7], [6, 5, 3, 1], [2, 7, 1, 5], [4, 3, 6, 2]])
    board = np.uint8(255 * (codes[..., None] >> [2, 1, 0] & 1))
    (tmp_path / "b.png").write_bytes(png(Image.fromarray(board)))
    (tmp_path / "m.mtl").write_text("newmtl b\nKd 1 1 1\nmap_Kd b.png\n")
    corners = np.array([[-0.4, -0.1, -0.4], [0.4, 0.1, -0.4], [0.4, 0.1, 0.4], [-0.4, -0.1, 0.4]])
    text = quads(("b", 1, square(1, 0)[::-1]))
    for old, new in zip(square(1, 0)[::-1], corners[[0, 3, 2, 1]], strict=True):
        text = text.replace("v {} {} {}\n".format(*old), "v {} {} {}\n".format(*new))
    mesh = painted(tmp_path / "m.obj", text.encode())
    flat = LabelledMesh(mesh.vertices, mesh.faces, np.zeros(2, np.uint8))
    paint = Paint(mesh.colours, mesh.texture, mesh.triangles)

    def shown(face, points):
        return paint.at(face, points, flat.part_of_face[face], np.eye(4)[None])

    views = cameras("pinhole", count=6)
    closed = np.zeros(2, bool)
    ours = images(flat, views, ("rgba",), closed=closed, colours=shown)["rgba"]
    model = pyrender.Mesh.from_trimesh(trimesh.load(tmp_path / "m.obj", force="mesh"), smooth=False)
    nearest = pyrender.Sampler(magFilter=GL.GL_NEAREST, minFilter=GL.GL_NEAREST)
    model.primitives[0].material.baseColorTexture.sampler = nearest
    model.primitives[0].material.doubleSided = True
    scene = pyrender.Scene(bg_color=[0, 0, 0, 0])
    scene.add(model)
    renderer = pyrender.OffscreenRenderer(views.width, views.height)
    compared = 0
    for k in range(len(views)):
        camera = pyrender.IntrinsicsCamera(*views.intrinsics[k], znear=0.1, zfar=10.0)
        T = np.linalg.inv(views.T_camera_world[k]) @ np.diag([1, -1, -1, 1])
        node = scene.add(camera, pose=T)
        theirs, depth = renderer.render(scene, flags=pyrender.RenderFlags.FLAT)
        scene.remove_node(node)
        code = np.where(ours[k][..., 3] > 0, (ours[k][..., :3] > 64) @ [4, 2, 1], 0)
        other = np.where(depth > 0, (theirs > 64) @ [4, 2, 1], 0)
        around = np.stack([np.roll(code, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
        inner = (around == code).all(axis=0) & (code > 0) & (other > 0)
        if inner.sum() > 100:  # not where the square is seen from beside
            assert (code == other)[inner].mean() >= 0.97
        compared += inner.sum()
    renderer.delete()
    assert compared > 3000
