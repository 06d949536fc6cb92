import errno
import json
import re
from pathlib import Path

import pytest
from python_process import printed
from trouble import unfit

from articugen.core import content, schema
from articugen.core import recipe as recipe_module
from articugen.core.errors import InvalidRecipe, MachineFault
from articugen.core.recipe import Recipe, Sampling, load_recipe
from articugen.core.yaml_files import known, with_settings
from articugen.learning.method import load_recipe as load_train_recipe
from articugen.store import columns

CATEGORIES = ("drawer", "eyeglasses", "laptop", "oven", "washing_machine")


def written(folder: Path, text: str, name: str = "mine.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("category", CATEGORIES)
def test_category_recipes_are_the_papers_protocol(category: str) -> None:
    recipe = load_recipe(None, category)
    assert recipe.name == category
    assert recipe.articulation.states == 100
    assert recipe.views.count == 100
    assert recipe.articulation.prismatic_metres is None  # up to the URDF's own maximum
    upper = 90.0 if category == "eyeglasses" else 135.0
    assert recipe.articulation.revolute_degrees == (0.0, upper)


def test_a_source_may_have_a_recipe_to_itself(tmp_path: Path, monkeypatch) -> None:
    """Bundled drawers are many, others as the paper has them. A source may be a path, which names
    no file here."""
    many = load_recipe(None, "drawer", "procedural")
    assert (many.name, many.objects, many.articulation.states) == ("drawer-procedural", 300, 16)
    for source in ("", "partnet_mobility", "../drawer", "/models/drawer", "procedural/", "x\0y"):
        assert load_recipe(None, "drawer", source) == load_recipe(None, "drawer")
    quick = load_recipe("quick", "drawer", "procedural")
    assert (quick.objects, quick.articulation.states) == (10, 10)
    monkeypatch.setattr(recipe_module, "RECIPES", tmp_path / "recipes")
    (tmp_path / "recipes").mkdir()
    written(tmp_path / "recipes", "objects: 7", "default.yaml")
    (tmp_path / "recipes" / "drawer-..").mkdir()
    written(tmp_path, "objects: 666", "stolen.yaml")
    assert load_recipe(None, "drawer", "../../stolen").objects == 7


@pytest.mark.parametrize("name", known(learner=False))
def test_every_recipe_in_the_repository_loads_for_every_category(name: str) -> None:
    for category in (*CATEGORIES, "anything"):
        assert load_recipe(name, category).name == name


def test_a_category_without_its_own_recipe_keeps_to_the_limits_of_its_joints() -> None:
    recipe = load_recipe(None, "fridge")
    assert recipe.name == "default"
    assert recipe.articulation.clip_to_limits


def test_quick_extends_the_category_it_is_used_for() -> None:
    quick, full = load_recipe("quick", "eyeglasses"), load_recipe(None, "eyeglasses")
    assert quick.articulation.revolute_degrees == full.articulation.revolute_degrees
    assert quick.articulation.states < full.articulation.states
    assert quick.sampling == full.sampling


def test_extends_merges_sections_key_by_key(tmp_path: Path) -> None:
    written(tmp_path, "sampling: {near_points: 5, near_sigma: 0.02}\nobjects: 4", "base.yaml")
    path = written(tmp_path, f"extends: {tmp_path}/base.yaml\nsampling: {{near_points: 6}}")
    recipe = load_recipe(path, "laptop")
    assert (recipe.sampling.near_points, recipe.sampling.near_sigma, recipe.objects) == (6, 0.02, 4)
    assert recipe.name == "mine"


def test_a_path_that_is_extended_is_one_beside_the_file(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "in").mkdir()
    written(tmp_path, "objects: 4", "in/base.yaml")
    path = written(tmp_path, "extends: base.yaml", "in/mine.yaml")
    written(tmp_path, "objects: 5", "base.yaml")
    monkeypatch.chdir(tmp_path)
    assert load_recipe(path, "laptop").objects == 4
    written(tmp_path, "extends: base.yaml", "base.yaml")
    with pytest.raises(InvalidRecipe, match="extends itself"):
        load_recipe(tmp_path / "base.yaml", "laptop")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("states: 1\nstates: 2", "the key 'states' is given twice"),
        ("articulation: {states: 1, states: 2}", "the key 'states' is given twice"),
        ("articulation: {states: true}", "articulation.states: true and false .* are no value"),
        ("sampling: {grids: [true]}", "sampling.grids: true and false"),
        ("articulation: {states: 2001-99-99}", "articulation.states: .*integer"),
        ("a: !!timestamp 2001-99-99", "not YAML"),
        ("a: !!int x", "not YAML"),
        (f"articulation: {{states: {'9' * 5000}}}", "a number has 5,000 digits"),
        ("objects: " + ":".join("1" * 3000), "a number has 5,999 digits"),
        ("padding: 1" + "0" * 35, "padding: .*less than 1"),
        ("a: " + "[" * 3000 + "]" * 3000, "it is nested too deeply"),
        ("a: &x [1]\nb: *x", "aliases .* are not read"),
        ("a: {<<: {b: 1}}", "unknown key 'a'"),
        ("objects: 2000000", "objects: .*less than or equal to 1000000"),
        ("articulation: {revolute_degrees: [0, 1e9]}", "revolute_degrees.*3600"),
        ("views: {count: 10000, resolution: 4096}", "views: 10,000 views of 4096 x 4096 pixels"),
        (
            "sampling: {partial_views: 16, partial_points: 1000000}",
            "sampling: partial_points would take 92 MiB an instance, more than the 64",
        ),
        (
            f"sampling: {{grids: {list(range(2, 257))}}}",
            "sampling: an instance would take .* MiB, more than 128",
        ),
        (
            f"articulation: {{movable: {[f'link_{i}*' for i in range(4000)]}}}",
            "mine.yaml: the recipe takes .* bytes when written out, more than 32,000; use",
        ),
        ("# " + "x" * 300_000, "more than the 262,144 that it may have"),
        ("near_points: 3", r"unknown key 'near_points'; did you mean 'sampling.near_points'\?"),
        ("samplng: {}", r"unknown key 'samplng'; did you mean 'sampling'\?"),
        ("sampling: {near_point: 3}", r"'sampling.near_point'; did you mean 'near_points'\?"),
        ("articulation: {zzz: 3}", r"unknown key 'articulation.zzz'$"),
        ("sampling: {near_points: -1}", "sampling.near_points: .*greater than or equal to 0"),
        ("sampling: {grids: [16, 16]}", "sampling: grids are different sizes from 1 to 256"),
        ("fusion: {truncation: .nan}", "fusion.truncation: .*finite"),
        ("articulation: {revolute_degrees: [90, 0]}", "from a lower to a higher value"),
        ("views: {backend: blender}", r"views.backend: no backend 'blender'.*sapien \(needs"),
        ("views: {backend: opngl}", r"views.backend: .*; did you mean 'opengl'\?; there are: rast"),
        ("objects: 0", "objects: .*greater than or equal to 1"),
        ("- a list", "a recipe is a mapping"),
        ("1: 2", "a recipe is a mapping"),
        ("a: [", "not YAML"),
        ("extends: nosuch", "no recipe 'nosuch'; there are: .*quick"),
        ("extends: quik", r"no recipe 'quik'; did you mean 'quick'\?"),
        ("a: !!python/object/apply:os.getcwd []", "not YAML"),
    ],
)
def test_a_bad_recipe_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InvalidRecipe, match=sentence) as caught:
        load_recipe(written(tmp_path, text), "laptop")
    assert "\n" not in str(caught.value)


