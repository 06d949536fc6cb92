"""What must hold within one object's instances, judged from the stored numbers alone.

Tolerances of exact things are tight (`exact.py`). Of sampled things a share must agree
(`sampled.py`): one that a sound object, thin sheets and narrow gaps included, keeps by a wide
margin, and that a real fault (swapped instances, mirrored grids, inverted motions, a surface beside
the field's zero level) does not. A share is refused only where chance can hardly explain it, so a
few samples never are. All thresholds and their margins are in `bounds.py`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from articugen.core.arrays import grouped
from articugen.core.errors import spelt_out
from articugen.core.recipe import Recipe
from articugen.core.schema import Instance
from articugen.verify.exact import GEOMETRY_CHECKS, OBJECT_CHECKS, VALUE_CHECKS, InstanceCheck
from articugen.verify.sampled import SHARE_CHECKS, Samples, Share, flow_shares


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        check: what was checked, for instance "checksum" or "zero level".
        sentence: what is wrong.
        shard: the name of the file, or "" where the finding concerns the data set.
        object_id: or "".
        state_index: of the instance, or None.
    """

    check: str
    sentence: str
    shard: str = ""
    object_id: str = ""
    state_index: int | None = None

    def __str__(self) -> str:
        state = "" if self.state_index is None else f"[{self.state_index}]"
        where = " ".join(part for part in (self.shard, self.object_id + state) if part)
        return spelt_out(f"{where and f'{where}: '}{self.check}: {self.sentence}")


def faults(rows: Sequence[Instance], recipe: Recipe) -> Iterator[Finding]:
    """Yield everything wrong with `rows`, all instances of one object made by `recipe`."""
    sensible = []
    for row in rows:
        wrong = list(_of(row, recipe, VALUE_CHECKS))
        # Geometry computed from senseless values would only repeat, or hide, what is wrong.
        yield from wrong or _of(row, recipe, GEOMETRY_CHECKS)
        sensible += [] if wrong else [row]
    yield from _refused(shares(sensible, recipe))
    for check, judge in OBJECT_CHECKS.items():
        yield from (
            Finding(check, sentence, state_index=state) for state, sentence in judge(rows, recipe)
        )


def shares(rows: Sequence[Instance], recipe: Recipe) -> Iterator[tuple[int, str, Share]]:
    """Yield (state_index, check, share) of everything sampled in all instances of one object."""
    canonical = next((Samples(row) for row in rows if row.state_index == 0), None)
    for row in rows:
        samples = Samples(row)
        for check, judge in SHARE_CHECKS.items():
            yield from ((row.state_index, check, share) for share in judge(samples, recipe))
        if canonical is not None:
            yield from (
                (row.state_index, "flow", share) for share in flow_shares(samples, canonical)
            )


def _refused(shares: Iterator[tuple[int, str, Share]]) -> Iterator[Finding]:
    """Yield the instances whose shares are refused, and the object where only all of them together
    show it."""
    alike = grouped(((check, s.sentence), (state, s)) for state, check, s in shares)
    for (check, sentence), several in alike.items():
        alone = [
            Finding(check, s.in_words(), state_index=state) for state, s in several if s.is_refused
        ]
        agree, judged = (sum(getattr(s, n) for _, s in several) for n in ("agree", "judged"))
        pooled = Share(several[0][1].bound, sentence, agree, judged)
        yield from alone or ([Finding(check, pooled.in_words())] if pooled.is_refused else [])


def _of(row: Instance, recipe: Recipe, checks: dict[str, InstanceCheck]) -> Iterator[Finding]:
    for check, judge in checks.items():
        yield from (
            Finding(check, sentence, state_index=row.state_index) for sentence in judge(row, recipe)
        )
