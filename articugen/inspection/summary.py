"""Tables of what a shard or a data set holds, for the terminal."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from articugen.core import schema
from articugen.core.arrays import Floats, Ints
from articugen.core.errors import InvalidArgument
from articugen.core.records import ENCLOSED, STORED_KINDS, JointKind
from articugen.core.schema import resolution_of
from articugen.core.tables import DIM, quiet_table, size
from articugen.store.shards import Shard, open_shard

LOOKED_AT = 256  # instances whose points and grids, spread evenly, stand for all of them
BARS = " ▁▂▃▄▅▆▇█"
BINS = 24


def shards_of(path: Path) -> list[Path]:
    """Return the shards that a path, of one or of a folder, stands for; InvalidArgument if none."""
    if path.is_dir():
        shards = sorted(path.glob("*.h5"))
        if not shards:
            raise InvalidArgument(f"{path}: holds no shard; make one with: articugen generate")
        return shards
    if not path.exists():
        raise InvalidArgument(f"{path}: there is no such shard or folder; correct its path")
    return [path]


def summary(shards: Sequence[Path]) -> RenderableType:
    """Summarise shards: fields with sizes, joints with states, parts; or CorruptShard."""
    some = -(-LOOKED_AT // len(shards))
    contents = [_seen(path, some) for path in shards]
    files = sum(path.stat().st_size for path in shards)
    return Group(_heading(contents), _fields(contents, files), _joints(contents), _parts(contents))


_States = dict[tuple[int, JointKind], Floats]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Content of a shard, counted.

    Attributes:
        about: its attributes.
        objects: (split, id) of each.
        instances: how many there are.
        shapes, stored: of each field, that of an instance and its bytes on disk.
        states: by joint and kind: (n, 3) lower, upper, state; degrees, or the model's unit.
        counts: (256,) how often some instances have each part or label, by field.
    """

    about: Mapping[str, str | int | float]
    objects: frozenset[tuple[str, str]]
    instances: int
    shapes: Mapping[str, tuple[int, ...]]
    stored: Mapping[str, int]
    states: _States
    counts: Mapping[str, Ints]


def _seen(path: Path, some: int) -> _Seen:
    """Count the content of one shard, opened once, by `some` of its instances."""
    with open_shard(path) as shard:
        about = dict(shard.attributes)
        kinds, scale = shard.read("joint_kind"), shard.read("scale")
        columns = [shard.read(f"joint_{name}") for name in ("lower", "upper", "state")]
        values = np.stack(columns, axis=-1)
        states: _States = {}  # in degrees, or in the unit of their model
        for joint, kind in product(range(kinds.shape[1]), STORED_KINDS):
            here = kinds[:, joint] == kind
            unit = np.degrees(1.0) if kind == JointKind.REVOLUTE else scale[here, None]
            states[joint, kind] = values[here, joint] * unit
        return _Seen(
            about,
            frozenset((str(about["split"]), object_id) for object_id in shard.object_ids()),
            len(shard),
            {name: shape[1:] for name, shape in shard.fields.items()},
            {name: shard.stored_bytes(name) for name in shard.fields},
            states,
            _counts_of(shard, min(len(shard), some)),
        )


def _heading(shards: Sequence[_Seen]) -> Text:
    objects = frozenset[tuple[str, str]]().union(*(shard.objects for shard in shards))
    instances, about = sum(shard.instances for shard in shards), shards[-1].about
    per_split = Counter(split for split, _ in objects)
    counts = ", ".join(f"{n} {split}" for split, n in sorted(per_split.items(), reverse=True))
    return Text.assemble(
        (f"{about['category']}", "bold"),
        f"  {len(objects)} objects ({counts}), {instances:,} instances, seed {about['seed']}, "
        f"schema {about['schema_version']}, articugen {about['articugen_version']}",
    )