def test_whatever_recipe_is_read_a_shard_can_hold_it() -> None:
    """The largest of each field that is accepted, against the limits of the writer."""
    assert recipe_module.MAX_TEXT_BYTES <= columns.MAX_ATTRIBUTE_BYTES
    most = Sampling(
        grids=(256,),
        surface_points=1_000_000,
        uniform_points=1_000_000,
        near_points=1_000_000,
        partial_views=11,
        partial_points=1_000_000,
    )
    sizes = Recipe(name="most", sampling=most).instance_bytes()
    assert sizes["occupancy_256"] == 2**24
    assert sizes["partial_points"] == 66_000_000 <= schema.MAX_CHUNK_BYTES
    asked = {f.name for f in schema.FIELDS if not f.is_grid and (not f.optional or f.dtype == "S")}
    assert asked <= set(sizes)


def test_a_recipe_knows_the_fields_of_its_shards() -> None:
    """All of the schema where everything is asked for, and each by its key alone."""
    usual = set(Recipe(name="usual").fields())
    asked = {
        "coverage_16 coverage_32 coverage_64": {"sampling": {"coverage": True}},
        "uniform_distance near_distance": {"sampling": {"signed_distance": 0.1}},
        "sharp_points sharp_normals sharp_part": {"sampling": {"sharp_points": 8}},
        "surface_color": {"sampling": {"surface_color": True}},
        "collision_depth": {"articulation": {"collision": "label"}},
        "image_part image_T_camera_world image_intrinsics": {
            "images": {"views": 2, "fields": ["part"]}
        },
    }
    for names, keys in asked.items():
        assert set(load_recipe(keys, "laptop").fields()) == usual | set(names.split())
    everything = load_recipe(
        {
            "articulation": {"collision": "reject"},
            "sampling": {
                **{"coverage": True, "signed_distance": 0.1, "sharp_points": 8},
                "surface_color": True,
            },
            "images": {"views": 1},
        },
        "laptop",
    )
    assert {field.name for field in everything.fields().values()} == {f.name for f in schema.FIELDS}
    sizes = everything.instance_bytes()
    assert sizes["coverage_64"] == sizes["occupancy_64"] == 2**18
    assert sizes["image_rgba"] == 256 * 256 * 4


