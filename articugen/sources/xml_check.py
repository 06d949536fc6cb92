"""Rules for elements of a stranger's XML; each fault is one sentence: file, element, cure."""

import math
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from articugen.core.errors import InvalidSource
from articugen.meshes.model_files import MAX_NAME_BYTES, quoted

MAX_LINKS = 2_000
MAX_VISUALS = 5_000
MAX_NUMBER = 1e6  # largest length (m), angle (rad), scale or multiplier
MIN_SIZE = 1e-9  # smallest size (m) of a shape, and scale of a mesh

MAX_LETTERS = 1_000  # of an attribute with numbers


class Check:
    """The rules for elements of the file at `path`. Those of the tags `owners` have names, by which
    messages call what is in them."""

    def __init__(self, path: Path, owners: Collection[str]) -> None:
        self.path, self.owners = path, owners

    def refuse(self, element: Any, problem: str) -> InvalidSource:
        """Return the error for an element, which is named by its nearest ancestor with a name."""
        owner = element
        while owner.tag not in self.owners and owner.getparent() is not None:
            owner = owner.getparent()
        name = owner.get("name")
        where = (
            f"{owner.tag} {quoted(name)}" if name else f"<{owner.tag}> at line {owner.sourceline}"
        )
        return InvalidSource(f"{self.path}: {where}: {problem}")

    def count(self, elements: list[Any], what: str, most: int) -> None:
        if len(elements) > most:
            raise InvalidSource(
                f"{self.path}: {len(elements):,} {what}, at most {most:,} are read; split the model"
                " or join some"
            )

    def named(self, elements: Iterable[Any]) -> dict[str, Any]:
        """Return elements by their names, which all have and no two share."""
        by_name: dict[str, Any] = {}
        for element in elements:
            name = element.get("name")
            if not name:
                raise self.refuse(element, "has no name; give it one")
            if len(name.encode()) > MAX_NAME_BYTES:
                raise self.refuse(
                    element, f"has a name of more than {MAX_NAME_BYTES} bytes; shorten it"
                )
            if name in by_name:
                raise self.refuse(
                    element,
                    f"a second {element.tag} of that name at line {element.sourceline}; rename one",
                )
            by_name[name] = element
        return by_name

    def child(self, element: Any, tag: str, *, required: bool = False) -> Any:
        """Return the one child `<tag>`, or None."""
        elements = element.findall(tag)
        if len(elements) > 1 or (required and not elements):
            raise self.refuse(
                element, f"has {len(elements) or 'no'} <{tag}>; a {element.tag} has one"
            )
        return elements[0] if elements else None

    def numbers(
        self,
        element: Any,
        attribute: str,
        counts: tuple[int, ...],
        default: str | None = None,
        *,
        infinite: bool = False,
        most: float = MAX_NUMBER,
    ) -> list[float]:
        """Return the numbers of an attribute, as many as one of `counts`, none beyond `most`; where
        they may be `infinite`, numbers beyond are.

        They are written back in one plain form, so that whoever reads them reads what was checked.
        """
        text = element.get(attribute, default)
        if text is None:
            raise self.refuse(element, f"<{element.tag}> has no {attribute}; add it")
        wanted = " or ".join(map(str, counts)) + " number" + ("s" if counts[-1] > 1 else "")
        try:
            values = [float(word) for word in text[:MAX_LETTERS].replace(",", " ").split()]
        except ValueError:
            values = []
        fine = len(values) in counts and not any(map(math.isnan, values))
        fine = fine and len(text) <= MAX_LETTERS
        if infinite:
            values = [x if abs(x) <= most else math.copysign(math.inf, x) for x in values]
        what = f"<{element.tag}> {attribute}={quoted(text)}"
        if not fine or not (infinite or all(map(math.isfinite, values))):
            raise self.refuse(element, f"{what} is not {wanted}; correct it")
        if not infinite and any(abs(x) > most for x in values):
            raise self.refuse(element, f"{what} is beyond {most:,.0f}; correct it")
        if attribute in element.attrib:
            element.set(attribute, " ".join(map(repr, values)))
        return values
