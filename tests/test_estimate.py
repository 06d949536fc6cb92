"""Estimates: of the right size, growing with the work, and corrected by what was seen."""

import pytest

from articugen.core.recipe import Articulation, Recipe, Sampling, ViewSettings
from articugen.pipeline.plan import STARTUP, instance_bytes, object_seconds, run_seconds
from articugen.store.outcome import Key, ObjectEntry

PAPER = Recipe(name="paper")


def done(seconds: float, instances: int = 101) -> ObjectEntry:
    digest = 64 * "0"
    key = Key(
        split="train", object_id="x", ref="x", recipe_sha256=digest, seed=0, generator="0.1.0+x"
    )
    return ObjectEntry(
        key=key, input_sha256=digest, shard="x.h5", instances=instances, content_sha256=digest,
        seconds=seconds,
    )  # fmt: skip


def test_an_object_of_the_papers_protocol_takes_about_ten_seconds_and_20_mb() -> None:
    assert 5 < object_seconds(PAPER, 101) < 15
    assert 100_000 < instance_bytes(PAPER) < 300_000


@pytest.mark.parametrize(
    "more",
    [
        {"views": ViewSettings(count=400)},
        {"views": ViewSettings(resolution=512)},
        {"sampling": Sampling(grids=(16, 32, 64, 128))},
        {"sampling": Sampling(surface_points=65536)},
        {"sampling": Sampling(near_points=65536)},
        {"sampling": Sampling(partial_views=16)},
        {"articulation": Articulation(states=200)},
    ],
)
def test_more_work_takes_longer(more: dict) -> None:
    larger = PAPER.model_copy(update=more)
    assert run_seconds(larger, 10, 2, ()) > run_seconds(PAPER, 10, 2, ())


def test_workers_share_the_objects() -> None:
    alone = run_seconds(PAPER, 8, 1, ()) - STARTUP
    assert run_seconds(PAPER, 8, 4, ()) - STARTUP == pytest.approx(alone / 4)
    assert run_seconds(PAPER, 8, 64, ()) - STARTUP == pytest.approx(alone / 8)
    assert run_seconds(PAPER, 8, 0, ()) == run_seconds(PAPER, 8, 1, ())
    assert run_seconds(PAPER, 0, 4, ()) == 0.0


def test_what_was_made_before_decides_where_there_is_some() -> None:
    seen = [done(60.0), done(20.0)]
    assert run_seconds(PAPER, 4, 2, seen) == pytest.approx(STARTUP + 2 * 40.0)
    assert run_seconds(PAPER, 4, 2, [done(0.0)]) == run_seconds(PAPER, 4, 2, ())
