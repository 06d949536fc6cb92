"""Checks of models as one HTML page, and the picture of each."""

import numpy as np

from articugen.core.records import ArticulatedObject
from articugen.core.tables import counted
from articugen.inspection.check.model import FINDINGS, VERDICTS, Checked, Checks
from articugen.inspection.report.markup import Markup, card, el, hint, join, keys, table
from articugen.inspection.report.page import address, document
from articugen.instance import articulation
from articugen.instance.preparing import canonical_mesh
from articugen.pictures.portrait import parts_portrait

PICTURE = 168  # pixels along an edge


def picture(obj: ArticulatedObject) -> str:
    """Return an address that holds a picture of a model at rest, coloured by part."""
    rest = articulation.forward_kinematics(obj, articulation.canonical_state(obj))
    mesh = canonical_mesh(obj, rest)
    corners = mesh.vertices[mesh.faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    triangles = (corners - (low + high) / 2.0) / (high - low).max()
    return address(parts_portrait(triangles, mesh.part_of_face.astype(np.int64), PICTURE))


def page(checks: Checks, title: str) -> str:
    """Return the page."""
    count = checks.counts()
    tiles = [el("div", el("dt", word), el("dd", f"{count[word]:,}")) for word in VERDICTS]
    rows = [[kind, f"{count[kind]:,}", means] for kind, means in FINDINGS.items() if count[kind]]
    kinds = table(("Finding", ">Models", "~Meaning"), rows, "Findings")
    every = el("div", *map(_model, checks.models), class_="sheet")
    lead = el("p", counted(len(checks.models), "model"), class_="lead")
    parts = [
        ("findings", "Findings", join(el("dl", *tiles, class_="facts"), card(kinds))),
        ("models", "Models", every),
    ]
    header = el("header", el("h1", title), lead)
    return document(f"{title}: models checked", header, parts, "the files of the models")


def _model(model: Checked) -> Markup:
    image = None
    if model.picture:
        image = el("img", src=model.picture, alt=model.name, width=PICTURE, height=PICTURE)
    amiss = keys((finding.kind, finding.text) for finding in model.findings)
    return el(
        "article",
        el("h3", model.name, el("span", model.verdict)),
        el("p", model.problem, class_="warn") if model.problem else None,
        el("div", el("figure", image) if image else None, amiss, class_="tiles checked"),
        None if model.problem else _numbers(model),
        class_="card object",
    )


def _numbers(model: Checked) -> Markup:
    parts = [
        [p.name, f"{p.triangles:,}", f"{p.open_edges:,}", f"{p.two_sided:.0%}", f"{p.sheets:.0%}",
         f"{p.volume:.3g}", "-" if p.iou is None else f"{p.iou:.3f}"]
        for p in model.parts
    ]  # fmt: skip
    joints = [
        [j.name, j.kind, *("-" if end is None else f"{end:.3g}" for end in (j.lower, j.upper)),
         f"{j.pivot_distance:.3g}", f"{j.colliding:.0%}"]
        for j in model.joints
    ]  # fmt: skip
    head = ("Part", ">Faces", ">Open edges", ">Two-sided", ">Sheets", ">Volume", ">IoU")
    below = ("Joint", "Kind", ">From", ">To", ">Axis off", ">Collides")
    return el(
        "details",
        el("summary", "Parts and joints"),
        table(head, parts, "Parts"),
        table(below, joints, "Joints") if joints else None,
        hint(f"Material {model.volume:.3g}, shut in {model.enclosed:.3g}, in the file's unit."),
    )
