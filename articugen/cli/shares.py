"""The command line beyond one machine: a share of a data set, and the merge of all of them."""

# Everything else is imported where it is used: --help should not wait for numba, h5py and trimesh.
# ruff: noqa: PLC0415
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from articugen.cli.saying import KEPT, REJECTED, command, counting_bar, said, stderr, stdout
from articugen.core.errors import ArticugenError, InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Sequence

    from articugen.pipeline.rank_journal import Share
    from articugen.pipeline.run import Job
    from articugen.store.manifest import Manifest, Outcome


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(
        epilog="Example: articugen merge /shared/data/laptop",
    )(merge)


def share_of(text: str | None) -> "Share | None":
    """What `--shard` says.

    Raises:
        InvalidArgument: it is not like 3/8.
    """
    if text is None:
        return None
    from articugen.pipeline.rank_journal import Share

    return Share.of_text(text)


def made_share(job: "Job", *, dry_run: bool, share: "Share") -> int:
    """Make a share of one data set and tell of it; the exit status."""
    with said(KEPT):
        from articugen.cli import console
        from articugen.pipeline import ranks

        with ranks.started(job, share, command=_whole_command(sys.argv)) as rank:
            mine = len(rank.plan.keys)
            stdout.print(f"shard {share}: {mine} of {rank.objects} objects", soft_wrap=True)
            if dry_run:
                stdout.print(console.plan_table(job, rank.plan))
                return 0
            with console.progress(stderr, rank.plan) as bar:
                outcomes = rank.finish(bar.of_object, bar.of_notice)
        return _told_share(outcomes, f"when all shards are made: {command('merge', job.out)}")


def made_in_bucket(job: "Job", *, dry_run: bool, share: "Share | None") -> int:
    """Make one data set, or a share of it, in an object store; the exit status."""
    with said(KEPT):
        from articugen.cli import console
        from articugen.pipeline import bucket_runs

        with bucket_runs.started(job, share, command=_whole_command(sys.argv)) as run:
            if dry_run:
                stdout.print(console.plan_table(job, run.plan))
                return 0
            with console.progress(stderr, run.plan) as bar:
                outcomes, manifest = run.finish(bar.of_object, bar.of_notice)
        if manifest is None:
            return _told_share(outcomes, "when all shards are made, the command without --shard")
        return _told(manifest, job.bucket)


def made_by_array(job: "Job", *, dry_run: bool, share: "Share | None") -> int:
    """Make one data set by an array of SLURM and tell of it; the exit status."""
    with said(KEPT):
        from articugen.cli import console
        from articugen.pipeline.executors import slurm

        if share:
            raise InvalidArgument("--scheduler slurm shares out the objects by itself: no --shard")
        with slurm.started(job, command=_whole_command(sys.argv)) as run:
            if dry_run:
                stdout.print(console.plan_table(job, run.plan))
                return 0
            with console.progress(stderr, run.plan) as bar:
                manifest = run.finish(bar.of_object, bar.of_notice)
        return _told(manifest, job.out)


def _told(manifest: "Manifest", where: "Path | str") -> int:
    """Say what has become of a data set; the exit status.

    Raises:
        ArticugenError: it is not what its recipe asks for.
    """
    from articugen.cli import console

    stdout.print(console.made_table(manifest, where))
    if manifest.shortfall:
        raise ArticugenError(manifest.shortfall)
    return REJECTED if manifest.rejected else 0


def _told_share(outcomes: "Sequence[Outcome]", then: str) -> int:
    """Say what has become of a share, and what comes next; the exit status.

    Raises:
        ArticugenError: some objects have failed.
    """
    from articugen.cli import console

    stdout.print(console.share_table(outcomes))
    failed = [outcome.failed for outcome in outcomes if outcome.failed]
    if failed:
        raise ArticugenError(
            f"{len(failed)} of {len(outcomes)} objects failed through no fault of theirs, and are "
            f"tried again by the same command; the first, {failed[0].sentence}"
        )
    stdout.print(then, soft_wrap=True, markup=False)
    return 0


def _whole_command(argv: list[str]) -> str:
    """The command that was given, without its `--shard`: what all ranks have in common."""
    words, left = iter(argv[1:]), list[str]()
    for word in words:
        if word == "--shard":
            next(words, None)
        elif not word.startswith("--shard="):
            left.append(word)
    return shlex.join(["articugen", *left])


def merge(
    path: Annotated[
        Path, typer.Argument(help="The folder that ranks have filled, or one of such folders.")
    ],
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=1, help="Shards read at once.", show_default="all cores"),
    ] = None,
    sizes_only: Annotated[
        bool,
        typer.Option(
            "--sizes-only", help="Compare sizes alone; `articugen verify` looks at every byte."
        ),
    ] = False,
) -> None:
    """Check what `generate --shard` has made, and write the manifest."""
    status = 0
    with said():
        from articugen.pipeline import ranks
        from articugen.pipeline.journal import data_sets
        from articugen.pipeline.run import default_jobs

        for folder in data_sets(path, follow=False):
            with counting_bar() as told:
                manifest = ranks.merge(
                    folder, jobs=jobs or default_jobs(), sizes_only=sizes_only, on_object=told,
                    on_notice=stdout.print,
                )  # fmt: skip
            status = max(status, _told(manifest, folder))
    if status:
        raise typer.Exit(status)
