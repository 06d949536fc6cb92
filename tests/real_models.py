"""Real models to test against: the folder that ARTICUGEN_REAL_MODELS names, if any."""

import os
from pathlib import Path

import pytest

REAL_MODELS = Path(os.environ.get("ARTICUGEN_REAL_MODELS", "/nonexistent"))

needs_real_models = pytest.mark.skipif(
    "ARTICUGEN_REAL_MODELS" not in os.environ,
    reason="real models are not ours to publish; ARTICUGEN_REAL_MODELS names their folder",
)
