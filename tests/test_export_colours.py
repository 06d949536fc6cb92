"""Colours of exports, face by face, by each format's own reader, beside those of the model."""

import io
import json
import re
import struct

import numpy as np
import pytest
import trimesh
import yourdfpy
from PIL import Image
from test_colours import BOX, MTL, URDF, png

import articugen as ag
from articugen.core.colours import colour_of, linear, plain_colour
from articugen.meshes.marching_cubes import zero_level
from articugen.meshes.painting import MOST_COLOURS, coloured_like, few, looks
from articugen.meshes.simpler import simpler
from tests.golden import CABINET

RECIPE = {
    "articulation": {"states": 1}, "views": {"count": 30, "resolution": 128},
    "sampling": {"grids": [], "surface_points": 256, "uniform_points": 64, "near_points": 64},
}  # fmt: skip
RED, GREEN, BLUE = [255, 0, 0], [51, 153, 0], [0, 0, 255]
FORMATS = ("glb", "usd", "mjcf", "urdf")


def data_set(folder, files, category="slide"):
    """A data set of the model of these files, whose recipe asks for no colours."""
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        data = content if isinstance(content, bytes) else content.encode()
        (folder / name).write_bytes(data)
    source = str(folder / next(name for name in files if name.endswith(".urdf")))
    ag.generate(category, source=source, out=folder / "data", recipe=RECIPE, jobs=0)
    return folder / "data" / category


@pytest.fixture(scope="module")
def slide(tmp_path_factory):
    files = {"slide.urdf": URDF, "box.obj": BOX, "box.mtl": MTL}
    return data_set(tmp_path_factory.mktemp("slide"), files)


def exported(data, to, folder):
    """The one file of an export that names all its others."""
    if to == "usd":
        pytest.importorskip("pxr", reason="make exporters installs it")
    ends = {"glb": ".glb", "usd": ".usdc", "mjcf": ".xml", "urdf": ".urdf"}
    ag.export(data, to, folder / to, resolution=64)
    (path,) = folder.glob(f"{to}/**/*{ends[to]}")
    return path


@pytest.mark.parametrize("to", FORMATS)
def test_a_part_without_a_shape_is_a_node_alone_or_its_object_is_left_out(tmp_path, to):
    """One model in colours, one without."""
    joint = URDF[URDF.index("  <joint") : URDF.index("</robot>")]
    joint = joint.replace('"slide"', '"lift"').replace('"wall"', '"sled"')
    hung = URDF.replace('child link="bolt"', 'child link="sled"')
    hung = hung.replace("</robot>", f'<link name="sled"/>{joint}</robot>')
    plain = re.sub(r"(?s)<material.*?</material>|<material name=.blue./>", "", hung)
    for number, text in enumerate((hung, plain)):
        files = {"slide.urdf": text, "box.obj": BOX, "box.mtl": MTL if text is hung else ""}
        data = data_set(tmp_path / str(number), files)
        if to == "glb":
            said, _ = chunks(exported(data, to, data))
            assert [len(said["nodes"]), len(said["meshes"])] == [4, 2]
            continue
        with pytest.raises(ag.ArticugenError, match="slide: part 'sled' has no shape, and so no"):
            exported(data, to, data)


def displayed(linear):
    """sRGB bytes of linear light, which must be bytes all but exactly."""
    x = np.asarray(linear, np.float64)
    x = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return whole(255.0 * x)


def whole(values):
    np.testing.assert_allclose(values, np.round(values), atol=1e-3)
    return np.round(values).astype(int)


