"""USD: each object with UsdPhysics joints, for Isaac Sim, Omniverse and any USD viewer.

One .usdc a object; z up, metres. Parts are rigid bodies that lie beside each other, as UsdPhysics
wants them, posed canonically; they collide where convex meshes are asked for.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.geometry import area_vectors
from articugen.core.records import Mesh
from articugen.export.assembly import SURFACE_FRICTION, Body, bodies, resistance
from articugen.export.formats import Format
from articugen.export.items import Item, of_objects
from articugen.export.parts import picture_of, unique
from articugen.export.target import Files
from articugen.meshes import openusd as pxr
from articugen.meshes.painting import Look, looks
from articugen.pictures.layout import png
from articugen.pictures.portrait import parts_portrait
from articugen.store.dataset import DataSet

_QCODES = {
    "box": "Q188075", "drawer": "Q14745", "eyeglasses": "Q37501", "laptop": "Q3962",
    "microwave": "Q127956", "oven": "Q36539", "refrigerator": "Q37828",
    "washing_machine": "Q124441", "": "Q223557",
}  # fmt: skip
"""Of categories, in Wikidata: drawers are furniture, and "" is any physical object."""


_PLACES = "st"  # of corners in pictures: the name by which viewers look for them


def _write(item: Item, target: Files) -> None:
    name = item.key.rpartition("/")[2]
    file = f"{name}.usdc"  # alone in a folder of the object's own: SimReady's NP.005
    with tempfile.TemporaryDirectory() as aside:  # a stage has no other way to bytes
        path = Path(aside) / "object.usdc"
        parts = bodies(item, target)
        shown = [looks(body.mesh, part) for part, body in enumerate(parts)]
        _fill(path, name, item, parts, shown)
        target.write(f"{item.key}/usd/{file}", path.read_bytes())
    for part, some in enumerate(shown):
        for k, look in enumerate(some):
            if place := _picture_name(part, k, look):
                target.write(f"{item.key}/usd/{place}", picture_of(look))
    drawn = [(body, look) for body, some in zip(parts, shown, strict=True) for look in some]
    faces = [body.unit_mesh.triangles[look.faces] for body, look in drawn]
    group = np.repeat(np.arange(len(faces)), list(map(len, faces)))
    colours = [look.colour for _, look in drawn]
    picture = parts_portrait(np.concatenate(faces), group, 256, colours)
    target.write(f"{item.key}/usd/.thumbs/256x256/{file}.png", png(picture))


def _fill(
    path: Path, name: str, item: Item, parts: tuple[Body, ...], shown: Sequence[Sequence[Look]]
) -> None:
    stage = pxr.Usd.Stage.CreateNew(str(path))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    pxr.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = pxr.UsdGeom.Xform.Define(stage, f"/{_identifier(name)}")
    root.GetPrim().SetDisplayName(name)
    stage.SetDefaultPrim(root.GetPrim())
    pxr.UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
    facts = _facts(item.rows, parts)
    stage.GetRootLayer().customLayerData = {**facts, "SimReady_Metadata": facts}
    _add_label(root.GetPrim(), "class", facts["category"])
    _add_label(root.GetPrim(), "wikidata_qcode", facts["qcode"])
    for part, body in enumerate(parts):
        _add_body(stage, f"{root.GetPath()}/part_{part}", part, body, shown[part])
    fixed = pxr.UsdPhysics.FixedJoint.Define(stage, f"{root.GetPath()}/to_world")
    fixed.CreateBody1Rel().SetTargets([f"{root.GetPath()}/part_0"])
    ours = ["Looks", fixed.GetPrim().GetName(), *(f"part_{part}" for part in range(len(parts)))]
    joints = [_identifier(body.joint.name) for body in parts if body.joint]
    for part, joint in enumerate(unique((*ours, *joints))[len(ours) :], 1):
        _add_joint(stage, f"{root.GetPath()}/{joint}", part, parts)
    stage.GetRootLayer().Save()


def _facts(rows: DataSet, parts: tuple[Body, ...]) -> dict[str, Any]:
    """Return what SimReady's SR.001 and SR.004 want to know; nothing in it is of the clock."""
    manifest, row = rows.manifest, rows[0]
    corners = np.concatenate([body.place + body.mesh.vertices for body in parts])
    return {
        "author": "articugen",
        "asset_name": row.object_id,
        "asset_type": "prop",
        "asset_license": (manifest.licence if manifest else "") or "not stated",
        "category": row.category,
        "source_file": row.object_id + (f" of {manifest.source}" if manifest else ""),
        "usd_date_generated": "undated: equal data give equal files",
        "qcode": _QCODES.get(row.category, _QCODES[""]),
        "rigid_body_count": len(parts),
        "asset_extents": pxr.Gf.Vec3f(*np.ptp(corners, axis=0).tolist()),
        "mass": sum(float(body.filled.mass) for body in parts),
    }


