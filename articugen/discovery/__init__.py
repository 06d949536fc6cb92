"""The joints of an object, found from several poses of it, without labels."""

from articugen.discovery.discover import Discovery, FoundJoint, discover

__all__ = ["Discovery", "FoundJoint", "discover"]
