"""XML from strangers: parsed without recovery, entities, network or DOCTYPE."""

import re
from pathlib import Path
from typing import Any

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from articugen.core.errors import InvalidSource

OLD_VERSION = re.compile(rb"""(<\?xml\s+version\s*=\s*["'])0\.0(?=["'])""")
"""What files of Bullet begin with; libxml2 knows no such version."""


def parse_xml(data: bytes, path: Path) -> Any:
    """Return the root element (lxml) of a well-formed document without DOCTYPE, comments removed;
    `path` is its name for messages. libxml2's own limits stay on (`huge_tree=False`): depth 256, 10
    MB in one text. Version 0.0 is read as 1.0.

    Raises:
        InvalidSource: not well-formed, too deep, too large, or with a DOCTYPE.
        MemoryError: libxml2 gets no memory.
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
    start = OLD_VERSION.match(data)
    try:
        root = etree.fromstring(start[1] + b"1.0" + data[start.end() :] if start else data, parser)
    except (etree.XMLSyntaxError, ValueError, LookupError) as error:
        if getattr(error, "code", None) == etree.ErrorTypes.ERR_NO_MEMORY:
            raise MemoryError(f"{path}: no memory to read it") from None
        reason = " ".join(str(error).split())[:200]
        raise InvalidSource(
            f"{path}: not well-formed XML ({reason}); correct it there, nothing is guessed"
        ) from None
    if root.getroottree().docinfo.doctype:
        raise InvalidSource(f"{path}: has a DOCTYPE, which is refused; remove it from the file")
    return root


def drop_default_namespaces(root: Any) -> None:
    """Have elements without a prefix belong to no namespace, whatever `xmlns=` says.

    That is how readers that know no namespaces (urdfdom's TinyXML) see them.
    """
    for element in root.iter("*"):
        if element.prefix is None and element.tag.startswith("{"):
            element.tag = element.tag.rpartition("}")[2]
    etree.cleanup_namespaces(root)


def tostring(root: Any) -> bytes:
    """Return the document of a root element; in ASCII, names of other letters would be no names."""
    return etree.tostring(root, encoding="utf-8")
