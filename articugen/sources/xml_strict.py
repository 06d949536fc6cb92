"""XML from strangers: parsed without recovery, entities, network or DOCTYPE."""

from pathlib import Path
from typing import Any

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from articugen.errors import InvalidSource


def parse_xml(data: bytes, path: Path) -> Any:
    """The root element (lxml) of a well-formed document without DOCTYPE, comments removed.

    libxml2's own limits stay on (`huge_tree=False`): depth 256, 10 MB in one text.

    Args:
        data: the bytes of the file.
        path: its name, for messages only.

    Raises:
        InvalidSource: not well-formed, too deep, too large, or with a DOCTYPE.
    """
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        recover=False,
        remove_comments=True,
        remove_pis=True,
    )
    try:
        root = etree.fromstring(data, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InvalidSource(
            f"{path}: not well-formed XML ({error}); correct it there, nothing is guessed"
        ) from None
    if root.getroottree().docinfo.doctype:
        raise InvalidSource(f"{path}: has a DOCTYPE, which is refused; remove it from the file")
    return root
