"""Whether data are what they claim: in their bytes, their geometry, and made once more.

`articugen.verify` is this package and, whatever was imported first, a function too: `check.check`.
"""

from articugen.core.calling import called_as

called_as(__name__, "check", "check")
