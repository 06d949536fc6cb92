"""What the backends that wrap a foreign renderer (embree, opengl, sapien) share."""

import importlib
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from articugen.core.arrays import Floats
from articugen.core.errors import MissingDriver, MissingExtra, machine_fault
from articugen.core.records import LabelledMesh, Views

MARGIN = 1e-3
"""Room (unit frame) between the mesh and the planes that bound it: none of it is cut off."""


def import_library(library: str, extra: str, system_packages: str) -> ModuleType:
    """Return the optional `library` of the pip extra `extra`.

    Raises MissingExtra where it is not installed, and MissingDriver where it is but cannot be
    loaded, which on Debian means that some of `system_packages` are missing.
    """
    try:
        return importlib.import_module(library)
    except ModuleNotFoundError as error:
        raise MissingExtra(library, extra) from error
    except (ImportError, OSError, AttributeError) as error:
        raise missing_driver(library, system_packages, error) from error


def missing_driver(library: str, system_packages: str, error: Exception) -> Exception:
    """Return the fault of the machine that it is; else the sentence that names what `library` said
    and the Debian packages that mend it."""
    message = " ".join((str(error) or type(error).__name__).split())
    return machine_fault(error) or MissingDriver(
        f"{library} cannot run on this machine ({message}); "
        f"on Debian, run: apt-get install {system_packages}"
    )


def depth_ranges(mesh: LabelledMesh, views: Views) -> Floats:
    """Return (K, 2) for each view a z just before and one just behind all of the mesh, which has
    faces.

    Raises ValueError where a part of the mesh does not lie in front of a pinhole camera.
    """
    corners = mesh.vertices[np.unique(mesh.faces)]
    z = (corners @ T[2, :3] + T[2, 3] for T in views.T_camera_world)
    ranges = np.array([(depth.min(), depth.max()) for depth in z]).reshape(-1, 2)
    room = np.full(len(views), MARGIN)
    if views.projection == "pinhole":
        if (ranges[:, 0] <= 0.0).any():
            raise ValueError("a part of the mesh does not lie in front of a pinhole camera")
        room = np.minimum(room, ranges[:, 0] / 2.0)
    return ranges + room[:, None] * (-1.0, 1.0)


def unseen(views: Views) -> NDArray[np.float32]:
    """Return (K, H, W) float32 depth maps in which nothing is seen."""
    return np.full((len(views), views.height, views.width), np.inf, np.float32)
