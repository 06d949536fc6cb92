"""The report as HTML: one file without a request, which lets nothing in it run but its own script.

Names and sentences of a data set are text wherever they stand (`markup`), and a
Content-Security-Policy names the digests of the one style and the one script there are.
"""

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from io import BytesIO
from pathlib import Path

from articugen.core.content import VERSION
from articugen.core.errors import InvalidArgument, printable
from articugen.core.files import check_place, write_atomically
from articugen.inspection.likeness import farthest, likeness
from articugen.inspection.report import sections
from articugen.inspection.report.facts import Facts, ObjectFacts, facts
from articugen.inspection.report.markup import Markup, el
from articugen.inspection.report.truth import Measured, measured
from articugen.inspection.report.turnable import turnable
from articugen.pictures.contact_sheet import Chosen, portraits, some_of
from articugen.pictures.shading import Picture
from articugen.store.manifest import MANIFEST_NAME, Manifest

OBJECTS, STATES = 12, 3  # of the contact sheet, unless more are asked for
PICTURE = 168  # pixels along an edge of a picture on the sheet
POOLED = 3  # instances whose points make a picture: it is smaller than a sheet's
Section = tuple[str, str, Markup]  # its name, its title, what it says
ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg'%3E%3Crect width='16' height='16' "
    "fill='%23bb5566'/%3E%3C/svg%3E"
)


def write_report(
    path: Path,
    shards: Sequence[Path],
    html: Path,
    *,
    beside: Path | None = None,
    objects: int = OBJECTS,
    states: int = STATES,
) -> int:
    """Write the report of a data set, or of one shard, as an HTML file; its size in bytes.

    Args:
        path: the folder, or the shard; `shards` those that it stands for.
        html: the file to write.
        beside: another data set, or a shard, to which its objects are compared.
        objects, states: rows and columns of the contact sheet.

    Raises:
        CorruptShard: a shard or the manifest cannot be read.
        InvalidArgument: `html` is named like something else; there is nothing to compare.
        MachineFault: `html` cannot be written.
    """
    check_html(html)
    alike: list[Section] = []
    if beside is not None:
        compared = likeness(path, beside)
        content = sections.alike(beside, compared, address(farthest(compared)))
        alike = [("likeness", "Likeness", content)]
    manifest = Manifest.read(path) if (path / MANIFEST_NAME).is_file() else None
    about = facts(shards)
    category = str(about.about["category"])
    shown = some_of(drawable(category, about.objects), objects)
    drawn = portraits(shown, states=states, pooling=POOLED, size=PICTURE)
    pictures = {one.chosen.object_id: list(map(address, one.pictures)) for one in drawn}
    turned = turnable(about.objects)
    stills = {printable(name): some[0] for name, some in pictures.items()}
    parts = sections_of(about, manifest, measured(about.objects, manifest), alike)
    parts[1:1] = [
        ("turn", "Turn it", sections.turning(turned, stills)),
        ("sheet", "Contact sheet", sections.sheet(drawn, pictures, about)),
    ]
    title, head = f"{category}: report of a data set", sections.header(path, about, manifest)
    data = document(title, head, parts, "what the data set holds", scene=turned).encode()
    write_atomically(html, data)
    return len(data)


def drawable(category: str, objects: Sequence[ObjectFacts]) -> list[Chosen]:
    """Return those with a surface, as is known without reading a shard again."""
    return [
        Chosen(category, one.split, one.object_id, [(one.shard, row) for row in one.rows])
        for one in objects
        if one.points > 1
    ]


def document(
    title: str,
    header: Markup,
    parts: Sequence[Section],
    basis: str,
    *,
    scene: object = None,
    scripts: Sequence[str] = ("viewer.js",),
    sources: str = "",
    complete: str = "This file is complete: it opens without a network.",
) -> str:
    """Return an HTML document that is complete in itself, or with files beside it.

    Args:
        parts: the sections.
        basis: what it is written from, for the footer.
        scene: what the script beside turns, if anything.
        scripts: files of this folder that are its script, one after the other.
        sources: where else its pictures and scripts may come from, as a policy has it.
        complete: a sentence for the footer.
    """
    beside = files("articugen.inspection.report")
    style, *pieces = ((beside / name).read_text("utf-8") for name in ("page.css", *scripts))
    script = "".join(pieces)
    policy = (
        f"default-src 'none'; img-src {sources} data:; style-src '{_digest(style)}'; "
        f"script-src {sources} '{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    # data, not code: no `<` in it can end the element
    data = json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c") if scene else ""
    head = el(
        "head",
        el("meta", charset="utf-8"),
        el("meta", http_equiv="Content-Security-Policy", content=policy),
        el("meta", name="viewport", content="width=device-width, initial-scale=1"),
        el("meta", name="color-scheme", content="light dark"),
        el("meta", name="generator", content=f"articugen {VERSION}"),
        el("title", title),
        el("link", rel="icon", href=ICON),  # or a host is asked for one
        el("style", Markup(style)),
    )
    links = [el("li", el("a", heading, href=f"#{name}")) for name, heading, _ in parts]
    shown = [
        el("section", el("h2", heading, id_=f"{name}-title"), inside,
           id_=name, aria_labelledby=f"{name}-title")
        for name, heading, inside in parts
    ]  # fmt: skip
    body = el(
        "body",
        el("a", "Skip to the report", href=f"#{parts[0][0]}", class_="skip"),
        header,
        el("nav", el("ul", *links), aria_label="Sections"),
        el("main", *shown),
        el("footer", el("p", f"Written by articugen {VERSION} from {basis}. {complete}")),
        el("script", Markup(data), type="application/json", id_="scene") if data else None,
        el("script", Markup(script)),
    )  # fmt: skip
    return "<!doctype html>\n" + el("html", head, body, lang="en") + "\n"


def check_html(html: Path) -> None:
    """Raise InvalidArgument or MachineFault where no report can be written to `html`."""
    if html.suffix.lower() not in (".html", ".htm"):  # it may be somebody's data
        raise InvalidArgument(f"{html}: a report is an HTML file; give it a name ending in .html")
    check_place(html)


def sections_of(
    about: Facts, manifest: Manifest | None, truth: Measured, alike: Sequence[Section] = ()
) -> list[Section]:
    """Return the sections without pictures of objects; `alike` those of a comparison."""
    every = about.objects
    return [
        ("overview", "Overview", sections.overview(about, manifest)),
        ("joints", "Joints", sections.joints(every)),
        ("parts", "Parts", sections.parts(every)),
        ("truth", "Truth", sections.truth(truth)),
        *alike,
        ("objects", "Objects", sections.objects(every, manifest)),
        ("left-out", "Left out", sections.left_out(manifest)),
        ("recipe", "Recipe", sections.recipe(about, manifest)),
        ("provenance", "Provenance", sections.provenance(about, manifest)),
    ]


def address(picture: Picture) -> str:
    """Return an address that holds a picture."""
    return f"data:image/webp;base64,{base64.b64encode(webp(picture)).decode()}"


def webp(picture: Picture) -> bytes:
    """Return a picture as the bytes of a file."""
    file = BytesIO()
    picture.save(file, "WEBP", quality=82, method=4)
    return file.getvalue()


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
