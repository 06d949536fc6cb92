"""One colour for a true part and for what was predicted of it."""

from collections.abc import Sequence

from articugen.core.colours import colour_of

UNNAMED = "#5f5f5f"
"""Of a predicted part that no true part has voted for."""

_SHADES = (0.0, 0.45, -0.35, 0.7, -0.6)


def part_colours(labels: Sequence[int], dominant: Sequence[int]) -> list[str]:
    """#rrggbb of each predicted part: that of the true part whose label it has.

    Where several share a label, the dominant one has the colour itself, the others paler and
    darker shades of it.

    Args:
        labels, dominant: as in the result of `evaluate`; -1 is no label.
    """
    colours = [UNNAMED] * len(labels)
    for label in sorted(set(labels) - {-1}):
        mine = [i for i, given in enumerate(labels) if given == label]
        mine.sort(key=lambda i: dominant[i] != label)
        for rank, i in enumerate(mine):
            shade = _SHADES[min(rank, len(_SHADES) - 1)]
            colours[i] = shaded(colour_of(label), shade)
    return colours


def shaded(colour: str, shade: float) -> str:
    """#rrggbb mixed with white (`shade` above 0, up to 1) or with black (below 0)."""
    toward = 255 if shade > 0 else 0
    channels = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    mixed = [round((1.0 - abs(shade)) * c + abs(shade) * toward) for c in channels]
    return "#" + "".join(f"{c:02x}" for c in mixed)
