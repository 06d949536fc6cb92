import numpy as np
import pytest

from articugen.core.geometry import apply, box_corners, fibonacci_sphere
from articugen.core.recipe import ViewSettings
from articugen.rendering.views import MARGIN, fusion_views, random_pinhole_views, spread_order

BOX = np.array([[-0.45, -0.2, -0.3], [0.45, 0.3, 0.1]])


@pytest.mark.parametrize("count", [1, 2, 7, 64, 100])
def test_spread_order_is_a_permutation(count):
    assert sorted(spread_order(fibonacci_sphere(count))) == list(range(count))


def test_any_prefix_of_the_views_looks_from_all_around():
    views = fusion_views(ViewSettings(), BOX)
    directions = views.T_camera_world[:8, 2, :3]
    cosines = directions @ directions.T - 2 * np.eye(8)
    assert np.degrees(np.arccos(cosines.max())) > 50
    every = views.T_camera_world[:, 2, :3]  # whose widest hole test_geometry.py measures
    far = np.linalg.norm(every[:, None] - fibonacci_sphere(100), axis=2)
    assert max(far.min(axis=0).max(), far.min(axis=1).max()) < 1e-9


@pytest.mark.parametrize("projection", ["orthographic", "pinhole"])
def test_the_box_fills_each_image_up_to_the_margin(projection):
    views = fusion_views(ViewSettings(projection=projection, resolution=200), BOX)
    for k in range(len(views)):
        x, y, z = apply(views.T_camera_world[k], box_corners(BOX)).T
        w = z if projection == "pinhole" else 1.0
        for low_high, focal, center in (
            (x, views.fx[k], views.cx[k]),
            (y, views.fy[k], views.cy[k]),
        ):
            u = focal * low_high / w + center
            assert u.min() == pytest.approx(MARGIN)
            assert u.max() == pytest.approx(200 - MARGIN)


def test_random_views_depend_on_the_generator_alone():
    a, b = (random_pinhole_views(3, 64, BOX, rng=np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(a.T_camera_world, b.T_camera_world)
    assert np.all(a.T_camera_world[:, 2, 3] > 1.0)


def test_no_random_views_are_none():
    assert len(random_pinhole_views(0, 64, BOX, rng=np.random.default_rng(5))) == 0
