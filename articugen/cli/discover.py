"""The command `discover`: it calls a function of `found_joints` and prints what that finds."""

# Everything heavy is imported where it is used: --help should not wait for numba.
# ruff: noqa: PLC0415
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from articugen.cli.app import app
from articugen.cli.options import listed
from articugen.cli.saying import said, stderr, stdout

if TYPE_CHECKING:
    from rich.table import Table

    from articugen.core.records import Floats
    from articugen.discovery import Discovery
    from articugen.discovery.objects import ObjectGroups, ObjectJoints


@app.command(
    epilog="Examples:\n\narticugen discover data/laptop\n\n"
    "articugen discover closed.ply ajar.ply open.ply --json joints.json\n\n"
    "articugen discover data/laptop --groups"
)
def discover(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="A data set's folder or a shard; or two or more poses of one object in one frame: "
            "clouds (.ply, .npy, .npz, .xyz) or occupancy grids (.npy)."
        ),
    ],
    poses: Annotated[
        int | None,
        typer.Option(min=2, help="So many poses of each object of a data set.", show_default="all"),
    ] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option(
            help="Kinds that the objects may have, where that is known: revolute or prismatic.",
            show_default="both",
        ),
    ] = None,
    groups: Annotated[
        bool,
        typer.Option(
            "--groups",
            help="Find which instances of a data set show one object instead, and compare that "
            "with the objects it names.",
        ),
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--json", help="Write the joints, or the groups, there.")
    ] = None,
) -> None:
    """Find the joints of objects from several poses of each, without labels."""
    with said("interrupted"):
        from articugen.core.files import check_place, write_atomically
        from articugen.discovery import objects as found_joints

        found_joints.check_poses(paths, groups=groups)
        if output is not None:
            check_place(output)
        if groups:
            with stderr.status("grouping ..."):
                objects = found_joints.group_all(paths[0])
            stdout.print(_agreement(objects), soft_wrap=True)
            told: object = objects.as_json()
        elif len(paths) > 1:
            with stderr.status("searching ..."):
                found = found_joints.discover(paths, joints=listed(joints))
            _print("", found)
            told = {"joints": found_joints.as_json(found)}
        else:
            objects = _of_data_set(paths[0], poses, listed(joints))
            told = [
                {"object": o.object_id, "why": o.why, "joints": found_joints.as_json(o.found)}
                for o in objects
            ]
        if output is not None:
            write_atomically(output, json.dumps(told, indent=1).encode())


def _agreement(objects: "ObjectGroups") -> str:
    from articugen.core.tables import counted

    rand, precision, recall = objects.agreement
    return (
        f"{counted(len(objects.keys), 'instance')} in {counted(objects.count, 'group')}; the data "
        f"set names {counted(len({name for name, _ in objects.keys}), 'object')}: adjusted Rand "
        f"index {rand:.3f}, precision {precision:.3f}, recall {recall:.3f}; mean likeness to the "
        f"others of a group at least {objects.groups.within:.2f}, to another group at most "
        f"{objects.groups.between:.2f}"
    )


def _of_data_set(path: Path, poses: int | None, joints: Sequence[str]) -> "list[ObjectJoints]":
    from rich.progress import track

    from articugen.discovery import objects as found_joints

    objects: list[ObjectJoints] = []

    def tell(found: "ObjectJoints", _: int) -> None:
        if found.found is None:
            stdout.print(f"[bold]{escape(found.object_id)}[/]  {escape(found.why)}", soft_wrap=True)
        else:
            _print(found.object_id, found.found)

    data = found_joints.open_data_set(path)
    for object_id in track(
        data.objects, "", console=stderr, transient=True, disable=not stderr.is_terminal
    ):
        one = data.of(object_id)
        objects += found_joints.discover_all(one, poses=poses, joints=joints, on_object=tell)
    stdout.print(_summary(objects), soft_wrap=True)
    return objects


def _print(name: str, found: "Discovery") -> None:
    if name:
        stdout.print(f"[bold]{escape(name)}[/]")
    if found.joints:
        stdout.print(_table(found))
    else:
        stdout.print("something moves, but no single joint explains it", soft_wrap=True)


def _table(found: "Discovery") -> "Table":
    import numpy as np

    from articugen.core.records import JointKind
    from articugen.core.tables import quiet_table

    def vector(v: "Floats", digits: int) -> str:
        return " ".join(f"{x:.{digits}f}" for x in np.round(v, digits) + 0.0)

    table = quiet_table("joint", "axis", "pivot", "states", ">score")  # 80 columns; JSON has more
    for joint in found.joints:
        turns = joint.kind == JointKind.REVOLUTE
        low, high = joint.states.min(), joint.states.max()
        span = (
            f"{np.degrees(low):.1f}..{np.degrees(high):.1f}°" if turns else f"{low:.3f}..{high:.3f}"
        )
        table.add_row(
            str(joint.kind), vector(joint.axis, 2), vector(joint.pivot, 3), span,
            f"{joint.score:.2f}",
        )  # fmt: skip
    return table


def _summary(objects: "Sequence[ObjectJoints]") -> str:
    from articugen.core.tables import counted
    from articugen.discovery.objects import AXIS, PIVOT, mean_error, share

    turned, slid = mean_error(objects, "turned"), mean_error(objects, "slid")
    errors = [f"{turned * 57.29578:.2f} degrees"] if turned is not None else []
    errors += [f"{slid:.4f} of the unit frame"] if slid is not None else []
    seconds = sum(o.seconds for o in objects) / max(len(objects), 1)
    return (
        f"{counted(len(objects), 'object')}, right in all joints: number "
        f"{share(objects, 'count'):.0%}, kind {share(objects, 'kind'):.0%}, axis within {AXIS:g} "
        f"degrees {share(objects, 'axis'):.0%}, pivot within {PIVOT:g} "
        f"{share(objects, 'pivot'):.0%}, states within these {share(objects, 'states'):.0%}; "
        f"states off by {' and '.join(errors) or 'nothing that can be said'} on average; "
        f"{seconds:.1f} s of CPU an object"
    )
