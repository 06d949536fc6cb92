"""Sequences of the RBO Dataset of Articulated Objects and Interactions (Martin-Martin, Eppner and
Brock, arXiv 1806.06465), as its authors' downloader unpacks them:

    rbo_dataset/objects/laptop/configuration_<date>/laptop_in.yaml, and meshes
    rbo_dataset/interactions/laptop/laptop01_o/camera_depth_registered/<index>-<seconds>.txt, ...

Depth is text in metres, registered to the colour camera; poses of markers and cameras come from
motion capture, with clocks of their own.
"""

import csv
import io
import re
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path

import numpy as np

from articugen.core.arrays import Bools, Floats
from articugen.core.errors import InvalidSource
from articugen.core.files import within
from articugen.core.geometry import (
    apply,
    invert_rigid,
    points_on_triangles,
    rotation_from_quaternion,
    rotation_from_rpy,
    transform,
)
from articugen.core.seeding import generator
from articugen.core.yaml_files import read_yaml
from articugen.evaluation.recorded.frames import (
    FARTHEST,
    Frame,
    Recording,
    contents,
    parts_by_surfaces,
    seen_by,
)
from articugen.meshes.read import read_mesh
from articugen.pictures.contact_sheet import evenly

DEPTH = ("camera_depth_registered",)
_OPTICAL = "camera_rgb_optical_frame"
_CHAIN = tuple(
    pairwise(("map", "AsusXtionCameraFrame", "camera_link", "camera_rgb_frame", _OPTICAL))
)
_INTRINSICS = ("field.K0", "field.K4", "field.K2", "field.K5")
_LATE = 0.05  # seconds that a pose may be older or newer than its image
_STILL = 1e-6
_MOST = 1e20  # of a number in a table
_SAMPLES = 4096

_Timed = tuple[Floats, Floats]  # (n,) seconds, (n, 4, 4) poses, by time


def read(folder: Path, count: int) -> Recording:
    """Return up to `count` images of a sequence; raises as `read_recording`."""
    images = sorted((folder / DEPTH[0]).glob("*.txt"), key=_seconds)
    if not images:
        raise InvalidSource(f"{folder / DEPTH[0]}: holds no <index>-<seconds>.txt")
    model = folder.absolute().parents[:3][-1] / "objects" / re.sub("[^A-Za-z].*", "", folder.name)
    markers, surfaces = _model(model, _seconds(images[0]))
    about = folder / f"{DEPTH[0]}_camera_info.csv"
    info = _Table(about).numbers(*_INTRINSICS)[0]
    if not (np.isfinite(info).all() and (info[:2] > 1.0).all()):
        raise InvalidSource(f"{about}: no focal lengths and centre, in pixels")
    cameras, bodies = _cameras(_Table(folder / "tf.csv")), _Table(folder / "rb_poses_array.csv")
    parts, frames = _bodies(bodies, markers), []
    for path in evenly(images, count):
        poses = [p for timed in (*cameras, *parts) if (p := _at(timed, _seconds(path))) is not None]
        if len(poses) < len(cameras) + len(parts):
            continue  # the motion capture lost it
        T = invert_rigid(np.linalg.multi_dot(poses[: len(cameras)])) @ poses[len(cameras) :]
        points = seen_by(_depth(path), *info).reshape(-1, 3)
        points = points[np.isfinite(points[:, 2])]
        frames.append(Frame(points, parts_by_surfaces(points, T, surfaces), T))
    if not frames:
        raise InvalidSource(f"{folder}: no image has a pose of every part within {_LATE} s")
    rng = generator(0, "surface")
    clouds = [points_on_triangles(surface, _SAMPLES, rng=rng)[0] for surface in surfaces]
    return Recording(folder.name, clouds, frames)


def _seconds(path: Path) -> float:
    try:
        seconds = float(path.stem.split("-", 1)[1])
        datetime.fromtimestamp(seconds, timezone.utc)
        return seconds
    except (IndexError, OSError, OverflowError, ValueError):
        raise InvalidSource(f"{path}: its name is not <index>-<seconds>") from None


def _depth(path: Path) -> Floats:
    text = contents(path).decode("latin-1")
    try:
        if not text.strip():
            raise ValueError("it is empty")
        return np.loadtxt(io.StringIO(text), dtype=np.float64, ndmin=2, comments=None)
    except ValueError as error:
        raise InvalidSource(f"{path}: no rows of metres ({error})") from None


