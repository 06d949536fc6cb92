"""The viewer of a trained run: what it predicts stands beside the truth."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import browser
from instances import hinged_box
from ppd_data import write_boxes
from test_cli import run
from test_viewer_page import WINDOW, opened

pytest.importorskip("viser", reason="viser is not installed; make viewer installs it")

from test_figures import solid_truth

from articugen.core.colours import colour_of, rgb
from articugen.core.errors import ArticugenError, InvalidSource
from articugen.core.records import Floats, dequantize
from articugen.inspection.viewer import prediction
from articugen.inspection.viewer.layers import Lines, Points, Solid
from articugen.inspection.viewer.panel import PREDICTION
from articugen.inspection.viewer.prediction import Predictor
from articugen.inspection.viewer.serve import Served, served, what_to_show

RECIPE = """
extends: ppd_plain
data: {surface_points: 256, uniform_points: 128, near_points: 128, validation_objects: 1}
schedule: {batch: 3, stages: [{resolution: 16, iterations: 3}], validate_every: 3}
seeds: {count: 1, halve_at: []}
"""
"""So few iterations that something of each shape is left to be seen, though nothing right."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Boxes in <folder>/data, and a run that was trained on them in <folder>/runs/box."""
    folder = tmp_path_factory.mktemp("run")
    write_boxes(folder / "data", train=2, test=1, states=1)
    (folder / "tiny.yaml").write_text(RECIPE)
    told = ("-c", "box", "-d", folder / "data", "-r", folder / "tiny.yaml")
    done = run("train", *told, "--runs", folder / "runs")
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture(scope="module")
def predictor(folder: Path) -> Predictor:
    return Predictor(str(folder / "runs" / "box"))


def test_a_run_shows_the_data_it_was_trained_on_test_objects_first(folder: Path) -> None:
    source, predictor = what_to_show(str(folder / "runs" / "box"))
    assert predictor is not None
    assert (predictor.category, predictor.data) == ("box", folder / "data")
    assert list(source.objects) == ["box-2", "box-0", "box-1"]
    assert what_to_show(str(folder / "data"))[1] is None


def test_what_is_beside_the_truth_is_what_the_run_reconstructs(predictor: Predictor) -> None:
    instance, beside = hinged_box()[1], np.array([0.3, 1.0, 0.0])
    points = dequantize(instance.surface_points)
    found = predictor._learner.reconstruct(points, resolution=prediction.RESOLUTION)
    solids = [each for each in predictor.drawn(instance, beside) if isinstance(each, Solid)]
    assert len(solids) == found.parts
    assert len(found.triangles) > 0
    for part, solid in enumerate(solids):
        mine = found.triangles[found.part == part] + beside
        assert len(solid.vertices) < len(solid.faces) or not len(mine)  # corners are shared
        np.testing.assert_allclose(solid.vertices[solid.faces], mine, atol=1e-12)


class _Truth:
    """A learner that knows the boxes."""

    def reconstruct(self, cloud: Floats, *, resolution: int):
        (instance,) = (
            i for i in hinged_box() if np.array_equal(dequantize(i.surface_points), cloud)
        )
        return solid_truth(instance)


def test_the_truth_as_a_prediction_has_the_colours_and_axes_of_the_truth(
    predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictor, "_learner", _Truth())
    instance, beside = hinged_box()[2], np.array([1.1, 0.0, 0.0])
    drawn = predictor.drawn(instance, beside)
    colours = [rgb(colour_of(k)) for k in range(3)]
    assert [each.colour for each in drawn if isinstance(each, Solid)] == colours
    (pivots,) = (each.points for each in drawn if isinstance(each, Points))
    np.testing.assert_allclose(pivots - beside, instance.joint_pivot, atol=1e-9)
    (lines,) = (each for each in drawn if isinstance(each, Lines))
    along = lines.ends[0, 1] - lines.ends[0, 0]
    across = np.cross(along / np.linalg.norm(along), instance.joint_axis[0])
    np.testing.assert_allclose(across, 0.0, atol=1e-9)


def test_other_data_than_the_run_s_are_refused(folder: Path, tmp_path: Path) -> None:
    path = str(folder / "runs" / "box")
    jars = write_boxes(tmp_path / "jars", train=1, test=1, states=1, category="jar")
    with pytest.raises(InvalidSource, match="is of box, the data are of jar; give others"):
        what_to_show(path, data=jars)
    with pytest.raises(ArticugenError, match=r"nowhere: the data that .* are not there"):
        what_to_show(path, data=tmp_path / "nowhere")
    again = tmp_path / "runs"
    shutil.copytree(folder / "runs" / "box", again)
    (again / "000" / "latest.safetensors").write_bytes(b"cut")
    done = run("view", again)
    assert done.exit_code == 1
    assert "latest.safetensors" in done.stderr


@pytest.fixture
def shown(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setattr(prediction, "RESOLUTION", 24)  # is drawn without a graphics card here
    with served(*what_to_show(str(folder / "runs" / "box"))) as there:
        yield there


def test_the_prediction_is_seen_beside_the_truth(shown: Served) -> None:
    with browser() as chromium:
        window = opened(chromium, shown, WINDOW)

        def seen(image: np.ndarray) -> tuple[bool, bool]:
            """Whether there is anything at the left, and at the right."""
            edge = image.shape[1] // 4
            left, right = ((side < 240).any(axis=2) for side in (image[:, :edge], image[:, -edge:]))
            return left.sum() > 300, right.sum() > 300

        window.picture(lambda now: seen(now) == (True, True))
        window.toggle(PREDICTION)
        window.picture(lambda now: seen(now) == (True, False))
        assert window.faults == []
