"""The command `discover`: it calls a function of `found_joints` and prints what that finds."""

# Everything heavy is imported where it is used: --help should not wait for numba.
# ruff: noqa: PLC0415
import json
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from articugen.cli.options import argument, offered
from articugen.cli.saying import counting_bar, say, stderr, stdout
from articugen.core.errors import InvalidArgument
from articugen.core.tables import counted, quiet_table
from articugen.pipeline.options import option

if TYPE_CHECKING:
    from rich.table import Table

    from articugen.core.records import Floats
    from articugen.discovery import Discovery, FoundJoint
    from articugen.discovery.objects import CategoryJoints, ObjectGroups, ObjectJoints


@offered(
    "articugen discover data/laptop",
    "articugen discover closed.ply ajar.ply open.ply --json joints.json",
    "articugen discover data/laptop --view 0",
    "articugen discover data/laptop --groups",
    "articugen discover data/laptop --shared",
)
def discover(
    paths: Sequence[Path] = argument(
        "A data set's folder or a shard; or two or more poses of one object in one frame: "
        "clouds (.ply, .npy, .npz, .xyz) or occupancy grids (.npy)."
    ),
    poses: int | None = option(
        None, "Poses of each object of a data set.", min=2, show_default="all"
    ),
    view: int | None = option(
        None,
        "Use what this camera of each instance of a data set sees, counted from 0, instead of "
        "whole surfaces.",
        show_default=False,
    ),
    joints: Sequence[str] = option(
        (),
        "Kinds that the objects may have, where that is known: revolute or prismatic.",
        show_default="both",
    ),
    groups: bool = option(
        False,
        "Find which instances of a data set show one object instead, and compare that "
        "with the objects it names.",
    ),
    shared: bool = option(
        False,
        "Find the joints that all objects of a data set share instead, from the last pose of each.",
    ),
    output: Path | None = option(None, "Write the joints, or the groups, there.", "--json"),
) -> None:
    """Find the joints of objects from several poses of each, without labels."""
    from articugen.core.files import check_place, write_atomically
    from articugen.discovery import objects as found_joints

    if groups and shared:
        raise InvalidArgument("--groups and --shared are two questions; ask one at a time")
    if (view, poses) != (None, None) and (groups or shared):
        raise InvalidArgument("--groups and --shared take neither --view nor --poses")
    if groups and joints:
        raise InvalidArgument("--groups takes no --joints: it looks for none")
    options = {"--groups": groups, "--shared": shared, "--view": view, "--poses": poses}
    needs = [name for name, value in options.items() if value not in (None, False)]
    found_joints.check_poses(paths, option=" ".join(needs))
    if output is not None:
        check_place(output)
    if groups:
        with stderr.status("grouping ..."):
            objects = found_joints.group_all(paths[0])
        say(_agreement(objects))
        numbers: object = objects.as_json()
    elif shared:
        with stderr.status("searching ..."):
            category = found_joints.discover_category(paths[0], joints=joints)
        _print_shared(category)
        numbers = category.as_json()
    elif len(paths) > 1:
        with stderr.status("searching ..."):
            discovery = found_joints.discover(paths, joints=joints)
        _print("", discovery)
        numbers = {"joints": found_joints.as_json(discovery)}
    else:
        objects = _of_data_set(paths[0], poses=poses, view=view, joints=joints)
        numbers = [
            {
                "object": o.object_id,
                "why": o.why,
                "joints": found_joints.as_json(o.found),
                "judged": vars(o.judged),
            }
            for o in objects
        ]
    if output is not None:
        write_atomically(output, json.dumps(numbers, indent=1).encode())


def _agreement(objects: "ObjectGroups") -> str:
    rand, precision, recall = objects.agreement
    return (
        f"{counted(len(objects.keys), 'instance')} in {counted(objects.count, 'group')}; the data "
        f"set names {counted(len({name for name, _ in objects.keys}), 'object')}: adjusted Rand "
        f"index {rand:.3f}, precision {precision:.3f}, recall {recall:.3f}; mean likeness to the "
        f"others of a group at least {objects.groups.within:.2f}, to another group at most "
        f"{objects.groups.between:.2f}"
    )


