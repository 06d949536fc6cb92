"""GLB (glTF 2.0): each object as watertight parts on its joints, with an animation a joint.

Lengths are metres in the world frame.
"""

import numpy as np

from articugen.export.formats import Format
from articugen.export.items import Item, canonical, of_objects
from articugen.export.parts import metric_joints, part_solids, picture_of
from articugen.export.target import Files
from articugen.meshes.glb import Drawn, Moving, Part, glb_of
from articugen.meshes.painting import looks


def _write(item: Item, target: Files) -> None:
    row = canonical(item.rows)
    moving = {j.part: j for j in metric_joints(row)}
    parts = []
    for k, (mesh, _) in enumerate(part_solids(item.rows, target.options, colours=True)):
        vertices, joint = row.to_metres(mesh.vertices), moving.get(k)
        name = joint.name if joint else row.parts[0].name or "part_0"
        how = joint and Moving(joint.name, joint.kind, joint.axis, joint.lower, joint.upper)
        hangs = (joint.parent, joint.pivot) if joint else (0, np.zeros(3))
        drawn = [
            Drawn(look.light, mesh.faces[look.faces], picture_of(look), look.places)
            for look in looks(mesh, k)
        ]
        parts.append(Part(name, *hangs, vertices, drawn, how))
    about = {"category": row.category, "object_id": row.object_id}
    target.write(f"{item.key}.glb", glb_of(item.key.rpartition("/")[2], parts, about))


FORMAT = Format(
    "each object's parts as watertight meshes, each joint an animation",
    of_objects,
    _write,
    takes=("resolution", "from_grids"),
)