def chunks(path):
    """What a GLB says, and its binary part."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def shown(picture, places, weights=(1 / 3, 1 / 3, 1 / 3)):
    """The colours (n, 3) of a picture (h, w, 3) between places (n, 3, 2) of corners, v up."""
    height, width, _ = picture.shape
    u, v = np.moveaxis(np.einsum("k,nkj->nj", weights, places), 1, 0)
    return picture[((1.0 - v) * height).astype(int) % height, (u * width).astype(int) % width]


def of_file(data):
    return np.array(Image.open(data).convert("RGB")).astype(int)


def in_gltf(path, weights=(1 / 3, 1 / 3, 1 / 3)):
    """Of each part the corners (F, 3, 3) of its faces, before it is turned y up, and (F, 3), the
    colours there between them."""
    scene, blob = chunks(path)

    def array(number, dtype):
        accessor = scene["accessors"][number]
        view = scene["bufferViews"][accessor["bufferView"]]
        flat = np.frombuffer(blob[view["byteOffset"] :][: view["byteLength"]], dtype)
        return flat.reshape(accessor["count"], -1)

    for mesh in scene["meshes"]:
        triangles, colours = [], []
        for primitive in mesh["primitives"]:
            vertices = array(primitive["attributes"]["POSITION"], np.float32)
            how = scene["materials"][primitive["material"]]["pbrMetallicRoughness"]
            assert how["metallicFactor"] == 0.0
            if "baseColorTexture" in how:
                triangles.append(vertices.reshape(-1, 3, 3))
                texture = scene["textures"][how["baseColorTexture"]["index"]]
                view = scene["bufferViews"][scene["images"][texture["source"]]["bufferView"]]
                picture = blob[view["byteOffset"] :][: view["byteLength"]]
                places = array(primitive["attributes"]["TEXCOORD_0"], np.float32).reshape(-1, 3, 2)
                places = places * [1, -1] + [0, 1]  # v is down
                colours.append(shown(of_file(io.BytesIO(picture)), places, weights))
                continue
            triangles.append(vertices[array(primitive["indices"], np.uint32).reshape(-1, 3)])
            assert how["baseColorFactor"][3] == 1.0
            colours.append(np.tile(displayed(how["baseColorFactor"][:3]), (len(triangles[-1]), 1)))
        yield np.concatenate(triangles), np.concatenate(colours)


def in_usd(path, weights=(1 / 3, 1 / 3, 1 / 3)):
    from pxr import Usd, UsdGeom, UsdShade  # noqa: PLC0415

    stage = Usd.Stage.Open(str(path))
    for prim in (prim for prim in stage.Traverse() if prim.GetName() == "visual"):
        mesh, binding = UsdGeom.Mesh(prim), UsdShade.MaterialBindingAPI(prim)
        faces = np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3))
        bound, subsets = np.zeros((len(faces), 3)), binding.GetMaterialBindSubsets()
        some = [(np.arange(len(faces)), prim)] if not subsets else []
        some += [(np.array(s.GetIndicesAttr().Get()), s.GetPrim()) for s in subsets]
        assert sorted(np.concatenate([which for which, _ in some])) == list(range(len(faces)))
        laid = {}
        for which, of in some:
            material, _ = UsdShade.MaterialBindingAPI(of).ComputeBoundMaterial()
            diffuse = material.ComputeSurfaceSource()[0].GetInput("diffuseColor")
            bound[which] = diffuse.Get()
            if diffuse.HasConnectedSource():
                texture = UsdShade.Shader(diffuse.GetConnectedSource()[0].GetPrim())
                assert texture.GetInput("sourceColorSpace").Get() == "sRGB"
                reader = UsdShade.Shader(texture.GetInput("st").GetConnectedSource()[0].GetPrim())
                places = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(reader.GetInput("varname").Get())
                places = np.reshape(places.ComputeFlattened(), (-1, 3, 2))[which]
                picture = of_file(texture.GetInput("file").Get().resolvedPath)
                laid[tuple(which)] = shown(picture, places, weights)
        drawn = np.array(mesh.GetDisplayColorPrimvar().ComputeFlattened())
        np.testing.assert_array_equal(np.broadcast_to(drawn, bound.shape), bound)
        colours = displayed(bound)
        for which, some in laid.items():
            colours[list(which)] = some
        yield np.array(mesh.GetPointsAttr().Get())[faces], colours


def in_mujoco(path, weights=(1 / 3, 1 / 3, 1 / 3)):
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    parts = {}
    for geom in np.flatnonzero(model.geom_group == 2):
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        turn = data.geom_xmat[geom].reshape(3, 3)
        vertices = model.mesh_vert[start : start + count] @ turn.T + data.geom_xpos[geom]
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        triangles = vertices[model.mesh_face[start : start + count]]
        if (material := model.geom_matid[geom]) < 0:
            colours = np.tile(whole(255.0 * model.geom_rgba[geom, :3]), (count, 1))
        else:
            assert (model.mat_rgba[material] == 1.0).all()
            number = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
            width, height = model.tex_width[number], model.tex_height[number]
            pixels = model.tex_data[model.tex_adr[number] :][: 3 * width * height]
            places = model.mesh_texcoord[model.mesh_texcoordadr[mesh] :]
            places = places[model.mesh_facetexcoord[start : start + count]]
            picture = pixels.reshape(height, width, 3).astype(int)
            colours = shown(picture, places * [1, -1] + [0, 1], weights)  # v is down there
        parts.setdefault(model.geom_bodyid[geom], []).append((triangles, colours))
    for pieces in parts.values():
        yield tuple(np.concatenate(arrays) for arrays in zip(*pieces, strict=True))


def in_urdf(path, weights=(1 / 3, 1 / 3, 1 / 3)):
    robot = yourdfpy.URDF.load(str(path))
    for link in robot.robot.links:
        (visual,) = link.visuals
        scene = trimesh.load_scene(path.parent / visual.geometry.mesh.filename)
        pieces = scene.dump()
        if not visual.material:
            colours = [
                np.tile(how.diffuse[:3], (len(piece.faces), 1)) if how.image is None
                else shown(np.array(how.image.convert("RGB")).astype(int), uv[piece.faces], weights)
                for piece in pieces
                for how, uv in [(piece.visual.material, piece.visual.uv)]
            ]  # fmt: skip
        else:  # of the URDF, where the mesh has none
            assert not (path.parent / visual.geometry.mesh.filename).with_suffix(".mtl").exists()
            colour = whole(255.0 * visual.material.color.rgba[:3])
            colours = [np.tile(colour, (len(piece.faces), 1)) for piece in pieces]
        yield np.concatenate([piece.triangles for piece in pieces]), np.concatenate(colours)


READ = dict(zip(FORMATS, (in_gltf, in_usd, in_mujoco, in_urdf), strict=True))


@pytest.mark.parametrize("to", FORMATS)
def test_each_face_has_the_colour_of_the_model_s_face_there(slide, tmp_path, to):
    wall, bolt = READ[to](exported(slide, to, tmp_path))
    assert (bolt[1] == BLUE).all()
    triangles, colours = wall
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(across, axis=1) / 2.0
    flat = np.abs(across).max(axis=1) > 1.999 * area  # not cut off an edge
    red = (across[:, 0] < -area) | (np.abs(across[:, 1]) > area)
    np.testing.assert_array_equal(colours[flat], np.where(red[:, None], RED, GREEN)[flat])
    assert area[flat].sum() > 5.5
    assert area[(colours == RED).all(axis=1)].sum() == pytest.approx(3.0, rel=0.03)


def test_parts_of_several_colours_weigh_in_mujoco_what_they_do_in_urdf(slide, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="make exporters installs it")
    model = mujoco.MjModel.from_xml_path(str(exported(slide, "mjcf", tmp_path)))
    robot = yourdfpy.URDF.load(str(exported(slide, "urdf", tmp_path)))
    links = [link.inertial for link in robot.robot.links]
    np.testing.assert_allclose(model.body_mass[1:], [link.mass for link in links], rtol=1e-6)
    tensors = [np.linalg.eigvalsh(link.inertia) for link in links]
    np.testing.assert_allclose(np.sort(model.body_inertia[1:]), tensors, rtol=1e-5)


@pytest.mark.parametrize("to", ["mjcf", "urdf"])
def test_what_is_exported_has_its_colours_as_a_source(slide, tmp_path, to):
    maker = ag.Maker(ag.load(exported(slide, to, tmp_path)), {
        **RECIPE, "sampling": {**RECIPE["sampling"], "surface_color": True},
    })  # fmt: skip
    row = maker[0].instance
    assert {tuple(c) for c in row.surface_color[row.surface_part == 1]} == {tuple(BLUE)}
    assert {tuple(c) for c in row.surface_color[row.surface_part == 0]} == {
        tuple(RED),
        tuple(GREEN),
    }


def test_a_model_without_colours_has_those_of_our_pictures_and_states_none(tmp_path):
    data = data_set(tmp_path / "m", {"cabinet.urdf": CABINET}, "boxes")
    scene, _ = chunks(exported(data, "glb", tmp_path))
    for k, material in enumerate(scene["materials"]):
        factor = material["pbrMetallicRoughness"]["baseColorFactor"]
        assert factor == [*linear(colour_of(k)).tolist(), 1.0]
    assert [mesh["primitives"][0]["material"] for mesh in scene["meshes"]] == [0, 1, 2]
    for to in ("mjcf", "urdf"):
        text = exported(data, to, tmp_path).read_text()
        assert "rgba" not in text
    assert not list(tmp_path.rglob("*.mtl"))


def test_materials_may_change_where_data_have_no_colours_and_shapes_may_not(tmp_path):
    folder = tmp_path / "m"
    data = data_set(folder, {"slide.urdf": URDF, "box.obj": BOX, "box.mtl": MTL})
    (folder / "box.mtl").write_text(MTL.replace("Kd 1 0 0", "Kd 0 0 1"))
    wall, _ = in_gltf(exported(data, "glb", tmp_path))
    assert np.unique(wall[1], axis=0).tolist() == [BLUE, GREEN]
    (folder / "box.obj").write_text(BOX.replace("v 1 1 1", "v 1 1 1.5"))
    with pytest.raises(ag.ArticugenError, match="have changed since"):
        exported(data, "mjcf", tmp_path)


def test_bundled_objects_have_plain_colours(tmp_path):
    ag.generate("oven", out=tmp_path, recipe=RECIPE, objects=1, jobs=0)
    parts = in_gltf(exported(tmp_path / "oven", "glb", tmp_path))
    colours = [np.unique(part, axis=0).tolist() for _, part in parts]
    assert colours == [[list(plain_colour("oven", name))] for name in ("body", "door")]


BOARD = np.random.default_rng(0).integers(0, 256, (30, 30, 3)).astype(np.uint8)
WEIGHTS = np.random.default_rng(1).dirichlet([1, 1, 1], 40)


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A box with a lid of 30 x 30 fields, each another colour, in shades by a third of the light; a
    material's name may do harm."""
    n = np.arange(31)
    lines = [BOX.replace("box.mtl", "t.mtl").replace("f 2 6 8 4\n", "usemtl ../<&\"'> $(x)")]
    lines += [f"v {x / 30} {y / 30} 1\nvt {x / 30} {y / 30}" for y in n for x in n]
    for at in (31 * y + x + 1 for y in range(30) for x in range(30)):
        lines.append("f " + " ".join(f"{k + 8}/{k}" for k in (at, at + 1, at + 32, at + 31)))
    mtl = MTL + "newmtl ../<&\"'> $(x)\nKd 0.6 1 1\nmap_Kd t.png\n"
    files = {"slide.urdf": URDF, "box.obj": "\n".join(lines), "t.mtl": mtl}
    folder = tmp_path_factory.mktemp("board") / "m"
    return data_set(folder, {**files, "t.png": png(Image.fromarray(BOARD))})


