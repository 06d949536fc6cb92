"""What the panel says: names that are short and printable, joint ranges, sentences as HTML.

Names come from files of strangers. As HTML they are text, see `report.markup`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from articugen.core.colours import colour_of
from articugen.core.errors import printable
from articugen.core.schema import Instance
from articugen.core.tables import counted
from articugen.inspection.report.markup import Markup, el, join
from articugen.inspection.viewer.shown import Joint, Seen, Shown

LONGEST_NAME = 32


def shortened(name: str) -> str:
    """Return a name on one line, its middle left out where it is long."""
    name = printable(name)
    half = LONGEST_NAME // 2
    return name if len(name) <= LONGEST_NAME else f"{name[: half - 1]}…{name[-half:]}"


def names_of(objects: Sequence[str]) -> dict[str, str]:
    """Return the objects by a text to choose each by; no two are alike."""
    names: dict[str, str] = {}
    for object_id in objects:
        name, count = shortened(object_id) or "(no name)", 1
        while name in names:
            count += 1
            name = f"{shortened(object_id)} ({count})"
        names[name] = object_id
    return names


@dataclass(frozen=True)
class Scale:
    """A joint's slider, in degrees or the model's unit: ends, rounded outwards to whole steps."""

    lower: float
    upper: float
    step: float

    @staticmethod
    def of(joint: Joint) -> "Scale":
        lower, upper = joint.lower / joint.per_unit, joint.upper / joint.per_unit
        digits = next((d for d in range(1, 6) if (upper - lower) * 10**d >= 100.0), 6)
        # a millionth of a step is what a range loses on its way through a shard
        low = math.floor(lower * 10**digits + 1e-6)
        high = math.ceil(upper * 10**digits - 1e-6)
        return Scale(low / 10**digits, max(high, low + 1) / 10**digits, 1 / 10**digits)

    def shown(self, joint: Joint, value: float) -> float:
        """Return the step nearest to a joint value, rad or m."""
        steps = round(value / joint.per_unit / self.step)
        return min(max(round(steps * self.step, 6), self.lower), self.upper)

    @staticmethod
    def meant(joint: Joint, shown: float) -> float:
        """Return the joint value, rad or m and in its range, that a step stands for."""
        return min(max(shown * joint.per_unit, joint.lower), joint.upper)


def label_of(j: int, joint: Joint) -> str:
    scale = Scale.of(joint)
    name = shortened(joint.name) or f"part {j + 1}"
    return f"{name}: {scale.lower:g} to {scale.upper:g}{joint.unit}"


CANONICAL = "0, canonical"


def state_of(index: int) -> str:
    return str(index) if index else CANONICAL


def grid_of(resolution: int) -> str:
    return f"{resolution}³"


def edge_of(grid: str) -> int:
    """Invert `grid_of`; return 0 of anything else."""
    edge = grid.removesuffix("³")
    return int(edge) if edge.isdecimal() else 0


def heading(title: str, count: int) -> Markup:
    return _page(el("b", title), el("br"), counted(count, "object"))


def said_of(shown: Shown, view: Seen, seconds: float) -> Markup:
    """Return a line on where the object comes from."""
    state = view.instance.state_index
    if not view.asked:
        text = f"state {state}, the nearest {'that is stored' if shown.split else 'that there is'}"
    elif view.state is None:
        text = f"made for these joint values in {seconds:.2f} s"
    elif shown.split:
        text = f"state {state}, as it is stored"
    else:
        text = f"state {state}, made in {seconds:.2f} s"
    split = f"{shown.split} object, " if shown.split else ""
    why = shown.why or view.why
    nearest = warning(f"The sliders show the nearest state: {why}.") if why else None
    return join(_page(split + text), nearest)


def warning(sentence: str) -> Markup:
    return _page(sentence, colour="#8a4b08")


def busy(what: str) -> Markup:
    return _page(el("i", what))


def legend(instance: Instance) -> Markup:
    """Return the parts, each with its colour."""
    lines = []
    for k in range(len(instance.part_motion)):
        names_of_part = (
            names[k] for names in (instance.part_name, instance.part_semantic) if names
        )
        text = ", ".join(dict.fromkeys(shortened(name) for name in names_of_part if name))
        dot = el(
            "span",
            style=f"display:inline-block;width:.7em;height:.7em;border-radius:50%;margin-right:"
            f".5em;border:1px solid #0003;background:{colour_of(k)}",
        )
        lines.append(el("div", dot, f"part {k}" + (f": {text}" if text else "")))
    return _page(*lines)


def _page(*inside: object, colour: str = "inherit") -> Markup:
    return el(
        "div",
        *inside,
        style=f"font-size:.8rem;line-height:1.45;padding:.15rem .75rem;overflow-wrap:anywhere;"
        f"color:{colour}",
    )