def _add_label(prim: Any, kind: str, label: str) -> None:
    pxr.UsdSemantics.LabelsAPI.Apply(prim, kind).CreateLabelsAttr([label])


def _identifier(name: str) -> str:
    """Return the name as OpenUSD takes it for a prim; led by `_` where it starts with a digit,
    which OpenUSD would put `_` in place of, so that 12692 and 22692 became one."""
    return pxr.Tf.MakeValidIdentifier(f"_{name}" if name[:1].isdigit() else name)


def _add_body(stage: Any, path: str, part: int, body: Body, shown: Sequence[Look]) -> None:
    xform = pxr.UsdGeom.Xform.Define(stage, path)
    xform.AddTranslateOp().Set(pxr.Gf.Vec3d(*body.place.tolist()))
    prim = xform.GetPrim()
    prim.SetDisplayName(body.name)
    _add_label(prim, "class", body.name)
    pxr.UsdPhysics.RigidBodyAPI.Apply(prim)
    mass = pxr.UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(float(body.filled.mass))
    mass.CreateCenterOfMassAttr(pxr.Gf.Vec3f(*body.filled.center_mass.tolist()))
    moments, axes = np.linalg.eigh(body.filled.moment_inertia)  # about the principal axes
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    turn = pxr.Gf.Matrix3d(*axes.T.ravel().tolist()).ExtractRotation().GetQuat()
    mass.CreateDiagonalInertiaAttr(pxr.Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(pxr.Gf.Quatf(turn.GetReal(), *turn.GetImaginary()))
    _add_visual(prim, body.mesh, part, shown)
    for k, hull in enumerate(body.hulls):
        felt = _add_mesh(stage, f"{path}/convex_{k}", hull)
        felt.CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
        pxr.UsdPhysics.CollisionAPI.Apply(felt.GetPrim())
        shape = pxr.UsdPhysics.MeshCollisionAPI.Apply(felt.GetPrim())
        shape.CreateApproximationAttr(pxr.UsdPhysics.Tokens.convexHull)


def _picture_name(part: int, number: int, look: Look) -> str:
    """Name the picture of one of a part's looks beside the .usdc; "" for one in a colour."""
    return "" if look.picture is None else f"textures/part_{part}_{number}.png"


def _add_visual(prim: Any, shape: Mesh, part: int, some: Sequence[Look]) -> None:
    """Add what is seen of a part. Its first colour is that of its own material, for what touches
    it; of several each has the material of a subset of the faces."""
    colours = [pxr.Gf.Vec3f(*look.light.tolist()) for look in some]
    names = [_picture_name(part, k, look) for k, look in enumerate(some)]
    _bind_material(prim, prim.GetName(), colours[0], names[0])
    mesh = _add_mesh(prim.GetStage(), f"{prim.GetPath()}/visual", shape)
    if any(names):
        kind = pxr.Sdf.ValueTypeNames.TexCoord2fArray
        laid = pxr.UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            _PLACES, kind, pxr.UsdGeom.Tokens.faceVarying
        )
        places = np.zeros((len(shape.faces), 3, 2), np.float32)
        for look in some:
            places[look.faces] = 0.0 if look.places is None else look.places
        laid.Set(pxr.Vt.Vec2fArray.FromNumpy(places.reshape(-1, 2)))
    if len(some) == 1:
        mesh.CreateDisplayColorAttr(colours)
        return
    shown = np.zeros((len(shape.faces), 3), np.float32)
    binding = pxr.UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    for k, (look, colour, picture) in enumerate(zip(some, colours, names, strict=True)):
        shown[look.faces] = look.light
        faces = pxr.Vt.IntArray.FromNumpy(look.faces.astype(np.int32))
        subset = binding.CreateMaterialBindSubset(f"colour_{k}", faces)
        _bind_material(subset.GetPrim(), f"{prim.GetName()}_{k}", colour, picture)
    binding.SetMaterialBindSubsetsFamilyType(pxr.UsdGeom.Tokens.partition)
    primvar = mesh.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.uniform)
    primvar.Set(pxr.Vt.Vec3fArray.FromNumpy(shown))