@pytest.mark.parametrize("to", FORMATS)
def test_pictures_lie_where_the_model_s_lie(board, tmp_path, to):
    path, asked = exported(board, to, tmp_path), 0
    for weights in WEIGHTS:
        (triangles, colours), bolt = READ[to](path, weights)
        assert (bolt[1] == BLUE).all()
        lid = (np.abs(triangles[:, :, 2] - triangles[..., 2].max()) < 1e-3).all(axis=1)
        at = np.einsum("k,nkj->nj", weights, triangles[lid])[:, :2]
        at = at - triangles[..., :2].min(axis=(0, 1))
        x, y = np.moveaxis(30.0 * at, 1, 0)
        inside = (np.abs(at * 30 - np.round(at * 30)) > 0.1).all(axis=1)  # of a field, and the lid
        inside &= (at > 0.02).all(axis=1) & (at < 0.98).all(axis=1)
        fields = BOARD[29 - y[inside].astype(int), x[inside].astype(int)] * [0.6, 1.0, 1.0]
        np.testing.assert_allclose(colours[lid][inside], fields, atol=0.51)
        asked += int(inside.sum())
    assert asked > 20


def test_a_picture_goes_round_a_curved_wall(tmp_path):
    """A tube of 48 sides, whose colours go round with the angle and up with z; its wall is fused,
    for it is open."""
    n, (rows, columns) = 48, np.mgrid[:256, :256]
    lines, angle = ["mtllib box.mtl", "usemtl t"], 2.0 * np.pi * np.arange(n + 1) / n
    for k, (x, y) in enumerate(0.5 + 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)):
        lines += [f"v {x} {y} {z}\nvt {k / n} {z}" for z in (0, 1)]
    for a, b, c, d in ((2 * k + 1, 2 * k + 3, 2 * k + 4, 2 * k + 2) for k in range(n)):
        lines.append(f"f {a}/{a} {b}/{b} {c}/{c} {d}/{d}")
    turn = 2.0 * np.pi * columns / 256
    picture = [128 + 127 * np.sin(turn), 128 + 127 * np.cos(turn), 255 - rows]
    picture = png(Image.fromarray(np.stack(picture, axis=-1).astype(np.uint8)))
    mtl = "newmtl t\nKd 1 1 1\nmap_Kd t.png\n"
    files = {"slide.urdf": URDF, "box.obj": "\n".join(lines) + "\n", "box.mtl": mtl}
    path = exported(data_set(tmp_path / "m", {**files, "t.png": picture}), "glb", tmp_path)
    asked = 0
    for weights in WEIGHTS:
        (triangles, colours), _ = in_gltf(path, weights)
        x, y, z = np.einsum("k,nkj->jn", weights, triangles) - [[0.5], [0.5], [0.0]]
        side = np.flatnonzero((np.hypot(x, y) > 0.45) & (np.abs(z - 0.5) < 0.47))
        turn = np.arctan2(y, x)[side]
        true = [128 + 127 * np.sin(turn), 128 + 127 * np.cos(turn), 255 * z[side]]
        np.testing.assert_allclose(colours[side], np.transpose(true), atol=8)
        asked += len(side)
    assert asked > 1000


