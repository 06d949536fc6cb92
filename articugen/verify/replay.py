"""Instances of a data set made again from its source: the proof that it is what it claims to be."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from articugen.core.records import dequantize
from articugen.core.schema import Instance
from articugen.core.seeding import generator
from articugen.fusion import pixel_width
from articugen.instance.again import prepared_again
from articugen.instance.make import make_instance
from articugen.instance.preparing import Prepared, pose
from articugen.store.manifest import Manifest
from articugen.store.provenance import library_versions, this_machine
from articugen.store.shards import open_shard
from articugen.verify.bounds import BEHIND, IN_FRONT, on_level
from articugen.verify.invariants import Finding


def replay(folder: Path, count: int) -> Iterator[Finding | None]:
    """Make `count` instances of a data set again, of as many objects as can be, or all of fewer: a
    finding for each fault, None for each done.

    Each must come out the same to the byte, with its surface points on the field's zero level.

    Raises:
        ArticugenError: as `prepared_again`.
    """
    manifest = Manifest.read(folder)
    rng = generator(manifest.seed, manifest.content_sha256, "replay")  # always the same ones
    entries = [manifest.objects[n] for n in rng.permutation(len(manifest.objects))]
    rounds = range(max((entry.instances for entry in entries), default=0))
    turns = [entry for turn in rounds for entry in entries if turn < entry.instances]
    for entry, chosen in Counter(turns[:count]).items():
        prepared = prepared_again(manifest, entry.key.object_id)
        for state in rng.permutation(entry.instances)[:chosen].tolist():
            with open_shard(folder / entry.shard) as shard:
                stored = shard.instance(state)
            place = (entry.shard, entry.key.object_id, state)
            for check, sentence in differences(prepared, stored):
                elsewhere = made_elsewhere(manifest) if check == "replay" else ""
                yield Finding(check, sentence + elsewhere, *place)
            yield None


def made_elsewhere(manifest: Manifest) -> str:
    """Return why a data set's numbers may come out otherwise: other libraries than it was made
    with, or another kind of processor; "" where there are none."""
    there = {**manifest.versions, "processors": manifest.machine.get("architecture")}
    here = {**library_versions(), "processors": this_machine()["architecture"]}
    other = [name for name in here if there.get(name) != here[name]]
    was, now = (", ".join(f"{name} {side.get(name)}" for name in other) for side in (there, here))
    return f"; it was made with {was}, here are {now}" if other else ""


def differences(prepared: Prepared, stored: Instance) -> Iterator[tuple[str, str]]:
    """Yield (check, sentence) of what is otherwise in a stored instance than in one made again."""
    again = make_instance(prepared, stored.state_index).arrays()
    other = [n for n, array in stored.arrays().items() if not np.array_equal(array, again[n])]
    if other:
        yield "replay", f"made again, it differs in {', '.join(other)}"
    yield from (("zero level", sentence) for sentence in beside_level(prepared, stored))


def beside_level(prepared: Prepared, stored: Instance) -> Iterator[str]:
    """Yield what is wrong if more of an instance's surface points than its recipe's views explain,
    and than chance does, lie off the zero level of its field."""
    _, fields = pose(prepared, stored.state_index)
    points = dequantize(stored.surface_points)
    normals = stored.surface_normals / 127.0
    before = fields.whole.is_free(points + IN_FRONT * normals)
    behind = ~fields.whole.is_free(points - BEHIND * normals)
    agree = int((before & behind).sum())
    if on_level(pixel_width(prepared.views)).refuses(agree, len(points)):
        off = 1.0 - agree / len(points)
        yield f"{off:.1%} of its surface points lie off the field's zero level"