def _print_shared(category: "CategoryJoints") -> None:
    joints, count = category.category.joints, len(category.objects)
    if joints:
        middle = count // 2  # the table has one pivot, that of an object; JSON has all
        stdout.print(_table([joint.of(middle) for joint in joints]))
        say(f"pivots are those of {category.objects[middle]}")
    elif (best := category.category.doubtful) is not None:
        say(
            f"no joint is sure: the best, {best.kind}, has a score of {best.score:.2f}, "
            f"{best.margin:.2f} times that of another axis or kind; give more objects, or --joints "
            "if the kind is known"
        )
    else:
        say("the objects agree all over: no joint is in different states in enough of them")
    for j, right in category.judged.items():
        pivot = "" if right.pivot is None else f"pivot off by {right.pivot:.3f}, "
        say(
            f"joint {j + 1}: axis off by {right.axis:.1f} degrees, {pivot}states correlate "
            f"{right.states:.2f}, IoU of its points {right.iou:.2f}"
        )
    say(
        f"{counted(len(joints), 'joint')} of {category.truth} in {counted(count, 'object')}, "
        f"{category.seconds:.1f} s of CPU"
    )


def _of_data_set(path: Path, **options: Any) -> "list[ObjectJoints]":
    from articugen.discovery import objects as found_joints

    done = count(1)

    def tell(outcome: "ObjectJoints", objects: int) -> None:
        count_object(next(done), objects, outcome.object_id)
        if outcome.found is None:
            say((outcome.object_id, "bold"), f"  {outcome.why}")
        else:
            _print(outcome.object_id, outcome.found)

    with counting_bar() as count_object:
        data = found_joints.open_data_set(path)
        objects = found_joints.discover_all(data, on_object=tell, **options)
    say(_summary(objects))
    return objects


def _print(name: str, discovery: "Discovery") -> None:
    if name:
        say((name, "bold"))
    if discovery.joints:
        stdout.print(_table(discovery.joints))
    else:
        say("something moves, but no single joint explains it")


def _table(joints: "Sequence[FoundJoint]") -> "Table":
    import numpy as np

    from articugen.core.records import JointKind

    def vector(v: "Floats", digits: int) -> str:
        return " ".join(f"{x:.{digits}f}" for x in np.round(v, digits) + 0.0)

    table = quiet_table("joint", "axis", "pivot", "states", ">score")  # 80 columns; JSON has more
    for joint in joints:
        turns = joint.kind == JointKind.REVOLUTE
        known = joint.states[np.isfinite(joint.states)]
        low, high = known.min(), known.max()
        span = (
            f"{np.degrees(low):.1f}..{np.degrees(high):.1f}°" if turns else f"{low:.3f}..{high:.3f}"
        )
        if len(known) < len(joint.states):
            span += f", {len(known)} of {len(joint.states)}"
        table.add_row(
            f"{joint.kind} on {joint.parent}" if joint.parent else str(joint.kind),
            vector(joint.axis, 2), vector(joint.pivot, 3), span,
            f"{joint.score:.2f}",
        )  # fmt: skip
    return table


def _summary(objects: "Sequence[ObjectJoints]") -> str:
    from articugen.discovery.objects import AXIS, PIVOT, mean_error, share

    turned, slid, far = (mean_error(objects, name) for name in ("turned", "slid", "apart"))
    errors = [f"{turned * 57.29578:.2f} degrees"] if turned is not None else []
    errors += [f"{slid:.4f} of the unit frame"] if slid is not None else []
    motions = f"E {far:.4f}; " if far is not None else ""
    seconds = sum(o.seconds for o in objects) / max(len(objects), 1)
    unanswered = sum(bool(o.why) for o in objects)
    refused = f" ({unanswered} without an answer)" if unanswered else ""
    return (
        f"{counted(len(objects), 'object')}{refused}, right in all joints: number "
        f"{share(objects, 'count'):.0%}, kind {share(objects, 'kind'):.0%}, axis within {AXIS:g} "
        f"degrees {share(objects, 'axis'):.0%}, pivot within {PIVOT:g} "
        f"{share(objects, 'pivot'):.0%}, states within these {share(objects, 'states'):.0%}; "
        f"states off by {' and '.join(errors) or 'nothing that can be said'} on average; "
        f"{motions}{seconds:.1f} s of CPU an object"
    )