def test_names_of_materials_are_ours(board, tmp_path):
    exported(board, "urdf", tmp_path)
    text = "".join(next(tmp_path.rglob(f"part_0.{end}")).read_text() for end in ("obj", "mtl"))
    names = re.findall("(?:newmtl|usemtl) (.*)", text)
    assert len(names) == 6
    assert all(re.fullmatch("[0-9a-f]{6}", name) for name in names)


def test_what_a_camera_sees_has_the_colours_of_the_surface_there(slide, tmp_path):
    recipe = {
        **RECIPE,
        "sampling": {**RECIPE["sampling"], "surface_points": 4096, "surface_color": True},
    }  # fmt: skip
    source = str(slide.parent.parent / "slide.urdf")
    ag.generate("slide", source=source, out=tmp_path, recipe=recipe, jobs=0)
    ag.export(tmp_path / "slide", "opalign", tmp_path / "opalign")
    row = ag.open(tmp_path / "slide")[0]
    for path in tmp_path.glob("opalign/slide/*/*/0000/input_2/*.npz"):
        view = np.load(path, allow_pickle=True)["arr_0"].item()
        colours = np.round(255.0 * view["color"]).astype(int)
        assert (colours[view["segmentation"] == 2] == BLUE).all()
        on = view["segmentation"] == 1
        points = row.partial.points[int(path.stem)][on]
        wall = row.surface.points[row.surface.part == 0]
        low, high = (points - wall.min(axis=0)).T, (wall.max(axis=0) - points).T
        to_side = np.abs(np.stack([low[0], low[1], high[1]]))
        to_others = np.abs(np.stack([high[0], low[2], high[2]]))
        red = to_side.min(axis=0) < to_others.min(axis=0)
        clear = np.abs(to_side.min(axis=0) - to_others.min(axis=0)) > 0.15 * np.ptp(wall[:, 0])
        np.testing.assert_array_equal(colours[on][clear], np.where(red[:, None], RED, GREEN)[clear])
        assert clear.sum() > 50


