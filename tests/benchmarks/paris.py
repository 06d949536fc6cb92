"""Axes from two states, as PARIS measures them: python -m tests.benchmarks.paris MODELS [--all]

PARIS (Liu et al., ICCV 2023) and its followers compare themselves on ten objects of
PartNet-Mobility, of which one part moves between two states. Here `ag.discover` gets 8,192 visible
points of each state, with normals, turned at random: closed and half open, and a quarter and three
quarters open, as PARIS's states are in its data alone. The part is the one with most surface.

Prints for each object the angle between the axes, ten times their distance in the model's unit
(turns alone), and by how much the motion is off, degrees or that unit. A joint that is missed or of
another kind counts as one that is 90 degrees off.
"""

import argparse
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import articugen as ag
from articugen.core.seeding import generator
from articugen.evaluation.metrics import line_distance
from articugen.instance.maker import models

TEN = {
    "102255": ("foldchair", 15.79), "10905": ("fridge", 2.93), "10211": ("laptop", 0.03),
    "101917": ("oven", 7.43), "11100": ("scissor", 16.62), "103111": ("stapler", 8.17),
    "100109": ("USB", 0.71), "103776": ("washer", 18.40), "103706": ("blade", 41.28),
    "45135": ("storage", 0.03),
}  # fmt: skip
"""PARIS's objects and its angles, as repeated by ArtGS (Liu et al., ICLR 2025, Table 1)."""

PAIRS = ((0.0, 0.5), (0.25, 0.75))
RECIPE = {"extends": "quick", "sampling": {"surface_points": 8192, "grids": [], "partial_views": 0}}


class Errors(NamedTuple):
    """What is measured of an object: degrees, ten times the model's unit (None of slides), degrees
    or that unit (None where the joint is missed)."""

    angle: float
    position: float | None
    motion: float | None
    joints: int
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.paris")
    parser.add_argument("models", nargs="+", help="a folder of models")
    parser.add_argument("--all", action="store_true", help="all of its objects, not the ten")
    options = parser.parse_args()
    try:
        known = [(folder, ref.object_id) for folder in options.models for ref in models(folder)]
    except ag.ArticugenError as error:
        parser.error(str(error))
    chosen = [(folder, name) for folder, name in known if options.all or name in TEN]
    if not chosen:
        parser.error(f"there is none of {', '.join(TEN)}; --all takes what there is")
    for pair in PAIRS:
        print(f"{pair[0]:.0%} to {pair[1]:.0%} open")  # noqa: T201
        rows = list[Errors]()
        for folder, name in chosen:
            try:
                row = measured(ag.load(folder, name), pair)
            except ag.ArticugenError as error:
                print(f"{name:>8}  {error}")  # noqa: T201
                continue
            print(line(name, row))  # noqa: T201
            rows.append(row)
        if rows:
            print(summary(rows))  # noqa: T201


def line(name: str, row: Errors) -> str:
    """Return what is printed of an object."""
    kind, published = TEN.get(name, ("", None))
    values = [f"{name:>8} {kind:9}", f"axis {row.angle:6.2f}"]
    values += [f"(PARIS {published:.2f})"] if published is not None else []
    values += [f"position {row.position:.3f}"] if row.position is not None else []
    values += ["missed"] if row.motion is None else [f"motion {row.motion:.3f}"]
    return "  ".join([*values, f"{row.joints} found, {row.seconds:.1f} s"])


def summary(rows: Sequence[Errors]) -> str:
    """Return how many are right, axis and motion within 5 degrees or 0.05 of the model's unit, and
    what is measured of these."""
    right = [
        row
        for row in rows
        if row.motion is not None
        and max(row.angle, row.motion * (1.0 if row.position is not None else 100.0)) <= 5.0
    ]
    angles = [[row.angle for row in some] for some in (rows, right)]
    place = [row.position for row in right if row.position is not None]
    turns = [row.motion for row in right if row.position is not None]
    slides = [row.motion for row in right if row.position is None]
    numbers = {"axis": angles[1], "position": place, "turn": turns, "slide": slides}
    medians = [f"{name} {np.median(some):.3f}" for name, some in numbers.items() if some]
    return (
        f"{len(right)} of {len(rows)} right; axes off by {np.mean(angles[0]):.2f} on average; "
        f"medians of the right ones: {', '.join(medians)}"
    )


def measured(model: ag.Model, pair: Sequence[float]) -> Errors:
    """Return what `ag.discover` makes of the model's largest part in two states, shares of its
    range."""
    maker = ag.Maker(model, RECIPE)
    count = np.bincount(maker[0].surface.part, minlength=len(maker.joints) + 1)
    j = int(count[1:].argmax())
    low, high = maker.joints[j].lower, maker.joints[j].upper
    poses = [maker.at({maker.joints[j].name: low + share * (high - low)}) for share in pair]
    rng = generator(0, "paris", model.object_id, str(pair))
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    clouds = [(pose.surface.points @ R.T, pose.surface.normals @ R.T) for pose in poses]
    began = time.process_time()
    outcome = ag.discover([points for points, _ in clouds], normals=[out for _, out in clouds])
    seconds = time.process_time() - began
    true, count = poses[0].joints[j], len(outcome.joints)
    axis, pivot = R @ true.axis, R @ true.pivot
    moved = np.bincount(outcome.part[poses[0].surface.part == j + 1], minlength=count + 1)[1:]
    joint = outcome.joints[int(moved.argmax())] if moved.any() else None
    if joint is None or str(joint.kind) != true.kind:
        return Errors(90.0, None, None, count, seconds)
    along = float(joint.axis @ axis)
    change = poses[1].joints[j].state_unit - true.state_unit
    off = abs(np.sign(along) * joint.states[1] - change)
    angle = float(np.degrees(np.arccos(min(abs(along), 1.0))))
    scale = poses[0].scale
    if true.kind == "prismatic":
        return Errors(angle, None, off * scale, count, seconds)
    apart = line_distance(joint.pivot, joint.axis, pivot, axis)
    return Errors(angle, 10.0 * scale * apart, float(np.degrees(off)), count, seconds)


if __name__ == "__main__":
    main()
