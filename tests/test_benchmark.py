"""The benchmark: its truths against closed forms, recipes of others against what they promise."""

from importlib import import_module
from pkgutil import iter_modules

import numpy as np
import pytest

import articugen as ag
from tests import benchmarks, chaos, fuzz
from tests.benchmarks import cases, glance, labs, paris, publish, tables
from tests.benchmarks.cases import VOXEL
from tests.benchmarks.rows import Results
from tests.shapes import box, labelled

PROGRAMS = [
    f"{package.__name__}.{module.name}"
    for package in (benchmarks, chaos, fuzz)
    for module in iter_modules(package.__path__)
    if module.name != "__main__"
]


@pytest.mark.parametrize("program", PROGRAMS)
def test_programs_that_no_test_runs_find_what_they_import(program):
    try:
        import_module(program)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in ("articugen", "tests"):
            raise
        pytest.skip(f"needs {error.name}")


def test_distances_by_octants_are_all_distances():
    open3d = pytest.importorskip("open3d", reason="the recipes of others need open3d")
    mesh = labelled(box((0.05, 0.1, 0.03), (-0.3, 0.2, 0.1)), box((0.2, 0.05, 0.1), (0.3, 0, -0.2)))
    size = 32
    corner, cell = labs._grid(mesh, size, 0.95)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    centres = corner + (np.indices((size,) * 3).reshape(3, -1).T + 0.5) * cell
    every = scene.compute_distance(centres.astype(np.float32)).numpy().reshape((size,) * 3)
    reach = 3.0 * cell
    np.testing.assert_allclose(
        labs._unsigned(mesh, corner, cell, size, reach), np.minimum(every, reach), atol=1e-6
    )


def test_a_flood_swells_by_a_cell():
    pytest.importorskip("open3d", reason="the recipes of others need open3d")
    drum, feet, outwards = cases.drum()
    held = cases.depth_along(labs.flood_filled(drum, 64), feet, outwards, 16 * VOXEL)
    side = float(np.ptp(drum.vertices, axis=0).max()) / 0.95
    assert held.mean() - 16.0 == pytest.approx(side / 64 / VOXEL, abs=0.2)


def test_a_wall_about_every_triangle_leaves_solids_hollow():
    for name in ("open3d", "igl", "skimage"):
        pytest.importorskip(name, reason="the recipe of Hunyuan3D-2.1 needs it")
    cube = labelled(box((0.8, 0.8, 0.8)))
    line = np.linspace(0.3, 0.5, 2000)[:, None] * (1.0, 0.0, 0.0)
    inside = labs.walled(cube, 128)(line)
    assert inside.mean() * 0.2 / (0.8 * 1.1 / 128) == pytest.approx(2 * 128 / 128 / 1.1, abs=0.15)
    assert not inside[0]
    assert not inside[-1]


def _report():
    """One method of ours and one peer, clean and messy."""
    results = Results(shared=["a state 1", "b state 1"])
    for method, core, material in (("ours", 0.1, 0.99), ("peer", 2.0, 0.5)):
        for case, messy in (("a state 1", False), ("b state 1", True)):
            row = {"method": method, "case": case, "category": "laptop", "messy": messy}
            times = {"real": False, "run": 0, "seconds": core / 2, "cpu": core}
            results.timings.append(row | times)
            results.many.append(row | times | {"cpu": 3 * core})
            truth = {"uniform": material, "near": material}
            results.scores.append(row | {"material": truth, "visible": {"uniform": 1, "near": 0.8}})
        results.shapes.append({"method": method, "thickness": [1.5, 1.4, 1.6], "growth": 0.25})
    methods = [{"name": "ours", "absent": ""}, {"name": "peer", "absent": ""}]
    about = {"command": "c", "commit": "abc", "date": "today", "machine": "M"}
    report = {"methods": methods, "memory": {}, "labels": 625_000, "categories": ["laptop"]}
    return report | vars(results) | {"about": about}


def test_both_truths_and_both_budgets_are_told():
    report = _report()
    text = tables.comparison(report).markdown()
    assert "625,000 labels: s" in text
    truths = "0.5000 / 0.5000 | 1.0000 / 0.8000"
    assert f"| peer | 1 | 2 | 20 | 20 | 1 | 6 | 20 | {truths} | {truths} |" in text
    assert "| ours | 1.50 (1.40 to 1.60) | +0.25 |" in tables.shapes(report).markdown()


def test_reports_are_published_with_their_pictures(tmp_path):
    root, folder = tmp_path / "root", tmp_path / "out"
    (root / "docs" / "images").mkdir(parents=True)
    folder.mkdir()
    page = "kept\n<!-- glance -->\n\nold\n\n<!-- end of glance -->\n\nafter\n"
    (root / "docs" / "performance.md").write_text(page)
    (folder / "glance.md").write_text(glance.markdown(_report()))
    (folder / "methods.png").write_bytes(b"png")
    publish.main(folder, root)
    performance = (root / "docs" / "performance.md").read_text()
    assert performance.startswith("kept\n<!-- glance -->")
    assert performance.endswith("<!-- end of glance -->\n\nafter\n")
    assert "old" not in performance
    assert "`c` at commit abc, today, M;" in performance
    row = "| peer | 2 | 6 | 0.5000 / 0.5000 | 0.5000 / 0.5000 | 1.0000 / 0.8000 |"
    assert row in performance
    assert (root / "docs" / "images" / "methods.png").read_bytes() == b"png"


@pytest.mark.parametrize("commit", ["78dfd59732ff-dirty", "78dfd59732ff+changes", "unknown"])
def test_figures_of_code_that_no_commit_has_are_not_published(tmp_path, commit):
    report = _report()
    report["about"]["commit"] = commit
    (tmp_path / "glance.md").write_text(glance.markdown(report))
    with pytest.raises(SystemExit, match="commit first, and measure again"):
        publish.main(tmp_path, tmp_path)


def test_a_picture_has_a_dot_a_method(tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    assert glance.draw(_report(), tmp_path / "methods.png") is None
    assert (tmp_path / "methods.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("category", "name"), [("laptop", "laptop_0002"), ("drawer", "drawer_0003")]
)
def test_axes_are_measured_as_paris_does(category, name):
    model = ag.load("procedural", name, category=category)
    row = paris.measured(model, paris.PAIRS[1])
    assert row.angle < 0.5
    assert row.motion is not None
    assert row.motion < (0.2 if category == "laptop" else 0.005)
    assert (row.position is None) == (category == "drawer")
    assert f"axis {row.angle:6.2f}" in paris.line(name, row)
    missed = paris.Errors(90.0, None, None, 0, 1.0)
    assert paris.summary([row, missed]).startswith("1 of 2 right; axes off by 45")
    assert "(PARIS 2.93)  missed" in paris.line("10905", missed)
