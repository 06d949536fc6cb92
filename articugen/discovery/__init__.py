"""The joints of an object, found from several poses of it, without labels."""

from articugen.discovery.discover import (
    KINDS,
    LEAN,
    Directions,
    Discovery,
    FoundJoint,
    discover,
)
from articugen.discovery.ownership import Ownership, assign_material

__all__ = [
    "KINDS",
    "LEAN",
    "Directions",
    "Discovery",
    "FoundJoint",
    "Ownership",
    "assign_material",
    "discover",
]
