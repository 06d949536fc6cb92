import numpy as np
import pytest
import trimesh

from articugen.core.recipe import Recipe
from articugen.fusion import solidify
from articugen.fusion.field import fuse
from articugen.instance.preparing import own_solid, solid_part
from articugen.rendering.rasterizer import render
from tests.shapes import box, labelled, rotated, sheet, two_sided, views_of

RECIPE = Recipe(name="test")
THICKNESS = RECIPE.fusion.sheet_thickness
VOXEL = 1 / 256


def free_along(mesh, origin, direction, offsets):
    field = fuse(render(mesh, views_of(mesh)), mesh, RECIPE.fusion)
    return field.is_free(np.asarray(origin) + offsets[:, None] * np.asarray(direction))


def held(mesh, points):
    return own_solid(solid_part(labelled(mesh), RECIPE), RECIPE).holds(points)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (1, 2, 3), (3, -1, 0.5)])
@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2])
def test_a_sheet_is_one_to_two_voxels_thick_whatever_its_direction(axis, angle):
    bare = rotated(two_sided(sheet()), angle, axis)
    part = solid_part(labelled(bare), RECIPE)
    normal = bare.face_normals[0]
    offsets = np.linspace(-4, 4, 801) * VOXEL
    solid = ~free_along(part.mesh, bare.triangles_center[0] * 0.4, normal, offsets)
    thickness = solid.mean() * 8
    assert 1.0 <= thickness <= 2.0
    assert thickness == pytest.approx(THICKNESS / VOXEL, abs=0.05)


def test_closed_solids_are_left_as_they_are():
    solid = rotated(box((0.6, 0.4, 0.05)), 0.4, (1, 1, 1))
    once, twice = (solid_part(labelled(m), RECIPE) for m in (solid, two_sided(solid)))
    for part in (once, twice):
        assert len(part.mesh.faces) == 12
        assert part.seen.all()
        assert trimesh.Trimesh(part.mesh.vertices, part.mesh.faces).volume == pytest.approx(
            solid.volume
        )


def test_faces_turn_outwards_whatever_their_winding():
    solid = box((0.5, 0.4, 0.3))
    rng = np.random.default_rng(0)
    flip = rng.random(len(solid.faces)) < 0.5
    solid.faces[flip] = solid.faces[flip, ::-1]
    part = solid_part(labelled(solid), RECIPE)
    normals = solidify.face_normals(part.mesh.vertices, part.mesh.faces)
    centers = part.mesh.vertices[part.mesh.faces].mean(axis=1)
    assert np.all(np.sum(normals * centers, axis=1) > 0)


def test_what_is_held_does_not_hang_on_the_winding():
    solid = trimesh.util.concatenate([box((0.2, 0.4, 0.3), (x, 0, 0)) for x in (-0.3, 0.3)])
    points = np.random.default_rng(0).uniform(-0.45, 0.45, (20_000, 3))
    wanted = held(solid, points)
    flip = np.random.default_rng(0).random(len(solid.faces)) < 0.5
    solid.faces[flip] = solid.faces[flip, ::-1]
    assert np.array_equal(held(solid, points), wanted)


def test_only_closed_pieces_that_look_outwards_are_closed():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    inside_out = trimesh.Trimesh(
        np.add(ball.vertices, (0.3, 0, 0)), ball.faces[:, ::-1], process=False
    )
    holed = trimesh.Trimesh(np.subtract(ball.vertices, (0.3, 0, 0)), ball.faces[:-1], process=False)
    touching = [box((0.1, 0.1, 0.1), (x, 0.3, 0)) for x in (0.0, 0.1)]  # a wall and four edges
    pieces = [ball, inside_out, holed, *touching]
    mesh = labelled(*pieces)
    closed = [bool((solidify.closed_piece(mesh.part(k)) >= 0).all()) for k in range(len(pieces))]
    assert closed == [True, False, False, True, True]
    wanted = np.repeat(closed, [len(piece.faces) for piece in pieces])
    assert np.array_equal(solidify.closed_piece(mesh) >= 0, wanted)


def test_a_plate_thinner_than_the_probes_keeps_its_winding():
    """A thin key on a base: seen from inside, its underside looks free through its top."""
    base, key = box((0.6, 0.6, 0.1)), box((0.1, 0.1, 0.0015), (0, 0, 0.05 + 0.00075))
    part = solid_part(labelled(trimesh.util.concatenate([base, key])), RECIPE)
    assert len(part.mesh.faces) == 24
    centers = part.mesh.vertices[part.mesh.faces].mean(axis=1)
    normals = solidify.face_normals(part.mesh.vertices, part.mesh.faces)
    under = (np.arange(24) >= 12) & (centers[:, 2] < 0.05 + 1e-6)
    assert under.sum() == 2
    assert np.all(normals[under, 2] < -0.99)
    assert not part.seen[under].any()
    assert part.seen[~under].all()


def test_an_open_box_of_sheets_gets_walls_and_keeps_its_cavity():
    open_box = box((0.6, 0.6, 0.6))
    top = open_box.face_normals[:, 2] > 0.5
    shell = trimesh.Trimesh(open_box.vertices, open_box.faces[~top], process=False)
    part = solid_part(labelled(two_sided(shell)), RECIPE)
    offsets = np.linspace(-4, 4, 401) * VOXEL
    wall = ~free_along(part.mesh, (0.3, 0.0, 0.1), (1, 0, 0), offsets)
    assert wall.mean() * 8 == pytest.approx(THICKNESS / VOXEL, abs=0.1)
    assert free_along(part.mesh, (0, 0, 0), (0, 0, 1), np.linspace(-0.25, 0.25, 11)).all()


