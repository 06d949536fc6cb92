"""The same answer every time, in any order of tests: chance is the same for each of them.

`make fuzz` draws anew, by `--hypothesis-profile=chance`; what it finds is printed, and becomes an
`@example` of its test.
"""

import random
import sys

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile("same", derandomize=True, database=None, deadline=None)
# On a build server hypothesis is derandomised unless it is asked for chance.
settings.register_profile(
    "chance", derandomize=False, database=None, deadline=None, print_blob=True
)
settings.load_profile("same")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Begin with the same random numbers, whichever tests came before in this process."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - libraries draw from it
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)
