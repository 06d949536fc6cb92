"""Small USD models as ArtVIP and others write them."""

from pathlib import Path

HEADER = """#usda 1.0
(
    defaultPrim = "root"
    metersPerUnit = {metres}
    upAxis = "{up}"{more}
)
"""

LINK = """#usda 1.0
(
    defaultPrim = "link"
)
def Xform "link"
{
    def Cube "cube" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {
        double size = 100
    }
}
"""

CABINET = (
    HEADER.format(metres=0.01, up="Y", more="\n    subLayers = [@./resource/material.usda@]")
    + """def Xform "root"
{
    def Xform "E_body_1" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsArticulationRootAPI"]
    )
    {
        double3 xformOp:translate = (0, 50, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def "mesh" (references = @./resource/v_0/link.usda@)
        {
        }
        def PhysicsFixedJoint "FixedJoint"
        {
            rel physics:body1 = </root/E_body_1>
            point3f physics:localPos0 = (0, 50, 0)
        }
    }
    def Xform "E_door_4" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
    {
        double3 xformOp:translate = (0, 50, 52)
        float3 xformOp:scale = (0.5, 0.5, 0.02)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        def "mesh" (
            instanceable = true
            payload = @./resource/v_0/link.usda@
        )
        {
        }
        def PhysicsRevoluteJoint "RevoluteJoint"
        {
            uniform token physics:axis = "X"
            rel physics:body0 = </root/E_body_1>
            rel physics:body1 = </root/E_door_4>
            point3f physics:localPos0 = (0, -50, 50)
            point3f physics:localPos1 = (0, -100, -100)
            float physics:lowerLimit = 0
            float physics:upperLimit = 90
        }
    }
}
"""
)


def artvip(folder: Path) -> Path:
    """A cabinet of 1 m in ArtVIP's layout, y up and in centimetres: its door, half as large, turns
    about the body's lower front edge. The main file's path."""
    (folder / "resource" / "v_0").mkdir(parents=True)
    (folder / "resource" / "v_0" / "link.usda").write_text(LINK)
    (folder / "resource" / "material.usda").write_text('#usda 1.0\nover "root"\n{\n}\n')
    main = folder / f"model_{folder.name}.usda"
    main.write_text(CABINET)
    return main


def body(name: str, inside: str = 'def Cube "cube"\n{\ndouble size = 1\n}', place: str = "") -> str:
    """A rigid body."""
    return (
        f'def Xform "{name}" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])\n{{\n'
        f"{place}\n{inside}\n}}\n"
    )


def at(x: float, y: float, z: float) -> str:
    """The place of a prim."""
    return (
        f"double3 xformOp:translate = ({x}, {y}, {z})\n"
        'uniform token[] xformOpOrder = ["xformOp:translate"]'
    )


def joint(
    kind: str, body0: str = "base", body1: str = "door", *, name: str = "joint", more: str = ""
) -> str:
    """A joint of a kind, such as Revolute; bodies without a name are left out."""
    ends = [f"rel physics:body{k} = </root/{b}>" for k, b in enumerate((body0, body1)) if b]
    return f'def Physics{kind}Joint "{name}"\n{{\n' + "\n".join(ends) + f"\n{more}\n}}\n"


def text(*prims: str, metres: float = 1.0, up: str = "Z", more: str = "") -> str:
    """A layer with these prims under /root."""
    head = HEADER.format(metres=metres, up=up, more=more)
    return head + 'def Xform "root"\n{\n' + "\n".join(prims) + "}\n"
