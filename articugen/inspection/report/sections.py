"""What stands in each section of a report."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.arrays import grouped
from articugen.core.colours import colour_of
from articugen.core.records import JointKind
from articugen.core.tables import counted, duration, size
from articugen.inspection.likeness import Likeness, rows
from articugen.inspection.report.facts import Facts, JointStates, ObjectFacts, spread_text

from articugen.inspection.report.markup import (  # isort: skip
    MOST_ROWS, SPACE, Markup, card, dot, el, folded, hint, histogram, join, keys, share_bar, table,
)  # fmt: skip
from articugen.inspection.report.truth import Measured
from articugen.pictures.contact_sheet import Portraits
from articugen.store.manifest import Manifest
from articugen.store.outcome import ObjectEntry

Entries = Mapping[tuple[str, str], ObjectEntry]  # of a manifest, by split and id
MOST_JOINTS = 24  # joints of one number whose histograms are drawn


def header(path: Path, facts: Facts, manifest: Manifest | None) -> Markup:
    """Return the title, and what the page is about in a sentence."""
    where = f" of {path.name}" if path.suffix == ".h5" else ""
    where = f" from {_source(manifest)}" if manifest else where
    text = f"{counted(len(facts.objects), 'object')} in {counted(facts.instances, 'joint state')}"
    title = el("h1", str(facts.about["category"]))
    return el("header", title, el("p", text + where, class_="lead"))


def overview(facts: Facts, manifest: Manifest | None) -> Markup:
    splits = Counter(one.split for one in facts.objects)
    per_split = ", ".join(f"{n:,} {split}" for split, n in sorted(splits.items(), reverse=True))
    joints = sorted({len(one.joints) for one in facts.objects})
    moving = str(joints[0]) if len(joints) == 1 else f"{joints[0]} to {joints[-1]}"
    occupied = np.concatenate([one.occupied for one in facts.objects])
    known = occupied[np.isfinite(occupied)]
    an_object = facts.instances / len(facts.objects)
    tiles = [
        ("Objects", f"{len(facts.objects):,}", per_split),
        ("Instances", f"{facts.instances:,}", f"{an_object:.0f} an object"),
        ("Moving joints", moving, "an object"),
        ("Size", size(facts.bytes), f"{size(facts.bytes / facts.instances)} an instance"),
    ]
    if len(known):
        spread = f"{known.min():.1%} to {known.max():.1%}"
        tiles.append(("Occupied", f"{known.mean():.1%}", f"of the unit cube; {spread}"))
    if manifest:
        out = len(manifest.rejected) + len(manifest.failed)
        tiles.append(("Left out", f"{out:,}", f"{len(manifest.skipped):,} skipped"))
    short = manifest.shortfall if manifest else ""
    return join(
        el("dl", *(el("div", el("dt", name), el("dd", value, el("small", more)))
                   for name, value, more in tiles), class_="facts"),
        el("p", short, class_="warn") if short else None,
    )  # fmt: skip


def turning(shown: Mapping[str, Any] | None, stills: Mapping[str, str]) -> Markup:
    """Return the card that viewer.js fills, for now with one of the `stills`, by names."""
    if shown is None:
        return hint("No surface points are stored, so there is nothing to turn.")
    still, alt = stills.get(shown["name"]), f"{shown['name']} in its canonical pose"
    image = el("img", src=still, alt=alt) if still else None
    return join(
        hint("The surface of each part, from its stored points alone; parts move rigidly about "
             "the stored axes and pivots."),
        el("noscript", hint("Turning needs JavaScript; all else on this page does without.")),
        el("div", el("div", image, class_="stage"), class_="card viewer", id_="viewer"),
    )  # fmt: skip


def sheet(
    drawn: Sequence[Portraits], pictures: Mapping[str, Sequence[str]], facts: Facts
) -> Markup:
    if not drawn:
        return hint("No surface points are stored, so there is nothing to draw.")
    count, total = len(drawn), len(facts.objects)
    which = f"{count} of {total:,} objects, chosen evenly" if count < total else "All objects"
    order = f"{which}: the canonical pose first, then random states, the farthest last."
    cards = []
    for portraits in drawn:
        one, figures = portraits.chosen, []
        for picture, caption in zip(pictures[one.object_id], portraits.captions, strict=True):
            states = [el("span", dot(colour), SPACE, state) for state, colour in caption]
            alt = f"{one.object_id}, joints at {', '.join(state for state, _ in caption)}"
            image = el("img", src=picture, alt=alt, width="168", height="168")
            figures.append(el("figure", image, el("figcaption", *states)))
        title = el("h3", one.object_id, el("span", one.split))
        tiles = el("div", *figures, class_="tiles")
        cards.append(el("article", title, tiles, class_="card object"))
    return join(hint(order), el("div", *cards, class_="sheet"))


def joints(objects: Sequence[ObjectFacts]) -> Markup:
    """Return a histogram for each number of a joint, and kind."""
    every = (numbered for one in objects for numbered in enumerate(one.joints))
    groups = grouped(((j, joint.kind), joint) for j, joint in every)
    cards = [_states(j, kind, same) for (j, kind), same in sorted(groups.items())[:MOST_JOINTS]]
    more = len(groups) - len(cards)
    return join(
        hint("Where the random states lie between the least and the greatest that their object "
                "allows. The dashed line is what an even spread has."),
        el("div", *cards, class_="grid"),
        hint(f"{more:,} more joints are not drawn.") if more > 0 else None,
    )  # fmt: skip


def _states(j: int, kind: JointKind, same: Sequence[JointStates]) -> Markup:
    unit = same[0].unit
    shares = np.concatenate([(s.drawn - s.lower) / max(s.upper - s.lower, 1e-12) for s in same])
    ends = tuple(spread_text([getattr(s, end) for s in same], unit) for end in ("lower", "upper"))
    title = _common(Counter(s.name for s in same if s.name)) or f"joint {j}"
    beyond = int(np.sum((shares < -1e-6) | (shares > 1 + 1e-6)))
    text = f"{len(shares):,} random states of {counted(len(same), 'object')}"
    chart = histogram(
        shares, 0.0, 1.0, (ends[0], ends[1]), colour=colour_of(j + 1), even=True,
        title=f"{title}: {text}, from {ends[0]} to {ends[1]}",
    )  # fmt: skip
    return card(
        el("h3", dot(colour_of(j + 1)), SPACE, title),
        hint(f"joint {j}, {kind}; {text}"),
        chart,
        el("p", f"{beyond:,} states lie outside of their range", class_="warn") if beyond else None,
    )


def parts(objects: Sequence[ObjectFacts]) -> Markup:
    """Return how large each part is, and how much of the unit cube is inside."""
    by_part = grouped(numbered for one in objects for numbered in enumerate(one.parts))
    rows, shares = [], []
    for k, same in sorted(by_part.items()):
        shares.append((float(np.nansum([p.surface for p in same])), colour_of(k)))
        names = _common(Counter(p.semantic or p.name for p in same if p.semantic or p.name))
        boxes = np.array([p.box for p in same])
        boxes = boxes[np.isfinite(boxes).all(axis=1)]
        box = " × ".join(f"{side:.3g}" for side in np.median(boxes, axis=0)) if len(boxes) else "–"
        title = el("span", dot(colour_of(k)), SPACE, k, SPACE, el("span", names, class_="hint"))
        means = [_mean([getattr(p, name) for p in same]) for name in ("surface", "volume")]
        rows.append([title, f"{len(same):,}", *means, box])
    head = ("Part", ">Objects", ">Surface", ">of the cube", ">Box (median)")
    occupied = np.concatenate([one.occupied for one in objects])
    occupied = occupied[np.isfinite(occupied)]
    return el(
        "div",
        card(
            el("h3", "Sizes"),
            share_bar(shares, "Share of the visible surface of each part"),
            table(head, rows[:MOST_ROWS], "Parts and their sizes"),
        ),
        _occupied(occupied) if len(occupied) else None,
        class_="pair",
    )


def _occupied(shares: np.ndarray) -> Markup:
    low, high = 100.0 * float(shares.min()), 100.0 * float(shares.max())
    chart = histogram(
        100.0 * shares, low, high, (f"{low:.1f} %", f"{high:.1f} %"), colour=colour_of(1),
        title=f"Occupied share of the unit cube, {len(shares):,} instances",
    )  # fmt: skip
    sentence = (
        f"Share of the unit cube inside of an instance, enclosed space included: "
        f"{shares.mean():.1%} on average over {len(shares):,} instances."
    )
    return card(el("h3", "Occupied"), hint(sentence), chart)


def truth(measured: Measured) -> Markup:
    if not measured.instances:
        return hint(f"Not measured. {measured.why_not}")
    rows = [
        [title, el("b", f"{measured.total(name):.4%}"), f"{measured.worst(name):.4%}"]
        for name, title in _MEASURES
    ]
    objects = len({one.object_id for one in measured.instances})
    sentence = (
        f"Stored labels of {counted(len(measured.instances), 'instance')} of "
        f"{counted(objects, 'object')} against the exact solids that their models were made from, "
        "brought to each pose by the stored motions. Nothing of what made the labels is used."
    )
    return join(
        hint(sentence),
        el("div", table(("", ">All together", ">Worst instance"), rows, "Agreement"),
           class_="card narrow"),
    )  # fmt: skip


_MEASURES = (
    ("uniform", "Material, uniform points (IoU)"),
    ("near", "Material, points near the surface (IoU)"),
    ("part", "Points in one part that carry its label"),
    ("surface", "Surface points with their own part right behind"),
)


def one_object(
    about: ObjectFacts, manifest: Manifest | None, measured: Measured
) -> list[tuple[str, str]]:
    """Return what is known of one object, as titles and texts."""
    lines = [("Instances", f"{len(about.rows)}"), ("Box (model's unit)", _box(about))]
    lines.append(("Occupied", _mean([float(about.occupied.mean())])))
    if measured.instances:
        lines += [(title, f"{measured.total(name):.2%}") for name, title in _MEASURES]
    else:
        lines.append(("Truth", f"Not measured. {measured.why_not}"))
    if manifest:
        lines += [("Source", _source(manifest)), ("Licence of the model", manifest.licence)]
        keys = [o for o in manifest.objects if o.key.object_id == about.object_id]
        lines += [("Note", note) for o in keys if o.key.split == about.split for note in o.notes]
    return lines


def _box(about: ObjectFacts) -> str:
    return " × ".join(f"{side:.3g}" for side in about.box) if np.isfinite(about.box).all() else "–"


def alike(other: Path, likeness: Likeness, picture: str) -> Markup:
    """Return how alike the objects are to those of another set, and those that are least so."""
    lines = table(("", ">These", f">{other}"), rows(likeness), "Likeness")
    return join(
        hint("Distances are Chamfer distances in the canonical pose, a longest edge is 1; all else "
             "is the median (10 %, 90 %). The pictures are of the others that are farthest from "
             "any object here, with the nearest one here below."),
        el("div", lines, class_="card narrow"),
        card(el("figure", el("img", src=picture, alt="The farthest of the other set"))),
    )  # fmt: skip


def entries_of(manifest: Manifest | None) -> Entries:
    """Return what a manifest lists, to be looked up."""
    return {(o.key.split, o.key.object_id): o for o in manifest.objects} if manifest else {}


def objects(every: Sequence[ObjectFacts], manifest: Manifest | None) -> Markup:
    """Return a table of all objects, closed at first."""
    entries, rows = entries_of(manifest), list[list[object]]()
    for one in every[:MOST_ROWS]:
        entry = entries.get((one.split, one.object_id))
        rows.append(
            [one.object_id, one.split, f"{len(one.rows)}", f"{len(one.joints)}", _box(one),
             _mean([float(one.occupied.mean())]), one.shard.name,
             el("code", entry.content_sha256[:16]) if entry else "–",
             " ".join(entry.notes) if entry else ""]
        )  # fmt: skip
    head = ("Object", "Split", ">Instances", ">Joints", "Box", ">Occupied", "Shard", "Content",
            "~Notes")  # fmt: skip
    noted = sum(bool(entry.notes) for entry in entries.values())
    return join(
        hint(f"{noted:,} of {len(every):,} objects have notes from their making.") if noted else "",
        folded(f"All {len(every):,} objects", table(head, rows, "Objects"), len(every)),
    )


def left_out(manifest: Manifest | None) -> Markup:
    if manifest is None:
        return hint("Without a manifest there is no telling what was left out.")
    kinds = [(word, getattr(manifest, word)) for word in ("failed", "rejected", "skipped")]
    rows = [[row.key.object_id, row.key.split, word, row.reason]
            for word, out in kinds for row in out]  # fmt: skip
    if not rows:
        return el("p", "Nothing: every object that was asked for became data.", class_="good")
    counts = ", ".join(f"{len(out):,} {word}" for word, out in kinds if out)
    listed = table(("Object", "Split", "", "~Why"), rows[:MOST_ROWS], "Objects left out")
    few = len(rows) <= 12
    return join(hint(f"{counts}."), card(listed) if few else folded("All", listed, len(rows)))


def recipe(facts: Facts, manifest: Manifest | None) -> Markup:
    """Return every key of the recipe, those of a group under each other."""
    text = manifest.recipe if manifest else str(facts.about["recipe"])
    try:
        groups = json.loads(text)
    except ValueError:
        return el("pre", text, class_="card")
    plain = {key: value for key, value in groups.items() if not isinstance(value, dict)}
    nested = {key: value for key, value in groups.items() if isinstance(value, dict)}
    cards = [
        card(el("h3", title), keys((key, _plain(value)) for key, value in values.items()))
        for title, values in ({"recipe": plain} | nested).items()
    ]
    return el("div", *cards, class_="pair")


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_plain, value)) or "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return {None: "not set", True: "yes", False: "no"}.get(value, str(value))


def provenance(facts: Facts, manifest: Manifest | None) -> Markup:
    about = facts.about
    lines: list[tuple[str, object]] = [
        ("Seed", about["seed"]),
        ("Format", f"version {about['schema_version']}"),
        ("articugen", about["articugen_version"]),
        ("Recipe's sha256", el("code", about["recipe_sha256"])),
    ]
    if manifest:
        took = manifest.timings
        machine = ", ".join(f"{value}" for value in manifest.machine.values())
        versions = ", ".join(f"{name} {number}" for name, number in manifest.versions.items())
        lines = [
            ("Source", _source(manifest)),
            ("Licence of the models", manifest.licence),
            *lines,
            ("Commit", el("code", manifest.commit or "none: an installed package")),
            ("Libraries", versions),
            ("Machine", f"{machine} cores"),
            ("Last run", f"{duration(took.seconds)}, {took.instances_per_second:.1f} instances/s "
                         f"on {counted(took.workers, 'worker')}"),
            ("Content's sha256", el("code", manifest.content_sha256)),
            ("Manifest's sha256", el("code", manifest.manifest_sha256)),
        ]  # fmt: skip
    return join(
        card(keys(lines, "keys long")),
        folded("Fields and their sizes", _fields(facts), 99),
        folded("Shards and their checksums", _shards(facts, manifest), 99),
        hint("articugen verify reads every byte and compares it with these.") if manifest else None,
    )


def _source(manifest: Manifest) -> str:
    """Its name; of a folder the last of its path, as the page may travel."""
    return Path(manifest.source).name


def _fields(facts: Facts) -> Markup:
    rows = [
        [el("code", name), shape, size(stored), size(stored / facts.instances)]
        for name, (shape, stored) in sorted(facts.fields.items())
    ]
    rest = facts.bytes - sum(stored for _, stored in facts.fields.values())
    rows.append(["index, headers", "", size(rest), ""])
    per_instance = size(facts.bytes / facts.instances)
    rows.append([el("b", "all"), "", el("b", size(facts.bytes)), per_instance])
    return table(("Field", "Shape", ">On disk", ">An instance"), rows, "Fields")


def _shards(facts: Facts, manifest: Manifest | None) -> Markup:
    rows = [[path.name, "", size(path.stat().st_size), "–"] for path in facts.shards]
    if manifest:
        rows = [[s.name, f"{s.instances:,}", size(s.bytes), el("code", s.sha256)]
                for s in manifest.shards]  # fmt: skip
    return table(("Shard", ">Instances", ">Size", "sha256"), rows[:MOST_ROWS], "Shards")


def _common(names: Counter[str]) -> str:
    """Return the most common names, and that there are others."""
    some = ", ".join(name for name, _ in names.most_common(2))
    return some + (", …" if len(names) > 2 else "")


def _mean(shares: Sequence[float]) -> str:
    known = [share for share in shares if np.isfinite(share)]
    return f"{np.mean(known):.1%}" if known else "–"
