"""What one would use instead: each peer as one function from a mesh to an inside test.

Each gets the posed mesh as its source gives it and does the best it knows. They may use all cores;
ours uses one.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import numpy as np

from articugen.core.errors import MissingDriver, MissingExtra
from articugen.core.geometry import bounds
from articugen.core.recipe import ViewSettings
from articugen.core.records import Floats, LabelledMesh, Views
from articugen.fusion.solidify import unrepeated
from articugen.rendering import render
from articugen.rendering.views import fusion_views
from tests.benchmarks import labs
from tests.benchmarks.cases import VOXEL, Bools, Inside
from tests.benchmarks.dense import Dense, containment


def without_repeats(mesh: LabelledMesh) -> LabelledMesh:
    keep = unrepeated(mesh)
    return LabelledMesh(mesh.vertices, mesh.faces[keep], mesh.part_of_face[keep])


@dataclass(frozen=True)
class Answer:
    """What a peer made of a mesh; `views` where it knows of inside by sight alone."""

    inside: Inside
    views: Views | None = None


@dataclass(frozen=True)
class Peer:
    """One method.

    Attributes:
        needs: the distributions it is made of.
        build: from a mesh; imports what it needs.
        slow: run once, on a few meshes only, and not at all in a quick run.
    """

    name: str
    needs: tuple[str, ...]
    build: Callable[[LabelledMesh], Answer] = field(repr=False)
    slow: bool = False

    @property
    def versions(self) -> dict[str, str]:
        """The version of each need, "" where it is not installed."""
        found = {}
        for name in self.needs:
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                found[name] = ""
        return found

    @property
    def missing(self) -> list[str]:
        return [name for name, version in self.versions.items() if not version]


OPEN3D, PCU = "open3d-cpu", "point-cloud-utils"

MESH2SDF = {"mesh2sdf": (128, 128), "mesh2sdf2": (64, 63)}
"""The original and a fork that installs a module of the same name: samples, and cells between -1
and 1, which they count differently. At 128 the fork takes a minute a mesh, three times as long."""


def peers(dense: Dense) -> tuple[Peer, ...]:
    return (*_fused_and_filled(dense), *_remade(), *_of_the_raw_mesh())


def _fused_and_filled(dense: Dense) -> tuple[Peer, ...]:
    """Those that fuse depth maps, or flood what lies outside."""
    return (
        Peer(
            f"dense chain ({dense})",
            ("scipy", "scikit-image", OPEN3D),
            lambda mesh: Answer(*dense.build(mesh)),
            slow=dense == Dense(),
        ),
        Peer("library chain (VoxelBlockGrid)", (OPEN3D,), _library_chain),
        Peer(
            "flood fill 256^3",
            (OPEN3D, "scipy"),
            lambda mesh: Answer(labs.flood_filled(mesh, 256)),
            slow=True,
        ),
        Peer(
            "Hunyuan3D-2.1's recipe",
            (OPEN3D, "scikit-image", "libigl"),
            lambda mesh: Answer(labs.walled(mesh)),
            slow=True,
        ),
    )


def _remade() -> tuple[Peer, ...]:
    """Those that make another mesh, closed, whose inside is known."""
    return (
        Peer("watertight 50k + sign", (PCU,), lambda mesh: _watertight(mesh, 50_000), slow=True),
        *(
            Peer(
                f"{name} {size}, less its level",
                (name, "scipy"),
                lambda mesh, name=name: _mesh2sdf(mesh, name),
                slow=True,
            )
            for name, (size, _) in MESH2SDF.items()
        ),
        Peer(
            "MeshLib 1/128, hole winding rule, twins dropped",
            ("meshlib", PCU),
            lambda mesh: _winding_number(_offset(without_repeats(mesh), 1.0 / 128.0)),
            slow=True,
        ),
    )


def _of_the_raw_mesh() -> tuple[Peer, ...]:
    return (
        Peer(
            "winding number, twins dropped",
            (PCU,),
            lambda mesh: _winding_number(without_repeats(mesh)),
        ),
        Peer(
            "RaycastingScene, raw mesh",
            (OPEN3D,),
            lambda mesh: Answer(containment(mesh.vertices, mesh.faces)),
        ),
    )


def _offset(mesh: LabelledMesh, voxel: float) -> LabelledMesh:
    """MeshLib's offset by nothing: the zero level of a signed distance whose sign takes the mesh
    neither to be closed nor free of overlaps; holes are closed where it can."""
    mm: Any = importlib.import_module("meshlib.mrmeshpy")
    arrays: Any = importlib.import_module("meshlib.mrmeshnumpy")

    used = mesh.compact()
    settings = mm.OffsetParameters()
    settings.voxelSize = voxel
    settings.signDetectionMode = mm.SignDetectionMode.HoleWindingRule
    settings.closeHolesInHoleWindingNumber = True
    part = arrays.meshFromFacesVerts(np.array(used.faces), np.array(used.vertices))
    remade = mm.mcOffsetMesh(mm.MeshPart(part), 0.0, settings)
    faces = np.asarray(arrays.getNumpyFaces(remade.topology))
    vertices = np.asarray(arrays.getNumpyVerts(remade), float)
    return LabelledMesh(vertices, faces, np.zeros(len(faces), np.uint8))


def _library_chain(mesh: LabelledMesh) -> Answer:
    """Depth maps, open3d's sparse fusion, its mesh, containment in it by Embree.

    Depth by pyrender (repaired, see rendering/opengl.py), by Embree where there is no EGL; 100
    views of 640 x 640 fitted to the mesh, voxels of 1/256, truncation 8 voxels.
    """
    o3d: Any = importlib.import_module("open3d")

    settings = ViewSettings(count=100, resolution=640, projection="pinhole")
    views = fusion_views(settings, bounds(mesh.vertices[np.unique(mesh.faces)]))
    depth = _library_depth(mesh, views)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3d.core.float32, o3d.core.float32), ((1), (1)), VOXEL, 8, 20_000
    )
    for k, T in enumerate(views.T_camera_world):
        image = o3d.t.geometry.Image(np.where(np.isfinite(depth[k]), depth[k], 0.0)[..., None])
        K = np.array([[views.fx[k], 0, views.cx[k]], [0, views.fy[k], views.cy[k]], [0, 0, 1]])
        pose = o3d.core.Tensor(T), o3d.core.Tensor(K)
        blocks = grid.compute_unique_block_coordinates(image, pose[1], pose[0], 1.0, 5.0, 8.0)
        grid.integrate(blocks, image, pose[1], pose[0], 1.0, 5.0, 8.0)
    fused = grid.extract_triangle_mesh()
    triangles = fused.triangle.indices.numpy() if fused.triangle else np.zeros((0, 3))
    vertices = fused.vertex.positions.numpy() if fused.vertex else np.zeros((0, 3))
    return Answer(containment(vertices, triangles), views)


def _library_depth(mesh: LabelledMesh, views: Views) -> np.ndarray:
    try:
        return render(mesh, views, backend="opengl").depth
    except (MissingExtra, MissingDriver):
        return render(mesh, views, backend="embree").depth


def _winding_number(mesh: LabelledMesh) -> Answer:
    """Fast winding numbers (Barill et al. 2018), as point-cloud-utils has them from libigl."""
    from point_cloud_utils import triangle_soup_fast_winding_number  # noqa: PLC0415 - optional

    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)

    def inside(points: Floats) -> Bools:
        if not len(faces):
            return np.zeros(len(points), np.bool_)
        w = triangle_soup_fast_winding_number(vertices, faces, np.ascontiguousarray(points))
        return np.abs(w) > 0.5

    return Answer(inside)


def _watertight(mesh: LabelledMesh, resolution: int) -> Answer:
    """Manifold (Huang et al. 2018), then the sign by winding number, which is exact there."""
    from point_cloud_utils import make_mesh_watertight  # noqa: PLC0415 - optional

    used = mesh.compact()
    vertices, faces = make_mesh_watertight(
        np.array(used.vertices), np.array(used.faces), resolution, 0
    )
    part = np.zeros(len(faces), np.uint8)
    return _winding_number(LabelledMesh(vertices, faces, part))


def _mesh2sdf(mesh: LabelledMesh, name: str) -> Answer:
    """Wang et al. 2022. It swells by a level of two cells, which is taken off again."""
    import mesh2sdf  # noqa: PLC0415 - optional
    from scipy.ndimage import map_coordinates  # noqa: PLC0415

    if len([d for d in metadata.packages_distributions()["mesh2sdf"] if d in MESH2SDF]) > 1:
        raise RuntimeError("mesh2sdf and mesh2sdf2 overwrite each other: uninstall both, take one")
    size, cells = MESH2SDF[name]
    box = bounds(mesh.vertices[np.unique(mesh.faces)])
    center, scale = box.mean(axis=0), 1.8 / float(np.max(box[1] - box[0]))
    level = 2.0 / size
    sdf = mesh2sdf.compute((mesh.vertices - center) * scale, mesh.faces, size, True, level)

    def inside(points: Floats) -> Bools:
        at = ((points - center) * scale + 1.0) * (cells / 2.0)
        return map_coordinates(sdf, at.T, order=1, mode="nearest") < -level

    return Answer(inside)