def test_keys_that_came_later_change_no_recipe_that_does_not_use_them() -> None:
    """The digest of the default recipe before they came: data made by it stay as they are."""
    text = load_recipe(None, "laptop").text()
    assert not {"collision", "sharp_points", "signed_distance", "images"} & set(json.loads(text))
    assert "sharp" not in text
    asking = load_recipe({"images": {"views": 4}}, "laptop")
    assert json.loads(asking.text())["images"] == {"views": 4}
    assert Recipe.model_validate(json.loads(asking.text())) == asking


def test_what_the_manual_shows_of_training_recipes_is_one(tmp_path: Path) -> None:
    manual = (Path(__file__).parents[1] / "docs" / "ppd.md").read_text(encoding="utf-8")
    shown = re.findall(r"`(\w+: \{[^`]*\})`", manual)
    assert any("halve_at" in text for text in shown)
    for text in shown:
        for name in known(learner=True):
            if load_train_recipe(name).method != "ppd":
                continue
            load_train_recipe(written(tmp_path, f"extends: {name}\n{text}"))


def test_errors_of_a_whole_training_recipe_name_file_and_keys(tmp_path: Path) -> None:
    path = written(tmp_path, "extends: ppd_quick\nseeds: {count: 4, halve_at: [800]}")
    with pytest.raises(InvalidRecipe, match=r"mine\.yaml: seeds\.halve_at must be ascending"):
        load_train_recipe(path)


def test_settings_are_merged_into_the_recipe_key_by_key() -> None:
    recipe = load_recipe("quick", "laptop")
    other = with_settings(
        recipe,
        [
            "objects=3",
            "sampling.grids=[16, 32]",
            "sampling.near_sigma = 0.02",
            "views={count: 50}",
            "fusion.truncation=1e-2",
            "articulation.prismatic_metres=null",
            "articulation.movable=['door*', lid]",
            "objects=4",
        ],
    )
    assert (other.objects, other.sampling.grids, other.sampling.near_sigma) == (4, (16, 32), 0.02)
    assert other.views == recipe.views.model_copy(update={"count": 50})
    assert other.fusion.truncation == 0.01
    assert other.articulation.movable == ("door*", "lid")
    assert other.sampling.near_points == recipe.sampling.near_points
    assert with_settings(recipe, []) == recipe
    assert Recipe.model_validate(json.loads(other.text())) == other


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("sampling.near_point=3", r"unknown key 'sampling.near_point'; did you mean 'near_points'"),
        ("samplng.grids=[8]", "unknown key 'samplng'; did you mean 'sampling'"),
        ("near_points=3", "unknown key 'near_points'; did you mean 'sampling.near_points'"),
        ("views.count.x=3", "views.count: "),
        ("sampling=3", "sampling: "),
        ("extends=quick", "unknown key 'extends'$"),
        ("views.count=many", r"^--set objects=3 --set views.count=many: views.count: .*integer"),
        ("sampling.grids=[8, 8]", "sampling: grids are different sizes"),
        ("views.count", r"^--set 'views.count': write it as section.key=value"),
        ("=3", "write it as section.key=value"),
        ("views.=3", "unknown key 'views.'"),
        (".".join("a" * 5000) + "=3", "unknown key 'a'"),
        ("sampling.grids=[8", "not YAML that can be read"),
        ("sampling.grids=!!python/name:os.system []", "not YAML that can be read"),
        ("views.count=\ud800", "not YAML that can be read"),
        ("padding=true", "true and false .* are no value"),
    ],
)
def test_a_bad_setting_is_refused_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(InvalidRecipe, match=sentence) as caught:
        with_settings(load_recipe("quick", "laptop"), ["objects=3", text])
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("--set ")


