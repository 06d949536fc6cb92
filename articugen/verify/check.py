"""A data set checked as the command does it: as it is stored and, if asked, made again."""

import os
from dataclasses import replace
from pathlib import Path

from articugen.pipeline import default_jobs
from articugen.verify.dataset import Report, verify


def check(data: str | os.PathLike[str], *, replay: int = 0, jobs: int | None = None) -> Report:
    """Check the checksums, schema, value ranges and geometry of a data set.

    Args:
        data: its folder, or the data set that is open.
        replay: make so many instances again from their source: each must come out the same to the
            byte, with its surface points on the field's zero level.
        jobs: worker processes, None for all cores.

    Returns:
        A report: `ok` says whether all is as it was made, `findings` what is not.

    Raises:
        ArticugenError: an instance cannot be made again, see `replay.prepared_again`.
    """
    folder = Path(data)
    report = verify(folder, jobs=jobs or default_jobs())
    if replay and report.ok:
        from articugen.verify import replay as again  # noqa: PLC0415 - the stages take a second

        found = tuple(finding for finding in again.replay(folder, replay) if finding)
        return replace(report, findings=found)
    return report
