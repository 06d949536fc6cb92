"""Data sets in the formats that others' trainers, viewers and simulators read: a file a format.

`articugen.export` is this package and, whatever was imported first, a function too: `run.export`.
"""

from articugen.core.calling import called_as

called_as(__name__, "run", "export")
