"""Recordings of depth cameras whose parts' true poses are known, by their published layouts."""

from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.evaluation.recorded import aod, rbo
from articugen.evaluation.recorded.frames import Recording


def read_recording(folder: Path, count: int) -> Recording:
    """Return up to `count` images of a sequence, evenly from the first to the last.

    Args:
        folder: of a sequence of RBO or of the Articulated Object Dataset.

    Raises:
        InvalidSource: it is neither, or something in it is missing or broken.
    """
    for layout in (rbo, aod):
        if any((folder / name).is_dir() for name in layout.DEPTH):
            return layout.read(folder, count)
    raise InvalidSource(
        f"{folder}: no sequence of RBO ({rbo.DEPTH[0]}/) or of the Articulated Object Dataset "
        f"({aod.DEPTH[0]}/); name a folder that holds one of these"
    )