def test_few_colours_stay_and_many_become_means():
    rng = np.random.default_rng(0)
    some = rng.integers(0, 256, (MOST_COLOURS, 3)).astype(np.uint8)
    assert few(some, np.ones(len(some))) is some
    many = rng.integers(0, 256, (4000, 3)).astype(np.uint8)
    order = rng.permutation(len(many))
    fewer = few(many, np.ones(len(many)))
    assert 8 <= len(np.unique(fewer, axis=0)) <= MOST_COLOURS
    assert np.abs(fewer.astype(int) - many).mean() < 32
    np.testing.assert_array_equal(few(many[order], np.ones(len(many))), fewer[order])
    pair = np.repeat(np.array([[0, 0, 0], [4, 0, 0]], np.uint8), [1, 1], axis=0)
    both = np.concatenate([pair, np.arange(100, 250, 2, np.uint8)[:, None].repeat(3, 1)])
    weights = np.r_[3.0, 1.0, np.ones(75)]
    assert few(both, weights)[:2].tolist() == [[1, 0, 0]] * 2


def test_borders_of_colours_are_where_those_of_the_model_are():
    grid = -np.ones((40, 40, 40))
    grid[5:35, 5:35, 10:20] = 1.0
    mesh = zero_level(grid)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    x = 0.5 * low[0] + 0.5 * high[0] + 0.0123
    halves = [
        trimesh.creation.box(bounds=b) for b in ((low, [x, *high[1:]]), ([x, *low[1:]], high))
    ]
    triangles = np.concatenate([half.triangles for half in halves])
    keep = ~(np.abs(triangles[..., 0] - x) < 1e-9).all(axis=1)
    colours = np.repeat(np.array([RED, BLUE], np.uint8), [12, 12], axis=0)
    cut = coloured_like(mesh, triangles[keep], colours[keep])
    for painted in (cut, simpler(cut, 1e-4)):
        assert trimesh.Trimesh(painted.vertices, painted.faces, process=False).is_watertight
        red, blue = looks(painted)
        assert [red.colour, blue.colour] == ["#ff0000", "#0000ff"]
        assert painted.triangles[blue.faces][..., 0].min() > x - 2e-4
        assert painted.triangles[red.faces][..., 0].max() < x + 2e-4
    plain = simpler(mesh, 1e-4)
    assert len(plain.faces) < len(painted.faces) < 2 * len(plain.faces)
