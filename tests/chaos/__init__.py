"""Commands that are killed and disks that fail, at every moment: `make chaos`.

docs/reliability.md says what is promised; here each promise is tried.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # as pytest has it: what tests share lies there
