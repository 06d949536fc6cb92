"""What the commands show while they work and when they are done."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.padding import Padding
from rich.progress import BarColumn, Progress, SpinnerColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from articugen.inspection.tables import duration, facts, size
from articugen.manifest import Manifest
from articugen.pipeline import Job, ObjectReport, Plan
from articugen.sources.registry import SourceInfo


def sources_table(sources: Iterable[SourceInfo]) -> RenderableType:
    """The named sources and the objects they hold; where models are missing, how to get them."""
    lines: list[RenderableType] = []
    for source in sources:
        table = facts()
        for category in source.categories:
            there = (
                f"{category.train} train, {category.test} test" if source.present else "none yet"
            )
            table.add_row(category.name, there)
        lines += [
            Text(source.name, "bold"),
            _indented(Text(f"{source.origin} ({source.licence})")),
            _indented(table),
        ]
        if not source.present:
            lines.append(
                _indented(Text(f"{source.folder}/README.md says how to get them", "yellow"))
            )
        lines.append("")
    return Group(*lines[:-1])


def _indented(text: RenderableType) -> Padding:
    return Padding(text, (0, 0, 0, 2))


def plan_table(job: Job, plan: Plan) -> RenderableType:
    """What a run would do, and why."""
    table = facts()
    reasons: dict[str, list[str]] = {}
    for task in plan.tasks:
        reasons.setdefault(task.why, []).append(task.ref.object_id)
    table.add_row("there already", _count(len(plan.done), "object"))
    for why, objects in reasons.items():
        some = ", ".join(objects[:3]) + (", ..." if len(objects) > 3 else "")
        table.add_row(
            "to make", escape(f"{_count(len(objects), 'object')} ({some}), each because {why}")
        )
    table.add_row("instances", f"{plan.instances:,}")
    table.add_row("disk", f"about {size(plan.bytes)}")
    table.add_row("time", f"about {duration(plan.seconds)} on {_count(job.jobs, 'worker')}")
    lines: list[RenderableType] = [_title(job.category, job.out), table]
    if plan.conflict:
        lines.append(Text(plan.conflict, "yellow"))
    return Group(*lines)


def made_table(manifest: Manifest, folder: Path) -> RenderableType:
    """One screen at the end of a run: what was made, how fast, how large, what was rejected."""
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
        f"{_count(took.workers, 'worker')}, {size(took.peak_memory_bytes)} of memory at most",
    )
    table.add_row("content", manifest.content_sha256)
    for rejection in manifest.rejected:
        told = f"{rejection.key.object_id}: {rejection.reason}"
        table.add_row("[yellow]rejected[/]", f"[yellow]{escape(told)}[/]")
    return Group(_title(manifest.category, folder), table)


@contextmanager
def progress(console: Console, plan: Plan) -> Iterator[Callable[[ObjectReport], None]]:
    """A bar with the rate and the time left; one line an object where `console` is no terminal."""
    bar = Progress(
        SpinnerColumn(),
        BarColumn(),
        TextColumn("{task.fields[objects]}/{task.fields[wanted]} objects"),
        _Rate(),
        TimeRemainingColumn(compact=True),
        console=console,
        disable=not console.is_terminal,
        speed_estimate_period=1800.0,
        transient=True,
    )
    wanted = len(plan.tasks)
    running = bar.add_task("", total=plan.instances or None, objects=0, wanted=wanted, made=0)
    each = plan.instances / max(wanted, 1)

    def on_object(report: ObjectReport) -> None:
        if report.reused:
            return
        state = bar.tasks[running].fields
        bar.update(
            running,
            advance=each,
            objects=state["objects"] + 1,
            made=state["made"] + report.instances,
        )
        if report.rejected is not None:
            console.print(
                f"[yellow]rejected[/] {escape(f'{report.object_id}: {report.rejected}')}",
                soft_wrap=True,
            )
        elif not console.is_terminal:
            console.print(
                f"{state['objects']}/{wanted} {report.shard} {report.object_id}: "
                f"{report.instances} instances in {duration(report.seconds)}",
                soft_wrap=True,
            )

    with bar:
        yield on_object


class _Rate(TextColumn):
    """Instances per second since the start: finished objects come in lumps."""

    def __init__(self) -> None:
        super().__init__("")

    def render(self, task: Task) -> Text:
        made = task.fields["made"]
        rate = made / task.elapsed if task.elapsed else 0.0
        return Text(f"{rate:.1f} instances/s" if made else "starting", "bright_black")


def _title(category: str, folder: Path) -> Text:
    return Text.assemble((category, "bold"), f" in {folder}")


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" + ("" if number == 1 else "s")