@pytest.mark.parametrize("kind", ["FIFO", "folder", "device", "round link"])
def test_a_recipe_is_a_regular_file(tmp_path: Path, kind: str) -> None:
    unfit(tmp_path / "mine.yaml", kind, 0)
    with pytest.raises(InvalidRecipe):
        load_recipe(tmp_path / "mine.yaml", "laptop")


def test_a_disk_that_does_not_answer_is_no_fault_of_the_recipe(tmp_path, monkeypatch) -> None:
    def fails(*_args):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("articugen.core.files.read_regular", fails)
    with pytest.raises(MachineFault):
        load_recipe(written(tmp_path, "objects: 1"), "laptop")


def test_text_and_hash_depend_on_the_meaning_alone(tmp_path: Path) -> None:
    one = load_recipe(
        written(tmp_path, "name: a\nobjects: 3\nfusion: {truncation: 1.0e-2}", "one.yaml"), "laptop"
    )
    two = load_recipe(
        written(tmp_path, "# a comment\nfusion:\n  truncation: 0.01\nobjects: 3\nname: a"), "laptop"
    )
    other = two.with_options(objects=4)
    assert one == two
    assert one.sha256() == two.sha256() != other.sha256()
    assert Recipe.model_validate(json.loads(one.text())) == one


def test_another_process_hashes_the_same() -> None:
    code = (
        "from articugen.core.recipe import load_recipe\n"
        "print(load_recipe('quick', 'oven').sha256())"
    )
    assert printed("-c", code, PYTHONHASHSEED="1").strip() == load_recipe("quick", "oven").sha256()


def test_what_decides_an_object_counts_neither_names_nor_objects() -> None:
    """So that data made for a few objects serve a later run for more of them."""
    recipe = load_recipe("quick", "laptop")
    more = recipe.with_options(objects=40).model_copy(update={"name": "other"})
    assert more.for_one_object() == recipe.for_one_object()
    assert recipe.with_options(states=11).for_one_object() != recipe.for_one_object()


def test_with_counts_replaces_what_is_given_and_checks_it() -> None:
    recipe = load_recipe("quick", "laptop")
    assert recipe.with_options() == recipe
    assert recipe.with_options(objects=3).objects == 3
    changed = recipe.with_options(states=2)
    assert (changed.articulation.states, changed.objects) == (2, recipe.objects)
    with pytest.raises(InvalidRecipe, match="greater than or equal to 1"):
        recipe.with_options(objects=0)


def test_what_moves_and_from_where_is_part_of_the_recipe() -> None:
    recipe = load_recipe(None, "laptop")
    assert recipe.with_options().sha256() == recipe.sha256()
    other = recipe.with_options(movable=["door*"], canonical="upper")
    assert (other.articulation.movable, other.articulation.canonical) == (("door*",), "upper")
    assert other.for_one_object().sha256() != recipe.for_one_object().sha256()
    with pytest.raises(InvalidRecipe, match=r"recipe 'laptop': articulation\.canonical: .*'lower'"):
        recipe.with_options(canonical="middle")


def test_whether_joints_keep_to_their_limits_is_said_in_the_recipe_that_is_stored() -> None:
    left_open = load_recipe(None, "oven")
    assert left_open.articulation.clip_to_limits == "source"
    real, ours = (left_open.for_source(clips_to_limits=clips) for clips in (True, False))
    assert (real.articulation.clip_to_limits, ours.articulation.clip_to_limits) == (True, False)
    assert real.for_one_object().sha256() != ours.for_one_object().sha256()
    assert ours.for_source(clips_to_limits=True) == ours, "said once, it stays"


def test_versions_of_sensors_decide_the_data_of_recipes_that_name_them() -> None:
    plain, held = (content.declared(None, load_recipe(n, "oven").text()) for n in (None, "held"))
    assert held == f"{plain}, partial_cameras 3, kinect_metres 2"