def _fields(shards: Sequence[_Seen], files: int) -> Table:
    shapes: dict[str, set[tuple[int, ...]]] = {}
    stored = Counter[str]()
    instances = sum(shard.instances for shard in shards)
    for shard in shards:
        stored.update(shard.stored)
        for name, shape in shard.shapes.items():
            shapes.setdefault(name, set()).add(shape)
    table = quiet_table("data set", "dtype", "shape", "unit", ">on disk", ">each")
    for field in schema.FIELDS:
        for name in sorted(filter(field.matches, shapes)):
            shape = " or ".join(str(shape) for shape in sorted(shapes[name])).replace("()", "")
            sizes = (size(stored[name]), size(stored[name] / instances))
            table.add_row(name, field.dtype, shape, field.unit, *sizes)
    table.add_row("index, headers", "", "", "", size(files - stored.total()), "", style=DIM)
    table.add_row("all", "", "", "", size(files), size(files / instances), style="bold")
    return table


def _joints(shards: Sequence[_Seen]) -> Table:
    states: dict[tuple[int, JointKind], list[Floats]] = {}
    for shard in shards:
        for joint, values in shard.states.items():
            states.setdefault(joint, []).append(values)
    table = quiet_table(
        ">joint", "kind", ">instances", ">range sampled from", "states, low to high"
    )
    for (joint, kind), pieces in sorted(states.items()):
        rows = np.concatenate(pieces)
        if len(rows):
            low, high = float(rows[:, 0].min()), float(rows[:, 1].max())
            bars = histogram(rows[:, 2], low, high)
            turns = kind == JointKind.REVOLUTE
            limits = f"{low:.1f} to {high:.1f}°" if turns else f"{low:.3g} to {high:.3g}"
            table.add_row(str(joint), str(kind), f"{len(rows):,}", limits, bars)
    return table


def histogram(values: Floats, low: float, high: float) -> str:
    """`values` from `low` to `high` as a row of bars, the fullest of full height."""
    if not high > low:
        return ""
    counts, _ = np.histogram(values, BINS, (low, high))
    heights = np.ceil((len(BARS) - 1) * counts / max(int(counts.max()), 1)).astype(int)
    return "".join(BARS[height] for height in heights)


def _counts_of(shard: Shard, some: int) -> dict[str, Ints]:
    grids = sorted((n for n in shard.fields if n.startswith("occupancy_")), key=resolution_of)
    counts: dict[str, Ints] = {}
    for name in ("surface_part", "partial_part", "uniform_label", "near_label", *grids[-1:]):
        counts[name] = np.zeros(256, np.int64)
        for row in np.linspace(0, len(shard) - 1, some).astype(int):
            counts[name] += np.bincount(shard.read(name, int(row)).ravel(), minlength=256)
    return counts


def _parts(shards: Sequence[_Seen]) -> Table:
    """Tabulate each part's share of the points and of the finest grid; enclosed space apart."""
    counts: dict[str, Ints] = {}
    for shard in shards:
        for name, by_part in shard.counts.items():
            counts[name] = counts.get(name, 0) + by_part
    shares = {}
    for name, total in counts.items():  # of points in each part; label k + 1 is part k
        parts = (total / max(int(total.sum()), 1))[0 if name.endswith("_part") else 1 :]
        shares[name] = np.trim_zeros(parts[: ENCLOSED - 1], "b")
    titles = (name.removesuffix("_part").removesuffix("_label") for name in shares)
    table = quiet_table(">part", *(f">{title}" for title in titles))
    for part in range(max(map(len, shares.values()), default=0)):
        table.add_row(
            str(part), *(f"{s[part]:.2%}" if part < len(s) else "" for s in shares.values())
        )
    enclosed = {n: total[ENCLOSED] / max(total.sum(), 1) for n, total in counts.items()}
    if any(enclosed.values()):
        cells = ("" if n.endswith("_part") else f"{share:.2%}" for n, share in enclosed.items())
        table.add_row("enclosed", *cells, style=DIM)
    inside = (f"{s.sum() + enclosed[n]:.2%}" for n, s in shares.items())
    table.add_row("all", *inside, style="bold")
    return table
