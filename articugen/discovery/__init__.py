"""The joints of an object, found from several poses of it, or those that objects of a category
share, from one pose of each; without labels."""

from articugen.discovery.discover import (
    KINDS,
    LEAN,
    Directions,
    Discovery,
    FoundJoint,
    Joints,
    discover,
)
from articugen.discovery.ownership import Ownership, parts_of_surface
from articugen.discovery.shared import Category, SharedJoint, discover_shared

__all__ = [
    "KINDS",
    "LEAN",
    "Category",
    "Directions",
    "Discovery",
    "FoundJoint",
    "Joints",
    "Ownership",
    "SharedJoint",
    "discover",
    "discover_shared",
    "parts_of_surface",
]