def _model(folder: Path, seconds: float) -> tuple[list[int], list[Floats]]:
    """Return the parts' markers, the base's first, and triangles (F, 3, 3) in the markers' frames,
    by the latest configuration that is not after the recording: markers were exchanged."""
    files = sorted(folder.glob(f"configuration_*/{folder.name}_in.yaml"))
    if not files:
        raise InvalidSource(f"{folder}: holds no configuration_<date>/{folder.name}_in.yaml")
    day = f"configuration_{datetime.fromtimestamp(seconds, timezone.utc):%Y-%m-%d}"
    path = max((f for f in files if f.parent.name <= day), default=files[0])
    about, surfaces = read_yaml(path, InvalidSource), []
    try:
        markers = {int(link): int(marker) for marker, link in about["link_ids"].items()}
        for link in sorted(markers):
            name = f"{about.get('link_name_prefix', 'rb')}{link}"
            at = dict(re.findall(r"(xyz|rpy)=['\"]([^'\"]*)", str(about["mesh_poses"][name])))
            xyz, rpy = ([float(x) for x in at.get(k, "0 0 0").split()] for k in ("xyz", "rpy"))
            file = str(about["meshes"][name])
            places = [within(place, file) for place in (path.parent, folder, folder.parent)]
            mesh = read_mesh(next((p for p in places if p.is_file()), places[0]))
            vertices = apply(transform(rotation_from_rpy(rpy), xyz), mesh.vertices)
            if not (np.abs(vertices) < FARTHEST).all():
                raise ValueError(f"{name} is far away")
            surfaces.append(vertices[mesh.faces])
        if len(surfaces) != 2:
            raise ValueError(f"{len(surfaces)} parts; a laptop has two")
    except (ArithmeticError, AttributeError, KeyError, OSError, TypeError, ValueError) as error:
        raise InvalidSource(f"{path}: not what describes a laptop ({error})") from None
    return [markers[link] for link in sorted(markers)], surfaces


class _Table:
    """A table as rosbag writes it, by the names of its columns."""

    def __init__(self, path: Path) -> None:
        try:
            rows = list(csv.reader(io.StringIO(contents(path).decode("utf-8", "replace"))))
        except csv.Error as error:
            raise InvalidSource(f"{path}: no table ({error})") from None
        self.path, self.names = path, rows[0] if rows else []
        self.rows = [row for row in rows[1:] if len(row) == len(self.names)]
        if not self.rows:
            raise InvalidSource(f"{path}: holds no row")

    def texts(self, name: str) -> list[str]:
        if name not in self.names:
            raise InvalidSource(f"{self.path}: has no column {name}")
        at = self.names.index(name)
        return [row[at] for row in self.rows]

    def numbers(self, *names: str) -> Floats:
        """Return (rows, names); nan of what is beyond any measure."""
        try:
            values = np.array([self.texts(name) for name in names], np.float64).T
        except ValueError:
            raise InvalidSource(f"{self.path}: {names[0]} holds what is no number") from None
        return np.where(np.abs(values) < _MOST, values, np.nan)

    def poses(self, time: str, at: str, turned: str, which: Bools) -> _Timed:
        """Return those of some rows by time; a quaternion of zeros marks what was lost. What never
        moves is one pose at no time, as it is sent more rarely than images."""
        Q = self.numbers(*(turned + k for k in "wxyz"))
        places = self.numbers(*(at + k for k in "xyz"))
        size = np.sqrt((Q * Q).sum(1))
        times = 1e-9 * self.numbers(time)[:, 0]
        which = which & (size > 0.0) & (np.abs(places) < FARTHEST).all(1) & np.isfinite(times)
        if not which.any():
            return np.zeros(0), np.zeros((0, 4, 4))
        T = np.tile(np.eye(4), (which.sum(), 1, 1))
        T[:, :3, :3] = rotation_from_quaternion(Q[which] / size[which, None])
        T[:, :3, 3] = places[which]
        if np.abs(T - T[0]).max() < _STILL:
            return np.array([np.nan]), T[:1]
        return times[which], T


def _bodies(table: _Table, markers: list[int]) -> list[_Timed]:
    """Return the poses of each marker in the room; a marker keeps its slot in the table."""
    slots = [f"field.markers{k}." for k in range(len(table.names))]
    slots = [slot for slot in slots if f"{slot}id" in table.names]
    ids = {slot: table.numbers(f"{slot}id")[:, 0] for slot in slots}
    images = []
    for marker in markers:
        slot = next((slot for slot in slots if (ids[slot] == marker).any()), "")
        if not slot:
            raise InvalidSource(f"{table.path}: has no marker {marker}")
        names = ("%time", f"{slot}pose.position.", f"{slot}pose.orientation.")
        images.append(table.poses(*names, ids[slot] == marker))
    return images


def _cameras(table: _Table) -> list[_Timed]:
    """Return the poses of each link of the chain from the room to the camera in the one before."""
    p = "field.transforms0."
    names = (f"{p}header.stamp", f"{p}transform.translation.", f"{p}transform.rotation.")
    of, to = (
        np.array([text.strip().lstrip("/") for text in table.texts(p + name)])
        for name in ("header.frame_id", "child_frame_id")
    )
    return [table.poses(*names, (of == parent) & (to == child)) for parent, child in _CHAIN]


def _at(timed: _Timed, seconds: float) -> Floats | None:
    times, T = timed
    if not len(times):
        return None
    nearest = int(np.abs(times - seconds).argmin())
    return None if abs(times[nearest] - seconds) > _LATE else T[nearest]
