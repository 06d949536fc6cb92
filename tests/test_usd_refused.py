"""USD models that cannot be used: each in one sentence that names file and cure."""

import re
import sys
import zipfile
from functools import partial
from pathlib import Path

import pytest
from usd_models import LINK, artvip, at, body, joint, text

from articugen.core.errors import InvalidSource, installing
from articugen.sources import readers
from articugen.sources.source import load_path, open_source
from articugen.sources.usd import apart, layers, model

BASE, DOOR = body("base"), body("door")
HINGE = joint("Revolute")


def hinged(more: str) -> list[str]:
    """A door on a hinge of which more is said."""
    return [BASE, DOOR, joint("Revolute", more=more)]


MESH = (
    'def Mesh "m"\n{{\npoint3f[] points = [{0}]\nint[] faceVertexCounts = [{1}]\n'
    "int[] faceVertexIndices = [{2}]\n}}\n"
)
POINTS = "(0, 0, 0), (1, 0, 0), (0, 1, 0)"


def sampled(name: str, kind: str) -> str:
    return f"{kind} {name}.timeSamples = {{\n0: (0, 0, 0),\n1: (1, 0, 0),\n}}\n"


ANIMATED = sampled("xformOp:translate", "double3") + (
    'uniform token[] xformOpOrder = ["xformOp:translate"]'
)


def scaled(scale: str) -> str:
    return f'float3 xformOp:scale = {scale}\nuniform token[] xformOpOrder = ["xformOp:scale"]'


TURNED_IN_SCALE = body(
    "base", 'def Xform "x" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])\n{\n'
    'float xformOp:rotateZ = 45\nuniform token[] xformOpOrder = ["xformOp:rotateZ"]\n'
    'def Cube "c"\n{\n}\n}\n', scaled("(1, 2, 1)"),
)  # fmt: skip