def test_what_nobody_sees_is_known():
    outer, inner = box((0.6, 0.6, 0.6)), box((0.2, 0.2, 0.2))
    part = solid_part(labelled(trimesh.util.concatenate([outer, inner])), RECIPE)
    assert part.seen.sum() == 12
    assert len(part.mesh.faces) == 24


def test_repeated_and_empty_faces_go_once():
    mesh = labelled(two_sided(box((0.5, 0.5, 0.5))))
    assert len(solidify.unrepeated(mesh)) == 12
    flat = trimesh.Trimesh(
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0)], [(0, 1, 2), (0, 1, 3)], process=False
    )
    assert len(solidify.unrepeated(labelled(flat))) == 1


def thickened(sheets):
    """Sheets that are seen from both sides, as slabs 0.01 thick, and which faces are seen."""
    mesh = labelled(sheets)
    where = solidify.probes(mesh, 1e-3)
    free, shown = np.ones((2, len(where.face)), bool), np.ones((2, len(mesh.faces)), int)
    closed = np.zeros(len(mesh.faces), bool)
    return solidify.solidified(mesh, where, free, shown, 0.01, closed)[:2]


def test_a_wall_closes_the_rim_and_no_inner_edge():
    """A square of two triangles: two caps of two, and four rim edges of two walls each."""
    solid, seen = thickened(sheet())
    assert len(solid.faces) == 2 * 2 + 4 * 2
    assert seen.all()
    closed = trimesh.Trimesh(solid.vertices, solid.faces)
    assert closed.is_watertight
    assert closed.volume == pytest.approx(0.8 * 0.8 * 0.01)


def test_a_face_that_shows_between_its_probes_is_seen():
    """A wide face all covered by blocks but for a strip along its rim: seen, turned outwards."""
    table = box((0.9, 0.9, 0.05))
    up = table.face_normals[:, 2] > 0.5
    table.faces[up] = table.faces[up, ::-1]  # wound the wrong way round
    blocks = box((0.888, 0.888, 0.1), (0, 0, 0.0751))
    part = solid_part(labelled(trimesh.util.concatenate([table, blocks])), RECIPE)
    corners = part.mesh.vertices[part.mesh.faces]
    on_top = np.all(np.abs(corners[:, :, 2] - 0.025) < 1e-9, axis=1)
    assert on_top.sum() == 2
    assert part.seen[on_top].all()
    assert np.all(solidify.face_normals(part.mesh.vertices, part.mesh.faces)[on_top, 2] > 0.99)


def test_small_faces_of_very_fine_parts_are_judged_together_and_as_alone(monkeypatch):
    """A finely cut block with a fin without thickness: the fin becomes a slab, the block stays."""
    block = box((0.4, 0.4, 0.4)).subdivide_to_size(0.007)
    fin = rotated(sheet(0.3), np.pi / 2, (1, 0, 0)).subdivide_to_size(0.007)
    fin.apply_translation((0, 0, 0.36))
    mesh = labelled(trimesh.util.concatenate([block, two_sided(fin)]))
    assert len(mesh.faces) >= solidify.FINE_FACES
    together, apart = (solidify.probes(mesh, 1e-3, together=t) for t in (True, False))
    assert len(together.face) < 0.6 * len(apart.face)
    fast = solid_part(mesh, RECIPE)
    monkeypatch.setattr(solidify, "FINE_FACES", 10**9)
    exact = solid_part(mesh, RECIPE)
    assert len(exact.mesh.faces) > len(mesh.faces)
    assert len(fast.mesh.faces) == pytest.approx(len(exact.mesh.faces), rel=0.005)
    assert fast.seen.mean() == pytest.approx(exact.seen.mean(), abs=0.02)


def bent_sheet(turns: int = 12, bend: float = np.radians(150.0), radius: float = 0.3):
    """A strip bent round an arc, facet by facet, wound at random; and its facets' length."""
    angle = np.linspace(0.0, bend, turns + 1)
    arc = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rows = [np.column_stack([arc, np.full(turns + 1, z)]) for z in (-0.2, 0.0, 0.2)]
    at = np.arange(3 * (turns + 1)).reshape(3, turns + 1)
    quads = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    wound = np.random.default_rng(0).random(len(faces)) < 0.5
    faces[wound] = faces[wound][:, ::-1]
    return trimesh.Trimesh(np.concatenate(rows), faces, process=False), 2 * radius * np.sin(
        bend / turns / 2
    )


def test_a_bent_sheet_becomes_one_watertight_solid_of_its_thickness():
    strip, facet = bent_sheet()
    solid, _ = thickened(strip)
    together = trimesh.Trimesh(solid.vertices, solid.faces)
    together.merge_vertices(digits_vertex=9)
    trimesh.repair.fix_winding(together)
    assert together.is_watertight
    assert abs(together.volume) == pytest.approx(12 * facet * 0.4 * 0.01, rel=1e-6)


def test_nobody_looks_into_a_bent_sheet_between_its_facets():
    """Finely bent, as a tap or a lamp shade is: each point of the middle surface is inside."""
    strip, _ = bent_sheet(turns=60, radius=0.1)
    part = solid_part(labelled(two_sided(strip)), RECIPE)
    points, _ = trimesh.sample.sample_surface(strip, 4000, seed=0)
    inner = points[np.abs(points[:, 2]) < 0.195]
    assert not own_solid(part, RECIPE).field.is_free(inner.astype(np.float32)).any()