def _bind_material(prim: Any, name: str, colour: Any, picture: str) -> None:
    """Bind a new material, for what is seen of it, in a colour or a picture, and for what touches
    it."""
    path = prim.GetStage().GetDefaultPrim().GetPath().AppendPath(f"Looks/{name}")
    material = pxr.UsdShade.Material.Define(prim.GetStage(), path)
    shader = pxr.UsdShade.Shader.Define(prim.GetStage(), path.AppendChild("preview"))
    shader.CreateIdAttr("UsdPreviewSurface")
    diffuse = shader.CreateInput("diffuseColor", pxr.Sdf.ValueTypeNames.Color3f)
    diffuse.Set(colour)
    if picture:
        diffuse.ConnectToSource(_add_picture(prim.GetStage(), path, picture))
    shader.CreateInput("roughness", pxr.Sdf.ValueTypeNames.Float).Set(0.8)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    rubbed = pxr.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    rubbed.CreateStaticFrictionAttr(SURFACE_FRICTION)
    rubbed.CreateDynamicFrictionAttr(SURFACE_FRICTION)
    _add_label(material.GetPrim(), "material", "wood")  # as DENSITY and SURFACE_FRICTION are of it
    pxr.UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def _add_picture(stage: Any, material: Any, picture: str) -> Any:
    """Return the output of what reads a material's picture at the places of corners."""
    kinds = pxr.Sdf.ValueTypeNames
    reader = pxr.UsdShade.Shader.Define(stage, material.AppendChild("places"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set(_PLACES)
    texture = pxr.UsdShade.Shader.Define(stage, material.AppendChild("picture"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(f"./{picture}")
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    for axis in "wrapS", "wrapT":
        texture.CreateInput(axis, kinds.Token).Set("repeat")
    places = reader.CreateOutput("result", kinds.Float2)
    texture.CreateInput("st", kinds.Float2).ConnectToSource(places)
    return texture.CreateOutput("rgb", kinds.Float3)


def _add_mesh(stage: Any, path: str, mesh: Mesh) -> Any:
    prim = pxr.UsdGeom.Mesh.Define(stage, path)
    points = pxr.Vt.Vec3fArray.FromNumpy(mesh.vertices.astype(np.float32))
    prim.CreatePointsAttr(points)
    prim.CreateFaceVertexCountsAttr(
        pxr.Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32))
    )
    prim.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(mesh.faces.ravel()))
    across = area_vectors(mesh.triangles)
    across[~across.any(axis=1)] = 0.0, 0.0, 1.0  # of a face without area
    flat = across / np.linalg.norm(across, axis=1, keepdims=True)
    prim.CreateNormalsAttr(pxr.Vt.Vec3fArray.FromNumpy(flat.astype(np.float32)))
    prim.SetNormalsInterpolation(pxr.UsdGeom.Tokens.uniform)
    prim.CreateExtentAttr(pxr.UsdGeom.PointBased.ComputeExtent(points))
    prim.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    return prim


def _add_joint(stage: Any, path: str, part: int, parts: tuple[Body, ...]) -> None:
    moving, root = parts[part].joint, path.rpartition("/")[0]
    assert moving is not None
    revolute = moving.kind == "revolute"
    schema = pxr.UsdPhysics.RevoluteJoint if revolute else pxr.UsdPhysics.PrismaticJoint
    joint = schema.Define(stage, path)
    joint.GetPrim().SetDisplayName(moving.name)
    joint.CreateBody0Rel().SetTargets([f"{root}/part_{moving.parent}"])
    joint.CreateBody1Rel().SetTargets([f"{root}/part_{part}"])
    joint.CreateAxisAttr("X")
    turn = pxr.Gf.Quatf(
        pxr.Gf.Rotation(pxr.Gf.Vec3d(1, 0, 0), pxr.Gf.Vec3d(*moving.axis.tolist())).GetQuat()
    )
    joint.CreateLocalPos0Attr(pxr.Gf.Vec3f(*(moving.pivot - parts[moving.parent].place).tolist()))
    joint.CreateLocalPos1Attr(pxr.Gf.Vec3f(0.0))
    joint.CreateLocalRot0Attr(turn)
    joint.CreateLocalRot1Attr(turn)
    unit = np.degrees(1.0) if revolute else 1.0
    joint.CreateLowerLimitAttr(moving.lower * unit)
    joint.CreateUpperLimitAttr(moving.upper * unit)
    along = "angular" if revolute else "linear"
    damping, friction = resistance(parts, part)
    drive = pxr.UsdPhysics.DriveAPI.Apply(joint.GetPrim(), along)
    drive.CreateStiffnessAttr(0.0)
    drive.CreateDampingAttr(damping / unit)
    joint.GetPrim().AddAppliedSchema(f"PhysxJointAxisAPI:{along}")  # UsdPhysics has no friction
    for kind in ("static", "dynamic"):
        effort = f"physxJointAxis:{along}:{kind}FrictionEffort"
        joint.GetPrim().CreateAttribute(effort, pxr.Sdf.ValueTypeNames.Float, False).Set(friction)


FORMAT = Format(
    "each object as USD with UsdPhysics joints, which collides with --collision",
    of_objects,
    _write,
    takes=("resolution", "from_grids", "collision"),
    needs=(("pxr", "export"),),
)
