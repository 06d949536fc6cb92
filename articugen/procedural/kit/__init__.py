"""What the generators of several categories share: outlines, solids, parts, models and their files.

Lengths are metres. `outlines` are polygons, `solids` gives them a third dimension, `parts` are
handles, plates and the like, `model` joins solids to links and joints, `writer` makes files of it.
"""

import numpy as np

MM = 1e-3  # a millimetre

GAP = 3 * MM  # between a door or a drawer and whatever it passes, on all sides, in every state

RANGE = (0.0, float(np.deg2rad(135.0)))
"""How far lids and doors open: the range from which the PPD paper draws their states."""
