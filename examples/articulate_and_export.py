"""Articulate a URDF of one's own, and export what comes of it to four formats.

Run: python examples/articulate_and_export.py [my/cabinet.urdf] [--out made]; without a URDF it
takes the cabinet that lies beside it.
"""

import argparse
from pathlib import Path

import articugen as ag

CABINET = Path(__file__).with_name("models") / "cabinet.urdf"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("urdf", type=Path, nargs="?", default=CABINET, help="(%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("made"))
    parser.add_argument("--states", type=int, default=4, help="random joint states of the data")
    parser.add_argument("--resolution", type=int, default=256, help="of part meshes")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)

    # One state of one's own: all joints half open, as instance and as mesh.
    model = ag.load(asked.urdf)
    print(model)
    maker = ag.Maker(model, recipe="quick")
    half = maker.at({j.name: (j.lower + j.upper) / 2 for j in maker.joints if j.mimic is None})
    half.mesh(resolution=128).export(asked.out / "half_open.ply")
    moved = abs(half.flow_to(maker[0])).max(axis=-1) > 1e-6
    print(f"half open: {half.state}; {moved.mean():.0%} of its surface moved")

    # A data set of random states, and what others read.
    counts = {"recipe": "quick", "states": asked.states}
    data = ag.generate(model.category, source=asked.urdf, out=asked.out / "data", **counts)
    print(data)
    meshes = {"resolution": asked.resolution}
    for name, options in (("glb", meshes), ("urdf", meshes), ("ply", {}), ("webdataset", {})):
        done = ag.export(data, name, asked.out / name, **options)
        first = min(path for path in done.folder.rglob("*") if path.suffix[1:] in (name, "tar"))
        print(f"{name}: {done.files} files, {done.bytes / 1e6:.1f} MB, for example {first}")


if __name__ == "__main__":
    main()
