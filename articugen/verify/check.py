"""A data set checked as the command does it: as it is stored; if asked, mended, or made again."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from articugen.core.errors import InvalidArgument
from articugen.core.processes import default_jobs
from articugen.verify.dataset import Repair, Report, verify


def check(
    data: str | os.PathLike[str],
    *,
    replay: int = 0,
    repair: bool = False,
    drop_user: bool = False,
    jobs: int | None = None,
    on_shard: Callable[[str], None] | None = None,
    on_repair: Callable[[Repair], None] = lambda _: None,
    on_notice: Callable[[str], None] = lambda _: None,
) -> Report:
    """Check the checksums, schema, value ranges and geometry of a data set.

    Args:
        data: its folder, or the data set that is open.
        replay: make this many instances again from their source: each must come out the same to the
            byte, with its surface points on the field's zero level.
        repair: make damaged shards again from recipe and sources, each to the same content, and a
            damaged manifest from whole shards; then check again.
        drop_user: while that is done, give up groups `user` that cannot be read.
        jobs: worker processes, None for all cores.
        on_shard: called with the name of each shard once it has been examined.
        on_repair: called with what was done about each file.
        on_notice: called with one sentence where mending takes a while, or a worker was lost.

    Returns:
        A report: `ok` says whether all is as it was made, `findings` what is not, `repairs` what
        was done before.

    Raises:
        InvalidArgument: `drop_user` without `repair`.
        ArticugenError: an instance cannot be made again, see `again.prepared_again`; a run is at
            work where a repair was asked for.
        MachineFault: a repair has no space on the disk, or the like; what was mended is kept.
    """
    if drop_user and not repair:
        raise InvalidArgument("drop_user (--drop-user) belongs to a repair; add that (--repair)")
    folder, jobs = Path(data), jobs or default_jobs()
    report = verify(folder, jobs=jobs, on_shard=on_shard)
    if repair and not report.ok:
        from articugen.verify import repair as mending  # noqa: PLC0415 - the stages take a second

        repairs: list[Repair] = []
        for done in mending.repair(
            folder, report, jobs=jobs, drop_user=drop_user, on_notice=on_notice
        ):
            repairs.append(done)
            on_repair(done)
        report = replace(verify(folder, jobs=jobs, on_shard=on_shard), repairs=tuple(repairs))
    if replay and report.ok:
        from articugen.verify import replay as again  # noqa: PLC0415 - the stages take a second

        findings = tuple(finding for finding in again.replay(folder, replay) if finding)
        return replace(report, findings=findings)
    return report
