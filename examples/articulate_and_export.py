"""Articulate a URDF of one's own, and export what comes of it to four formats.

Run: python examples/articulate_and_export.py [my/cabinet.urdf] [--out made]; without a URDF it
writes a small cabinet first.
"""

import argparse
from pathlib import Path

import articugen as ag

CABINET = """<robot name="cabinet">
  <link name="body">{walls}
  </link>
  <link name="door"><visual><origin xyz="0 0.19 0"/>
    <geometry><box size="0.02 0.38 0.56"/></geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="body"/><child link="door"/>
    <origin xyz="0.21 -0.19 0"/><axis xyz="0 0 -1"/>
    <limit lower="0" upper="1.8" effort="1" velocity="1"/></joint>
</robot>
"""
WALL = '\n    <visual><origin xyz="{}"/><geometry><box size="{}"/></geometry></visual>'
WALLS = (
    ("-0.19 0 0", "0.02 0.4 0.6"),
    ("0 -0.19 0", "0.4 0.02 0.6"), ("0 0.19 0", "0.4 0.02 0.6"),
    ("0 0 -0.29", "0.4 0.4 0.02"), ("0 0 0.29", "0.4 0.4 0.02"),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("urdf", type=Path, nargs="?", help="without it a cabinet is written")
    parser.add_argument("--out", type=Path, default=Path("made"))
    parser.add_argument("--states", type=int, default=4, help="random joint states of the data")
    parser.add_argument("--resolution", type=int, default=256, help="of part meshes")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    urdf = asked.urdf or asked.out / "cabinet.urdf"
    if asked.urdf is None:
        urdf.write_text(CABINET.format(walls="".join(WALL.format(*wall) for wall in WALLS)))

    # One state of one's own: all joints half open, as instance and as mesh.
    model = ag.load(urdf)
    print(model)
    maker = ag.Maker(model, recipe="quick")
    half = maker.at({j.name: (j.lower + j.upper) / 2 for j in maker.joints if j.mimic is None})
    half.mesh(resolution=128).export(asked.out / "half_open.ply")
    moved = abs(half.flow_to(maker[0])).max(axis=-1) > 1e-6
    print(f"half open: {half.state}; {moved.mean():.0%} of its surface moved")

    # A data set of random states, and what others read.
    counts = {"recipe": "quick", "states": asked.states}
    data = ag.generate(model.category, source=urdf, out=asked.out / "data", **counts)
    print(data)
    meshes = {"resolution": asked.resolution}
    for name, options in (("glb", meshes), ("urdf", meshes), ("ply", {}), ("webdataset", {})):
        done = ag.export(data, name, asked.out / name, **options)
        first = min(path for path in done.folder.rglob("*") if path.suffix[1:] in (name, "tar"))
        print(f"{name}: {done.files} files, {done.bytes / 1e6:.1f} MB, for example {first}")


if __name__ == "__main__":
    main()
