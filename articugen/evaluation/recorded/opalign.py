"""Views of a laptop as OP-Align (Che et al., ECCV 2024) reads its real data, and we export:

    <category>/<split>/<object>/<state>/input_2/<camera>.npz

Part 0 is taken for the base. Lengths may be of any unit.
"""

from pathlib import Path

from articugen.core.errors import InvalidSource
from articugen.evaluation.recorded.frames import Frame, Recording, contents, surfaces_seen
from articugen.meshes.opalign import view_of
from articugen.meshes.points import unpacked
from articugen.pictures.contact_sheet import evenly

DEPTH = ("*/input_2", "input_2")


def read(folder: Path, count: int) -> Recording:
    """Return up to `count` views of one object; raises as `read_recording`."""
    paths = sorted(path for name in DEPTH for path in folder.glob(f"{name}/*.npz"))
    if not paths:
        raise InvalidSource(f"{folder}: {DEPTH[0]} holds no <camera>.npz")
    frames = [_frame(path) for path in evenly(paths, count)]
    return Recording(folder.name, surfaces_seen(frames), frames)


def _frame(path: Path) -> Frame:
    data = contents(path)
    try:
        view = view_of(unpacked(data, "arr_0")[1])
        count = max(len(view.T_camera_part), view.part.max() + 1)
        if count != 2:
            raise ValueError(f"{count} parts; a laptop has two")
    except Exception as error:  # whatever a parser meets in a broken file
        raise InvalidSource(f"{path}: no view of a laptop ({error})") from None
    return Frame(view.points, view.part, view.T_camera_part)
