"""MuJoCo's own compiler and kinematics, beside ours."""

from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from articugen.core.geometry import apply, rotation_about, transform
from articugen.core.records import ArticulatedObject, Joint, JointKind
from articugen.meshes import read


def motion(joint: Joint, q: float):
    if joint.kind == JointKind.PRISMATIC:
        return transform(translation=q * joint.axis)
    return transform(rotation_about(joint.axis, q))


def posed(obj: ArticulatedObject, state) -> dict[str, np.ndarray]:
    """The vertices of each link in the world, moving joints at `state` in their order."""
    states = iter(state)
    T = {obj.links[0].name: obj.T_world_root}
    for joint in obj.joints:
        own = np.eye(4) if joint.kind == JointKind.FIXED else motion(joint, next(states))
        T[joint.child] = T[joint.parent] @ joint.T_parent_joint @ own
    return {link.name: apply(T[link.name], link.mesh.vertices) for link in obj.links}


def in_mujoco(mujoco, path: Path):
    """What gives the vertices of all geoms of each body for a state of hinges and slides."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.boundmass = spec.compiler.boundinertia = 1.0  # no part is too light for it
    model = spec.compile()
    data = mujoco.MjData(model)
    kinds = mujoco.mjtGeom
    moving = [j for j in range(model.njnt) if model.jnt_type[j] in (2, 3)]

    def mesh(geom: int) -> np.ndarray | None:
        size, kind = model.geom_size[geom], kinds(model.geom_type[geom])
        if kind == kinds.mjGEOM_MESH:
            k = model.geom_dataid[geom]
            start = model.mesh_vertadr[k]
            return model.mesh_vert[start : start + model.mesh_vertnum[k]].astype(np.float64)
        made = {
            kinds.mjGEOM_BOX: lambda: read.box(2.0 * size),
            kinds.mjGEOM_SPHERE: lambda: read.sphere(size[0]),
            kinds.mjGEOM_ELLIPSOID: lambda: read.scaled(read.sphere(1.0), size),
            kinds.mjGEOM_CAPSULE: lambda: read.capsule(size[0], 2.0 * size[1]),
            kinds.mjGEOM_CYLINDER: lambda: read.cylinder(size[0], 2.0 * size[1]),
        }.get(kind)
        return made and made().vertices

    def at(state) -> dict[str, np.ndarray]:
        data.qpos[model.jnt_qposadr[moving]] = state
        mujoco.mj_forward(model, data)
        found: dict[str, list[np.ndarray]] = {}
        for geom in range(model.ngeom):
            vertices = mesh(geom)
            if vertices is not None:
                turn = data.geom_xmat[geom].reshape(3, 3)
                name = model.body(model.geom_bodyid[geom]).name
                name = name or f"body_{model.geom_bodyid[geom]}"
                found.setdefault(name, []).append(vertices @ turn.T + data.geom_xpos[geom])
        return {name: np.concatenate(all_of) for name, all_of in found.items()}

    return at


def farthest(points: np.ndarray, others: np.ndarray) -> float:
    """How far a point is from the nearest of others, at most."""
    return float(KDTree(others).query(points)[0].max()) if len(points) else 0.0


def compare(mujoco, obj: ArticulatedObject, path: Path, rng, *, states: int, both: bool) -> float:
    """How far vertices lie from those of MuJoCo, at most, at random joint states; with `both` also
    the other way round."""
    at = in_mujoco(mujoco, path)
    count = sum(joint.kind != JointKind.FIXED for joint in obj.joints)
    worst = 0.0
    for _ in range(states):
        state = rng.uniform(-1.5, 1.5, count)
        theirs = at(state)
        for name, vertices in posed(obj, state).items():
            if len(vertices):
                worst = max(worst, farthest(vertices, theirs[name]))
                worst = max(worst, farthest(theirs[name], vertices) if both else 0.0)
    return worst
