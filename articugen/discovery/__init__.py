"""The joints of an object, found from several poses of it, or those that objects of a category
share, from one pose of each; without labels."""

from articugen.discovery.chains import discover_chains
from articugen.discovery.discover import KINDS, LEAN, Directions, discover
from articugen.discovery.joints import Discovery, FoundJoint, Joints
from articugen.discovery.one_camera import discover_views
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
    "discover_chains",
    "discover_shared",
    "discover_views",
    "parts_of_surface",
]
