"""What the commands show while they work and when they are done."""

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from articugen.cli.saying import REJECTED, command, counting_bar, say, stderr, stdout
from articugen.core.arrays import grouped
from articugen.core.errors import ArticugenError
from articugen.core.files import room_at
from articugen.core.tables import counted, duration, facts, size
from articugen.pipeline.job import Job
from articugen.pipeline.options import ObjectReport, OnNotice, OnObject
from articugen.pipeline.plan import Plan
from articugen.sources.source import Source
from articugen.store.manifest import MANIFEST_NAME, UNMADE, Manifest
from articugen.store.outcome import Outcome, Rejection


def sources_table(sources: Iterable[Source]) -> RenderableType:
    """Return the named sources and their objects; where models are missing, how to get them."""
    lines: list[RenderableType] = []
    for source in sources:
        table = facts()
        counts = source.counts()
        for name, splits in counts.items():
            if splits:
                table.add_row(escape(name), f"{splits['train']} train, {splits['test']} test")
        missing = [name for name, splits in counts.items() if not splits]
        if missing:
            table.add_row("none yet", escape(", ".join(missing)))
        about: list[RenderableType] = [Text(f"{source.file.origin} ({source.licence})"), table]
        if not any(counts.values()):
            about.append(Text(f"{source.folder}/README.md says how to get them", "yellow"))
        lines += [Text(source.name, "bold"), Padding(Group(*about), (0, 0, 0, 2)), ""]
    return Group(*lines[:-1])


def plan_table(job: Job, plan: Plan) -> RenderableType:
    """Return what a run would do, and why."""
    table = facts()
    table.add_row("there already", counted(len(plan.done), "object"))
    for why, objects in grouped((t.why, t.ref.object_id) for t in plan.tasks).items():
        some = ", ".join(objects[:3]) + (", ..." if len(objects) > 3 else "")
        table.add_row(
            "to make", escape(f"{counted(len(objects), 'object')} ({some}), each because {why}")
        )
    table.add_row("instances", f"{plan.instances:,}")
    room = ""
    with suppress(OSError):
        room = f"; {size(room_at(job.out))} are free" if isinstance(job.out, Path) else ""
    table.add_row("disk", f"about {size(plan.bytes)}: an estimate{room}")
    on = f"on {counted(max(job.jobs, 1), 'worker')}"
    table.add_row("time", f"about {duration(round(plan.seconds))} {on}: an estimate")
    lines: list[RenderableType] = [_title(job.category, job.out), table]
    if plan.conflict:
        lines.append(Text(plan.conflict, "yellow"))
    return Group(*lines)


def made_table(manifest: Manifest, folder: object) -> RenderableType:
    """Return one screen at the end of a run: what was made, how fast, how large, what was
    rejected."""
    splits = Counter(entry.key.split for entry in manifest.objects)
    counts = ", ".join(f"{n} {split}" for split, n in sorted(splits.items(), reverse=True))
    instances = sum(shard.instances for shard in manifest.shards)
    stored = sum(shard.bytes for shard in manifest.shards)
    took = manifest.timings
    table = facts()
    table.add_row("objects", f"{len(manifest.objects)} ({counts})")
    table.add_row("instances", f"{instances:,}")
    table.add_row("size", f"{size(stored)}, {size(stored / max(instances, 1))} an instance")
    table.add_row(
        "last run",
        f"{duration(took.seconds)}, {took.instances_per_second:.1f} instances/s on "
        f"{counted(took.workers, 'worker')}, {size(took.peak_memory_bytes)} of memory at most",
    )
    table.add_row("content", manifest.content_sha256)
    for split in {"train", "test"} - set(splits) if splits else ():
        table.add_row(
            f"[yellow]no {split}[/]",
            f"[yellow]no object is for {'training' if split == 'train' else 'testing'}: add "
            "models, or list ids of both splits in a source.yaml (docs/conventions.md)[/]",
        )
    _add_left_out(table, manifest.failed, manifest.rejected, manifest.skipped)
    return Group(_title(manifest.category, folder), table)


def left_out(folder: Path) -> RenderableType:
    """Return the objects that are not in a data set, and why; nothing where there is no manifest,
    and CorruptShard where it is damaged."""
    table = facts()
    if (folder / MANIFEST_NAME).is_file():
        manifest = Manifest.read(folder)
        _add_left_out(table, manifest.failed, manifest.rejected, manifest.skipped)
    return table if table.row_count else Group()


def _add_left_out(
    table: Table,
    failed: Sequence[Rejection],
    rejected: Sequence[Rejection],
    skipped: Sequence[Rejection] = (),
) -> None:
    """Add a row for each object that failed or was rejected, and one for all that were skipped."""
    for word, objects in (("failed", failed), ("rejected", rejected)):
        for entry in objects:
            table.add_row(f"[yellow]{word}[/]", f"[yellow]{escape(entry.sentence)}[/]")
    for first in skipped[:1]:
        count = counted(len(skipped), "object")
        table.add_row("skipped", escape(f"{count}, such as {first.sentence}"))


@contextmanager
def progress(plan: Plan) -> Iterator[tuple[OnObject, OnNotice]]:
    """A bar with the rate and the time left; one line an object where stderr is no terminal.
    Yields what a run calls while it works."""
    began, wanted, done, instances = time.perf_counter(), len(plan.tasks), 0, 0

    def on_object(report: ObjectReport) -> None:
        nonlocal done, instances
        if report.reused:
            return
        done, instances = done + 1, instances + report.instances
        rate = instances / (time.perf_counter() - began)
        count_object(done, wanted, f"{rate:.1f} instances/s")
        if stderr.is_terminal:
            return
        # why an object was not made stands in `made_table`
        word = next((kind for kind in UNMADE if getattr(report, kind) is not None), "")
        text = f"{report.instances} instances in {duration(report.seconds)}"
        which = f"{done}/{wanted} {report.shard or '-'} {report.object_id}"
        say(f"{which}: {word or text}", to=stderr)

    with counting_bar() as count_object:
        count_object(0, wanted, "starting")
        yield on_object, lambda sentence: say((sentence, "yellow"), to=stderr)


def _title(category: str, folder: object) -> Text:
    return Text.assemble((category, "bold"), f" in {folder}")


def tell(manifest: Manifest, where: object) -> int:
    """Print what has become of a data set, and return the exit status; ArticugenError where the set
    is not what its recipe asks for."""
    stdout.print(made_table(manifest, where))
    if manifest.shortfall:
        raise ArticugenError(manifest.shortfall)
    return REJECTED if manifest.rejected else 0


def tell_share(outcomes: Sequence[Outcome], job: Job) -> int:
    """Print what has become of a share, and what comes next, and return the exit status;
    ArticugenError where objects have failed."""
    shards = [outcome.shard for outcome in outcomes if outcome.shard]
    failed = [outcome.failed for outcome in outcomes if outcome.failed]
    table = facts()
    table.add_row("objects", f"{len(shards)} made")
    table.add_row("instances", f"{sum(shard.instances for shard in shards):,}")
    table.add_row("size", size(sum(shard.bytes for shard in shards)))
    _add_left_out(table, failed, [outcome.rejected for outcome in outcomes if outcome.rejected])
    stdout.print(table)
    if failed:
        raise ArticugenError(
            f"{len(failed)} of {len(outcomes)} objects failed through no fault of theirs, and are "
            f"tried again by the same command; the first, {failed[0].sentence}"
        )
    in_folder = isinstance(job.out, Path)
    then = command("merge", job.out) if in_folder else "the command without --shard"
    say(f"when all shards are made: {then}")
    return 0
