"""A whole study of next to nothing on a CPU, at one go and killed again and again."""

import json
from itertools import pairwise

import pytest
from ppd_data import write_boxes
from typer.testing import CliRunner

from articugen.cli import app
from articugen.core.errors import ArticugenError, InvalidSource
from articugen.learning.method import load_recipe

torch = pytest.importorskip("torch", reason="PPD needs torch")

from articugen.learning import commands
from articugen.learning import study as studies
from articugen.learning.benchmark import Pace, pace, pace_table
from articugen.learning.run_folder import (
    LATEST,
    WEIGHTS,
    read_checkpoint,
    read_run,
)
from articugen.learning.study import Asked, Journal, made_quick, planned_recipe, study

torch.set_num_threads(1)

CATEGORIES = ("oven",)
FILES = {
    "recipe.yaml", "run.json", "race.json", "metrics.jsonl", "curves.jsonl", WEIGHTS, "evaluation",
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("articugen.learning.ppd.learner.VALIDATION_GRID", 8)
        patch.setattr(studies, "FINALISTS", 1)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Data sets, and a study of them made by the command."""
    folder = tmp_path_factory.mktemp("study")
    for category in CATEGORIES:
        write_boxes(folder / "data" / category, train=2, test=1, states=1, category=category)
    done = CliRunner().invoke(app, command(folder))
    assert done.exit_code == 0, done.output
    assert "study/README.md" in done.output.replace("\n", "")
    return folder


def command(folder, *more):
    plain = ("study", "--quick", "--device", "cpu", "-c", "oven", "-r", "ppd_plain", "--seeds", "2")
    return [*plain, "-d", str(folder / "data"), "--out", str(folder / "study"), *more]


def asked(folder, **more) -> Asked:
    recipe = load_recipe("ppd_plain")
    told = {"categories": CATEGORIES, "data": folder / "data", "device": "cpu", "seeds": 2} | more
    return made_quick(Asked(recipe=recipe, **told))


def no_data(category, folder):
    raise AssertionError(f"{category} is there")


def journal_of(out) -> dict:
    return json.loads((out / "study.json").read_text())


def test_the_folder_holds_everything_worth_keeping(folder):
    out = folder / "study"
    assert {p.name for p in out.iterdir()} == {
        "README.md", "study.json", "bench.md", "tables.md", *CATEGORIES
    }  # fmt: skip
    assert sum(p.stat().st_size for p in out.rglob("*") if p.is_file()) < 5_000_000
    told = (out / "README.md").read_text()
    for category in CATEGORIES:
        assert {p.name for p in (out / category).iterdir()} == FILES
        assert (out / category / "evaluation" / "evaluation.json").is_file()
        assert f"| {category} | 4 |" in told
    for name in {*FILES, "study.json", "tables.md"}:
        assert f"{name}`" in told or f"{name}/`" in told, name
    assert "label_iou" in told
    assert "## Failed" not in told
    assert "| 2 | label IoU, % | oven |" in (out / "tables.md").read_text()


def test_the_journal_says_what_was_done_on_what(folder):
    told = journal_of(folder / "study")
    legs = {f"{leg} {c}" for leg in ("data", "race", "train", "evaluate") for c in CATEGORIES}
    assert told["steps"].keys() == {"bench", *legs}
    assert told["failed"] == {}
    assert told["facts"]["torch"] == torch.__version__
    assert {row["seeds"] for row in told["bench"]} == {2, 1}
    assert all(row["iterations_per_second"] > 0 for row in told["bench"])
    assert [row["at_once"] for row in told["bench"]] == [True, False]
    assert told["spent"] > sum(v for k, v in told["steps"].items() if "evaluate" not in k) - 0.5


def test_the_race_is_halved_until_few_are_left(folder):
    told = json.loads((folder / "study" / "oven" / "race.json").read_text())
    assert [(r["iteration"], len(r["go_on"])) for r in told["rounds"]] == [(2, 1), (4, 1)]
    lines = (folder / "study" / "oven" / "curves.jsonl").read_text().splitlines()
    curves = [json.loads(line) for line in lines]
    assert {c["seed"] for c in curves} == {0, 1}
    ends = [c["iteration"] for c in curves if c["seed"] == told["winner"] and "validation" in c]
    assert ends == [2, 4]


def test_the_weights_predict_what_the_checkpoint_does(folder):
    out, work = folder / "study" / "oven", folder / "study-work" / "oven" / "000"
    assert not (out / LATEST).exists()
    one, two = read_run(out), read_checkpoint(work / LATEST)
    assert (one.recipe, one.category, one.iteration) == (two.recipe, "oven", 4)
    cloud = torch.rand(64, 3, generator=torch.Generator().manual_seed(0)).numpy() - 0.5
    left, right = (p.learner().predict(cloud) for p in (one, two))
    assert torch.equal(left.shape.detail, right.shape.detail)
    assert torch.equal(left.pose.pivot, right.pose.pivot)
    assert (out / WEIGHTS).stat().st_size < 0.3 * (work / LATEST).stat().st_size
    again = commands.evaluate(out, folder / "data" / "oven", resolution=8, states=1)
    stored = json.loads((out / "evaluation" / "evaluation.json").read_text())
    assert again.means == stored["means"]


def test_damaged_weights_are_refused(folder, tmp_path):
    own = tmp_path / WEIGHTS
    image = bytearray((folder / "study" / "oven" / WEIGHTS).read_bytes())
    for change, said in (
        (lambda: image.__setitem__(slice(-4, None), b"\xff\xff\xff\x7f"), "not finite"),
        (lambda: image.__setitem__(slice(8, 9), b"["), "not a safetensors file"),
    ):
        change()
        own.write_bytes(image)
        with pytest.raises(ArticugenError, match=said):
            read_run(tmp_path)


class Killed(BaseException):
    """What no handler of errors sees."""


def test_a_study_that_is_killed_goes_on(folder, tmp_path, monkeypatch):
    """While it benches, in the race, in training, before it evaluates."""
    whole, out, calls = folder / "study", tmp_path / "study", []

    def kill_at(what: str, count: int):
        def say(line: str) -> None:
            calls.append(line)
            if line.startswith(what) and count == 0:
                raise Killed

        left = [count]

        def beat(self: Journal) -> None:
            left[0] -= 1
            if left[0] == 0:
                raise Killed

        monkeypatch.setattr(Journal, "beat", beat)
        return say

    for what, count in (("bench", 0), ("-", 2), ("-", 5), ("evaluate", 0)):
        with pytest.raises(Killed):
            study(asked(folder), out, make_data=no_data, say=kill_at(what, count))
    monkeypatch.setattr(Journal, "beat", lambda self: None)
    study(asked(folder), out, make_data=no_data, say=calls.append)
    assert calls.count("bench ...") == 2
    assert calls.count("race oven ...") == calls.count("train oven ...") == 2
    for category in CATEGORIES:
        for name in ("race.json", WEIGHTS, "evaluation/evaluation.json"):
            assert (out / category / name).read_bytes() == (whole / category / name).read_bytes()
    done = {p.relative_to(out) for p in out.rglob("*")}
    assert done == {p.relative_to(whole) for p in whole.rglob("*")}
    assert (out / "README.md").read_text().count("\n") == (
        (whole / "README.md").read_text().count("\n")
    )


def test_nothing_is_done_twice_and_other_options_are_refused(folder):
    lines, out = [], folder / "study"
    before = journal_of(out)["steps"]
    study(asked(folder), out, make_data=no_data, say=lines.append)
    assert lines == []
    assert journal_of(out)["steps"] == before
    done = CliRunner().invoke(app, command(folder, "--seeds", "3"))
    assert done.exit_code == 1
    assert "is of a study with other options" in done.output.replace("\n", " ")


def test_a_category_that_fails_stops_no_other(folder, tmp_path):
    def make_data(category, folder):
        raise InvalidSource(f"no source has a {category}")

    told = asked(folder, categories=("oven", "drawer"), seeds=1)
    out = study(told, tmp_path / "study", make_data=make_data)
    assert "- data drawer: no source has a drawer" in (out / "README.md").read_text()
    assert "evaluate oven" in journal_of(out)["steps"]
    assert not (out / "drawer").exists()


def test_a_device_that_is_not_there_is_said_first(folder, tmp_path):
    done = CliRunner().invoke(
        app, ["study", "--device", "cuda:9", "--out", str(tmp_path / "s"), "-c", "laptop"]
    )
    assert done.exit_code == 1
    assert "torch sees no such device" in done.output.replace("\n", " ")
    assert not (tmp_path / "s").exists()


def test_what_the_data_lack_is_in_the_table(folder, tmp_path):
    told = {"category": "oven", "data": folder / "data" / "oven", "beside": tmp_path}
    found = pace(load_recipe("ppd_paper"), **told, device="cpu", seeds=1, seconds=0.1)
    assert "the recipe asks for 4096" in found.failed
    assert "| ppd_paper | 1 | failed: " in pace_table([found])


def benched(seconds: dict[int, float]) -> list[Pace]:
    """The pace of ppd_hour by the number of seeds, in seconds an iteration; 0 fails."""
    return [
        Pace("ppd_hour", n, True, 1 / s, begin_seconds=2.0, validate_seconds=0.1)
        if s
        else Pace("ppd_hour", n, failed="out of memory")
        for n, s in seconds.items()
    ]


@pytest.mark.parametrize("minutes", [10.0, 40.0, 400.0])
def test_plans_fill_the_time_and_no_more(tmp_path, minutes, monkeypatch):
    monkeypatch.setattr(studies, "FINALISTS", 4)
    stages = [
        {"resolution": 16, "iterations": 23_000},
        {"resolution": 32, "iterations": 3_000, "residual_direction": True},
    ]
    hour = load_recipe({"extends": "ppd_hour", "schedule": {"stages": stages}})
    five = tuple("abcde")
    told = Asked(categories=five, data=tmp_path, recipe=hour, minutes=minutes, device="cpu")
    journal = Journal.of(tmp_path / "study", told)
    journal.bench = benched({64: 0.06, 32: 0.04, 16: 0.03, 8: 0.025, 4: 0.02})
    plan = studies._plan(told, journal)
    assert plan["seeds"] == 64
    assert plan["iterations"] <= hour.schedule.iterations
    assert 5 * plan["seconds"] <= 0.85 * 60 * minutes
    recipe = planned_recipe(hour, 64, plan["iterations"])
    cuts = [0, *recipe.seeds.halve_at, recipe.schedule.iterations]
    heats = [b - a for a, b in pairwise(cuts)]
    each = (0.06, 0.04, 0.03, 0.025, 0.02)
    fixed = 5 * 2.0 + 0.1 * (64 + 32 + 16 + 8 + 4)
    took = fixed + sum(a * b for a, b in zip(heats, each, strict=True))
    assert took == pytest.approx(plan["seconds"], abs=1.0)
    shares = [stage.iterations / plan["iterations"] for stage in recipe.schedule.stages]
    assert shares == pytest.approx([23 / 26, 3 / 26], abs=0.01)
    if minutes == 400.0:
        assert plan["iterations"] == 16 * (26_000 // 16)
    elif minutes == 40.0:
        assert 5 * plan["seconds"] > 0.6 * 60 * minutes


def test_seeds_that_do_not_fit_into_the_memory_do_not_race(tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "FINALISTS", 4)
    told = Asked(("a",), tmp_path, load_recipe("ppd_hour"), device="cpu")
    journal = Journal.of(tmp_path / "study", told)
    journal.bench = benched({64: 0.0, 32: 0.0, 16: 0.03, 8: 0.025, 4: 0.02})
    assert studies._plan(told, journal)["seeds"] == 16
    journal.bench = benched(dict.fromkeys((64, 32, 16, 8, 4), 0.0))
    assert studies._plan(told, journal)["iterations"] == 0
