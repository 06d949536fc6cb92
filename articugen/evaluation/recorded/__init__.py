"""Recordings of depth cameras whose parts' true poses are known, by their published layouts."""

from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.evaluation.recorded import aod, opalign, rbo
from articugen.evaluation.recorded.frames import Recording


def read_recording(folder: Path, count: int) -> Recording:
    """Return up to `count` images of a sequence, evenly from the first to the last.

    Args:
        folder: of a sequence of RBO or of the Articulated Object Dataset, or an object's views for
            OP-Align.

    Raises:
        InvalidSource: it is none, or something in it is missing or broken.
    """
    for layout in (rbo, aod, opalign):
        if any(path.is_dir() for name in layout.DEPTH for path in folder.glob(name)):
            return layout.read(folder, count)
    raise InvalidSource(
        f"{folder}: no sequence of RBO ({rbo.DEPTH[0]}/), of the Articulated Object Dataset "
        f"({aod.DEPTH[0]}/) or of OP-Align ({opalign.DEPTH[0]}/); name a folder that holds one"
    )
