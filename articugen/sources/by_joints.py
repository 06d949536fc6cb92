"""Objects chosen by the kinds of their joints, without reading a mesh."""

from collections.abc import Collection

from articugen.core.errors import InvalidSource
from articugen.core.records import JointKind
from articugen.core.yaml_files import unlisted
from articugen.sources import readers
from articugen.sources.refs import ObjectRef

KINDS = tuple(str(kind) for kind in JointKind if kind != JointKind.FIXED)
"""What `joints` may name, in URDF's words."""


def of_joints(refs: list[ObjectRef], joints: Collection[str], category: str) -> list[ObjectRef]:
    """Return the objects that have joints that move, all of them of the kinds `joints`, as
    `Source.objects` says; InvalidSource if none is left, or a word is no kind of joint."""
    for word in joints:
        if word not in KINDS:
            raise InvalidSource(unlisted("kind of joint", word, KINDS))
    left = [ref for ref in refs if not joints or _fits(ref, frozenset(joints))]
    if refs and not left:
        raise InvalidSource(
            f"no object of {category!r} has {' and '.join(sorted(set(joints)))} joints alone; name "
            f"more of {', '.join(KINDS)}"
        )
    return left


def _fits(ref: ObjectRef, wanted: frozenset[str]) -> bool:
    from articugen.meshes.read import wanting  # noqa: PLC0415 - slow to import

    try:
        with wanting("nothing"):
            obj = readers.load(ref)
    except InvalidSource:
        return True
    kinds = {str(joint.kind) for joint in obj.moving_joints}
    return bool(kinds) and kinds <= wanted
