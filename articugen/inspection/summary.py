"""Tables of what a shard or a data set holds, for the terminal."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from articugen.core import schema
from articugen.core.arrays import Floats, Ints
from articugen.core.records import ENCLOSED, STORED_KINDS, JointKind
from articugen.core.schema import resolution_of
from articugen.core.tables import DIM, counted, quiet_table, size
from articugen.store.columns import Attribute
from articugen.store.shards import Shard, open_shard

LOOKED_AT = 256  # instances whose points and grids, spread evenly, stand for all of them
BARS = " ▁▂▃▄▅▆▇█"
BINS = 24


def summary(shards: Sequence[Path]) -> RenderableType:
    """Summarise shards: fields with sizes, joints with states, parts; or CorruptShard."""
    content = _Content()
    for path in shards:
        with open_shard(path) as shard:
            content.add(shard, -(-LOOKED_AT // len(shards)))
    files = sum(path.stat().st_size for path in shards)
    return Group(_heading(content), _fields(content, files), _joints(content), _parts(content))


class _Content:
    """Content of shards, counted.

    Attributes:
        about: attributes of the last one.
        objects: (split, id) of each.
        instances: how many there are.
        shapes, stored: of each field, those of an instance, and its bytes on disk.
        states: by joint and kind: (n, 3) lower, upper, state; degrees, or the model's unit.
        counts: (256,) how often some instances have each part or label, by field.
    """

    def __init__(self) -> None:
        self.about: Mapping[str, Attribute] = {}
        self.objects: set[tuple[str, str]] = set()
        self.instances = 0
        self.shapes: dict[str, set[tuple[int, ...]]] = {}
        self.stored = Counter[str]()
        self.states: dict[tuple[int, JointKind], list[Floats]] = {}
        self.counts: dict[str, Ints] = {}

    def add(self, shard: Shard, some: int) -> None:
        """Count a shard; its parts and labels by `some` of its instances."""
        self.about = shard.attributes
        self.objects |= {(str(self.about["split"]), name) for name in shard.object_ids()}
        self.instances += len(shard)
        for name, shape in shard.fields.items():
            self.shapes.setdefault(name, set()).add(shape[1:])
            self.stored[name] += shard.stored_bytes(name)
        kinds, scale = shard.read("joint_kind"), shard.read("scale")
        columns = [shard.read(f"joint_{name}") for name in ("lower", "upper", "state")]
        values = np.stack(columns, axis=-1)
        for joint, kind in product(range(kinds.shape[1]), STORED_KINDS):
            here = kinds[:, joint] == kind
            unit = np.degrees(1.0) if kind == JointKind.REVOLUTE else scale[here, None]
            self.states.setdefault((joint, kind), []).append(values[here, joint] * unit)
        grids = sorted((n for n in shard.fields if n.startswith("occupancy_")), key=resolution_of)
        for name in ("surface_part", "partial_part", "uniform_label", "near_label", *grids[-1:]):
            count = self.counts.setdefault(name, np.zeros(256, np.int64))
            for row in np.linspace(0, len(shard) - 1, min(len(shard), some)).astype(int):
                count += np.bincount(shard.read(name, int(row)).ravel(), minlength=256)


def _heading(content: _Content) -> Text:
    about, per_split = content.about, Counter(split for split, _ in content.objects)
    counts = ", ".join(f"{n} {split}" for split, n in sorted(per_split.items(), reverse=True))
    return Text.assemble(
        (f"{about['category']}", "bold"),
        f"  {counted(len(content.objects), 'object')} ({counts}), "
        f"{counted(content.instances, 'instance')}, seed {about['seed']}, "
        f"schema {about['schema_version']}, articugen {about['articugen_version']}",
    )


def _fields(content: _Content, files: int) -> Table:
    shapes, stored, instances = content.shapes, content.stored, content.instances
    table = quiet_table("data set", "dtype", "shape", "unit", ">on disk", ">each")
    for field in schema.FIELDS:
        for name in sorted(filter(field.matches, shapes)):
            shape = " or ".join(str(shape) for shape in sorted(shapes[name])).replace("()", "")
            sizes = (size(stored[name]), size(stored[name] / instances))
            table.add_row(name, field.dtype, shape, field.unit, *sizes)
    table.add_row("index, headers", "", "", "", size(files - stored.total()), "", style=DIM)
    table.add_row("all", "", "", "", size(files), size(files / instances), style="bold")
    return table


def _joints(content: _Content) -> Table:
    table = quiet_table(
        ">joint", "kind", ">instances", ">range sampled from", "states, low to high"
    )
    for (joint, kind), pieces in sorted(content.states.items()):
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


def _parts(content: _Content) -> Table:
    """Tabulate each part's share of the points and of the finest grid; enclosed space apart."""
    counts = content.counts
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
