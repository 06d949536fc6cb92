"""Mass and inertia of a solid."""

from dataclasses import dataclass

import trimesh

from articugen.core.records import Floats, Mesh


@dataclass(frozen=True, eq=False)
class Inertia:
    """`mass` kg; `center` (3,) of mass, metres; `tensor` (3, 3) about it, kg m^2."""

    mass: float
    center: Floats
    tensor: Floats


def inertia(mesh: Mesh, density: float) -> Inertia:
    """Compute mass and inertia of a watertight mesh in metres, filled with `density` kg/m^3."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    solid.density = density
    moments = solid.mass_properties
    return Inertia(float(moments.mass), moments.center_mass, moments.inertia)
