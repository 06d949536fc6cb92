"""How right the parts are that PPD's warm start aims at: python -m tests.benchmarks.ownership DATA

Of each training object of a data set: whose its surface points are by `discovery.assign_material`,
beside the labels in the shards, as an IoU over the parts. Part motions are the true ones, or with
--found those that `discover` finds; found parts are matched to the true ones as well as they go.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from articugen.core.geometry import invert_rigid
from articugen.core.records import FREE, Floats, dequantize
from articugen.core.schema import Instance
from articugen.discovery import assign_material, discover
from articugen.store.manifest import Manifest
from articugen.store.shards import open_shard

GRID = 64
POINTS = 2048


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.ownership")
    parser.add_argument("data", type=Path, help="a data set with grids of 64")
    parser.add_argument("--found", action="store_true", help="by the joints that discover finds")
    parser.add_argument("--poses", type=int, default=41, help="so many of each object at most")
    asked = parser.parse_args()
    shards = sorted({o.shard for o in Manifest.read(asked.data).objects if o.key.split == "train"})
    every = []
    for name in shards:
        with open_shard(asked.data / name) as shard:
            ids = np.array(shard.object_ids())
            for object_id in dict.fromkeys(ids.tolist()):
                rows = np.flatnonzero(ids == object_id)[: asked.poses]
                poses = [shard.instance(int(row)) for row in rows]
                every.append(agreement(poses, found=asked.found))
                print(f"{object_id:24} {every[-1]:.3f}")  # noqa: T201
    print(f"mean of {len(every)} objects: {np.mean(every):.3f}, least {min(every):.3f}")  # noqa: T201


def agreement(poses: list[Instance], *, found: bool) -> float:
    """The mean over parts of the IoU of labels; 0 for a true part that none is matched to."""
    clouds = [dequantize(pose.surface_points) for pose in poses]
    hidden = np.array([pose.occupancy[GRID] != FREE for pose in poses])
    motion = np.array([pose.part_motion for pose in poses])
    true = len(poses[0].part_motion)
    if found:
        joints = discover(clouds)
        motion = np.array([joints.motion(k) for k in range(len(poses))])
    own = assign_material(clouds, hidden, motion)
    count = np.zeros((true, motion.shape[1]))
    for pose, cloud, T in zip(poses, clouds, invert_rigid(motion), strict=True):
        label = own.part_of(_rest(cloud[:POINTS], T))
        np.add.at(count, (pose.surface_part[:POINTS], label), 1)
    either = count.sum(1, keepdims=True) + count.sum(0) - count
    iou = count / np.maximum(either, 1)
    matched = linear_sum_assignment(-iou)
    return float(iou[matched].sum() / true)


def _rest(cloud: Floats, T: Floats) -> Floats:
    return np.einsum("pij,nj->pni", T[:, :3, :3], cloud) + T[:, None, :3, 3]


if __name__ == "__main__":
    main()