BAD = {
    "no shape": (['def Xform "x"\n{\n}\n'], "shows no shape; add meshes"),
    "no body": ([BASE, joint("Revolute", "", "")], "/root/joint: joins no two rigid bodies"),
    "one body twice": ([BASE, joint("Revolute", "base", "base")], "joins no two rigid bodies"),
    "no such body": ([BASE, HINGE], "its body1 '/root/door' is not there; correct its name"),
    "what moves is no body": (
        ['def Cube "base"\n{\n}\ndef Cube "door"\n{\n}\n', HINGE],
        "give them the PhysicsRigidBodyAPI",
    ),
    "a ball joint": ([BASE, DOOR, joint("Spherical")], "is a 'PhysicsSphericalJoint', and only"),
    "any joint": ([BASE, DOOR, joint("")], "is a 'PhysicsJoint', and only fixed, revolute"),
    "a loop": (
        [BASE, DOOR, body("lid"), HINGE, joint("Revolute", "door", "lid", name="b"),
         joint("Revolute", "lid", "base", name="c")],
        "/root/c: closes a loop of joints, and only trees are read; remove it",
    ),
    "a loop of two": ([BASE, DOOR, HINGE, joint("Prismatic", name="b")], "closes a loop"),
    "frames apart": (
        hinged("point3f physics:localPos0 = (3, 0, 0)"),
        "where its two bodies have it is 3 m and 0 degrees apart; correct localPos",
    ),
    "frames askew": (hinged("quatf physics:localRot0 = (0.8, 0, 0, 0.6)"), "degrees apart"),
    "an axis of its own": (
        hinged('uniform token physics:axis = "W"'),
        "its axis is 'W'; make it X, Y or Z",
    ),
    "a rotation of nothing": (
        hinged("quatf physics:localRot1 = (0, 0, 0, 0)"),
        "its localRot1 is no rotation",
    ),
    "a joint at nan": (
        hinged("point3f physics:localPos0 = (nan, 0, 0)"),
        "its localPos0 is missing, not finite or beyond",
    ),
    "a limit of nan": (hinged("float physics:lowerLimit = nan"), "its lowerLimit is not a number"),
    "an animated body": ([body("base", place=ANIMATED)], "xformOp:translate changes with time"),
    "animated points": (
        ['def Mesh "m"\n{\npoint3f[] points.timeSamples = {\n0: [(0, 0, 0)],\n}\n}\n'],
        "points changes with time; export the model without animation",
    ),
    "an animated joint": (hinged(sampled("physics:localPos0", "point3f")), "changes with time"),
    "value clips": (
        ['def Xform "x" (\nclips = {\ndictionary default = {\nasset[] assetPaths = '
         '[@./a.usd@]\n}\n}\n)\n{\n}\n', BASE],
        "/root/x: has value clips; export",
    ),
    "a place at infinity": ([body("base", place=at(float("inf"), 0, 0))], "its translate is"),
    "far away": ([body("base", place=at(2e6, 0, 0))], "reaches beyond 1,000,000 m; correct its"),
    "scaled to nothing": ([body("base", place=scaled("(1, 0, 1)"))], "is scaled to nothing"),
    "a sheared body": (
        [TURNED_IN_SCALE, joint("Fixed", "base", "base/x")],
        "is sheared, for it is turned inside of a scale",
    ),
    "an unknown step": (
        [body("base", place='double3 xformOp:wobble = (1, 1, 1)\n'
              'uniform token[] xformOpOrder = ["xformOp:wobble"]')],
        "names steps that are not there or not known: 'xformOp:wobble'; flatten",
    ),
    "a step that is not there": (
        [body("base", place='uniform token[] xformOpOrder = ["xformOp:scale"]')],
        "names steps that are not there",
    ),
    "a mesh without faces": ([MESH.format(POINTS, "", "")], "/root/m: has no triangle; remove it"),
    "an empty mesh": (['def Mesh "m"\n{\n}\n'], "/root/m: has no triangle"),
    "a point that is not there": ([MESH.format(POINTS, "3", "0, 1, 3")], "names a point that is"),
    "a point before the first": ([MESH.format(POINTS, "3", "0, 1, -1")], "names a point that is"),
    "too few indices": ([MESH.format(POINTS, "4", "0, 1, 2")], "have 4 corners and its indices"),
    "a negative count": ([MESH.format(POINTS, "-3, 6", "0, 1, 2")], "its faces have 3 corners"),
    "points at nan": ([MESH.format(POINTS.replace("1", "nan"), "3", "0, 1, 2")], "not finite"),
    "a cube of nothing": (['def Cube "c"\n{\ndouble size = 0\n}\n'], "its size is 0; make it"),
    "a sphere of nan": (['def Sphere "c"\n{\ndouble radius = nan\n}\n'], "its radius is missing"),
    "points that instance": (['def PointInstancer "p"\n{\n}\n', BASE], "has instances by points"),
    "a skin": (['def SkelRoot "p"\n{\n}\n', BASE], "has skinned meshes, which are not read"),
    "itself": (['def "x" (references = </root>)\n{\n}\n', BASE], "its layers do not fit together"),
    "a prim that is not there": (
        ['def "x" (references = </none>)\n{\n}\n', BASE],
        r"do not fit together \(Unresolved reference prim path",
    ),
    "too long a name": ([body("b" * 256), BASE], "has more than 255 bytes; shorten it"),
    "too many bodies": ([body(f"b{k}") for k in range(2_000)], "more than 2,000 rigid bodies"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_model_is_refused_with_its_reason(tmp_path, case):
    pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")
    prims, reason = BAD[case]
    path = tmp_path / "m.usda"
    path.write_text(text(*prims))
    with pytest.raises(InvalidSource, match=reason) as refused:
        model.read_model(path, tmp_path)
    said = str(refused.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    assert "anon:" not in said


NAMES = {
    "https://example.org/a.usda": "on the network",
    "omniverse://localhost/a.usda": "on the network",
    "file:///tmp/a.usda": "on the network",
    "/etc/passwd": "an absolute path",
    "C:/models/a.usda": "an absolute path",
    "../outside.usda": "leads out of",
    "../../../../etc/passwd": "leads out of",
    "sub/../../outside.usda": "leads out of",
    "link.usda": "leads out of",
    "package.usdz[a.usda]": "nothing outside of the model is read",
    "a.usda:SDF_FORMAT_ARGS:target=x": "nothing outside of the model is read",
    '`"${HOME}/a.usda"`': "by an expression",
    "missing.usda": "its layer 'missing.usda' is missing; put it there",
    "folder": "its layer 'folder' is missing",
    "pipe.usda": "not a regular file|is a pipe|cannot be read",
    "passwd.usda": "is no USD layer; export it again",
    "broken.usda": "OpenUSD cannot read it",
    "crate.usdc": "OpenUSD cannot read it",
    "zip.usdz": "is no package",
}


@pytest.mark.parametrize("arc", ["references", "payload", "sublayer", "variant"])
@pytest.mark.parametrize("name", NAMES)
def test_names_that_lead_out_of_the_model_are_refused(tmp_path, name, arc):
    pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")
    import os  # noqa: PLC0415

    folder = tmp_path / "model"
    (folder / "folder").mkdir(parents=True)
    (folder / "sub").mkdir()
    (tmp_path / "outside.usda").write_text(LINK)
    (folder / "link.usda").symlink_to(tmp_path / "outside.usda")
    (folder / "passwd.usda").write_text("root:x:0:0\n")
    (folder / "broken.usda").write_text('#usda 1.0\ndef Xform "x"\n{\n')
    (folder / "crate.usdc").write_bytes(b"PXR-USDC" + bytes(range(256)))
    (folder / "zip.usdz").write_bytes(b"PK\3\4" + bytes(40))
    os.mkfifo(folder / "pipe.usda")
    made = {
        "references": text(f'def "x" (references = @{name}@)\n{{\n}}\n', BASE),
        "payload": text(f'def "x" (payload = @{name}@)\n{{\n}}\n', BASE),
        "sublayer": text(BASE, more=f"\n    subLayers = [@{name}@]"),
        "variant": text(
            'def "x" (\nprepend variantSets = "s"\n)\n{\nvariantSet "s" = {\n'
            f'"other" (references = @{name}@) {{\n}}\n}}\n}}\n',
            BASE,
        ),
    }
    path = folder / "m.usda"
    path.write_text(made[arc])
    with pytest.raises(InvalidSource, match=NAMES[name]) as refused:
        model.read_model(path, folder)
    assert "anon:" not in str(refused.value)


def test_openusd_opens_no_file_of_the_model(tmp_path, monkeypatch):
    """Once the layers are in memory, the folder may be gone."""
    pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")
    path = artvip(tmp_path / "cab")
    truth = model.read_model(path, path.parent)
    opened = model._stage

    def without_files(*given):
        path.parent.rename(tmp_path / "gone")
        return opened(*given)

    monkeypatch.setattr(model, "_stage", without_files)
    assert repr(model.read_model(path, path.parent).joints) == repr(truth.joints)


def test_too_many_layers_and_too_many_prims(tmp_path, monkeypatch):
    pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")
    path = artvip(tmp_path / "cab")
    monkeypatch.setattr(layers, "MAX_LAYERS", 2)
    with pytest.raises(InvalidSource, match="is made of more than 2 layers; flatten it"):
        model.read_model(path, path.parent)
    monkeypatch.undo()
    monkeypatch.setattr(model, "MAX_PRIMS", 5)
    with pytest.raises(InvalidSource, match="has more than 5 prims; simplify it"):
        model.read_model(path, path.parent)


def bomb(folder: Path) -> Path:
    """2^40 cubes in forty prims that are made of two of the next each."""
    prims = [
        f'def Xform "n{k}"\n{{\n'
        + "".join(f'def "{c}" (references = </root/n{k + 1}>)\n{{\n}}\n' for c in "ab")
        + "}\n"
        for k in range(40)
    ]
    path = folder / "bomb.usda"
    path.write_text(text(*prims, 'def Cube "n40"\n{\n}\n'))
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("SECONDS", 2), ("MEGABYTES", 500)])
def test_a_model_that_is_made_of_itself_many_times_ends_in_a_sentence(
    tmp_path, monkeypatch, name, most
):
    pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")
    monkeypatch.setattr(apart, name, most)
    with pytest.raises(InvalidSource, match=r"takes OpenUSD more than .*; simplify it") as refused:
        apart.apart(partial(model.read_model, root=tmp_path), bomb(tmp_path))
    assert "bomb.usda" in str(refused.value)


def test_what_the_process_refuses_is_refused_here_and_stops_no_other(tmp_path):
    pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")
    folder = tmp_path / "some" / "models"  # other tests may leave a URDF beside theirs
    folder.mkdir(parents=True)
    (folder / "bad.usda").write_text(text(BASE, HINGE))
    (folder / "good.usda").write_text(text(BASE, DOOR, HINGE))
    good, bad = sorted(open_source(folder).objects("x"), key=lambda r: -len(r.object_id))
    assert len(readers.load(good).joints) == 2
    with pytest.raises(InvalidSource, match="'/root/door' is not there"):
        readers.load(bad)


def test_packages_are_plain_and_begin_with_a_layer(tmp_path):
    pytest.importorskip("pxr", reason="pip install 'articugen[usd]'")
    path = tmp_path / "m.usdz"
    for names, how, reason in (
        (["a.png", "m.usda"], zipfile.ZIP_STORED, "does not begin with a layer"),
        ([], zipfile.ZIP_STORED, "does not begin with a layer"),
        (["m.usda"], zipfile.ZIP_DEFLATED, "is compressed or encrypted, as no .usdz is"),
    ):
        with zipfile.ZipFile(path, "w", how) as package:
            for name in names:
                package.writestr(name, text(BASE))
        with pytest.raises(InvalidSource, match=re.escape(reason)):
            model.read_model(path, tmp_path)
    with zipfile.ZipFile(path, "w") as package:
        package.writestr("m.usda", text('def "x" (references = @../../m.usda@)\n{\n}\n', BASE))
    with pytest.raises(InvalidSource, match="is not in the package; pack it again"):
        model.read_model(path, tmp_path)


def test_without_openusd_one_sentence_says_what_to_install(tmp_path, monkeypatch):
    path = artvip(tmp_path / "cab")
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InvalidSource) as refused:
        load_path(tmp_path / "cab")
    assert str(refused.value) == (
        f"{path}: is USD, and usd-core, which reads it, is not installed; run: {installing('usd')}"
    )


def test_a_usd_file_beside_a_urdf_is_no_model_of_its_own(tmp_path):
    model_folder = tmp_path / "robot"
    (model_folder / "meshes").mkdir(parents=True)
    (model_folder / "robot.urdf").write_text("<robot/>")
    (model_folder / "robot.usda").write_text(text(BASE))
    (model_folder / "meshes" / "part.usda").write_text(LINK)
    assert [(r.object_id, r.reader) for r in open_source(tmp_path).objects("x")] == [
        ("robot", "urdf")
    ]
