"""Inputs of our own formats to begin with, made by what writes them: they never grow old."""

import functools
import io
import json
import tarfile
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from PIL import Image

from articugen.core.content import RECIPES, SOURCES
from tests.published import model_files, zipped

TESTS = Path(__file__).resolve().parents[1]
_SHA256 = "0" * 64
BETWEEN = b"\n---\n"
"""Several files that are one input."""


def objs() -> Iterable[bytes]:
    """One that is long enough for the compiled reader."""
    yield b"".join(b"v %d 0.5 -1e-3\n" % i for i in range(1100)) + b"f 1 2 3\nf -1 -2/3 1\n" * 20


def looks() -> Iterable[bytes]:
    """A mesh with materials, one of them of a texture."""
    obj = b"mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 2 0\nvt 0 1.5\n"
    obj += b"usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/-3 -2 -1\n"
    mtl = b"newmtl a\nKd 1 .5 0\nmap_Kd -s 1 1 1 t.png\nnewmtl b\nKd 0.2\n"
    for kind in ("PNG", "JPEG", "BMP", "TGA", "WEBP"):
        picture = _picture(np.arange(48, dtype=np.uint8).reshape(4, 4, 3), kind)
        yield BETWEEN.join([obj, mtl, picture])


def aods() -> Iterable[bytes]:
    """One image of two parts, half a metre away."""
    info = b"rotation:\n1 0 0\n0 1 0\n0 0 1\ncenter:\n0 0 -0.5\nextent:\n0.3 0.2 0.02\n"
    part = np.repeat(np.arange(2, dtype=np.uint8), 8)[None].repeat(16, 0)
    masks = [_picture(mask, "PNG") for mask in (1 - part, part)]
    yield BETWEEN.join([info, info, *masks, _picture(np.full((16, 16), 500, np.uint16), "PNG")])


def _picture(pixels: Any, kind: str) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind)
    return file.getvalue()


def recipes() -> Iterable[bytes]:
    """Of data, and one that says most of what can be said."""
    from articugen.core.recipe import load_recipe

    yield from _texts(RECIPES, learner=False)
    yield json.dumps(json.loads(load_recipe("quick", "laptop").text()), indent=1).encode()


def training_recipes() -> Iterable[bytes]:
    yield from _texts(RECIPES, learner=True)


def lists() -> Iterable[bytes]:
    for path in sorted((RECIPES / "lists").glob("*.yaml")):
        yield path.read_bytes()


def _texts(folder: Path, *, learner: bool) -> Iterable[bytes]:
    from articugen.core.yaml_files import known

    for name in known(learner=learner):
        yield (folder / f"{name}.yaml").read_bytes()


def source_files() -> Iterable[bytes]:
    for path in sorted(SOURCES.glob("*/source.yaml")):
        yield path.read_bytes()


def old_shards() -> Iterable[bytes]:
    yield (TESTS / "data" / "shard_version_1.h5").read_bytes()


@functools.cache
def shards() -> tuple[bytes, ...]:
    """Shards of the instances of the old one: as small as shards are."""
    from articugen.store.shards import open_shard
    from articugen.store.writer import write_shard

    with open_shard(TESTS / "data" / "shard_version_1.h5") as old:
        rows = [old.instance(i) for i in range(len(old))]
        about = {k: v for k, v in old.attributes.items() if k not in ("format", "schema_version")}
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for count in (1, 3):
            path = Path(folder) / "train-00000.h5"
            write_shard(path, rows[:count], about)
            found.append(path.read_bytes())
    return tuple(found)


def _outcomes() -> list[Any]:
    from articugen.store.outcome import Key, Outcome, Rejection
    from articugen.store.shards import ShardRecord

    def key(name: str) -> Key:
        return Key(
            split="train", object_id=name, ref="r", recipe_sha256=_SHA256, seed=0, generator="0"
        )

    record = ShardRecord("train-00000.h5", _SHA256, 9, 1, (("a", 0, _SHA256),))
    return [
        Outcome.of_shard(key("a"), record, input_sha256=_SHA256, notes=("n",), seconds=1.5),
        Outcome(rejected=Rejection(key=key("b"), reason="b: has no lid", over=("faces", 2.0))),
        Outcome(skipped=Rejection(key=key("c"), reason="c: does not move")),
        Outcome(failed=Rejection(key=key("d"), reason="d: no memory")),
    ]


def manifests() -> Iterable[bytes]:
    """Two in one file, then one in pages."""
    from articugen.store import manifest

    for outcomes in (_outcomes(), _outcomes()[:1]):
        yield _manifest_of(outcomes).model_dump_json().encode()
    another = _outcomes()[1]
    key = another.key.model_copy(update={"object_id": "e"})
    two = another.model_copy(update={"rejected": another.rejected.model_copy(update={"key": key})})
    with mock.patch.object(manifest, "PAGE_ENTRIES", 1):
        *pages, head = (data for _, data in _manifest_of([*_outcomes(), two]).files())
    yield BETWEEN.join([head, *pages])


def _manifest_of(outcomes: list[Any]) -> Any:
    from articugen.core.recipe import load_recipe
    from articugen.store.manifest import Manifest, Timings

    return Manifest.of(
        outcomes,
        category="box",
        source="tests",
        licence="MIT",
        recipe=load_recipe("quick", "laptop").text(),
        seed=0,
        timings=Timings(seconds=1.0, instances_per_second=1.0, peak_memory_bytes=1, workers=1),
        shortfall="d failed" if len(outcomes) > 1 else None,
    )


def journals() -> Iterable[bytes]:
    lines = [outcome.model_dump_json() for outcome in _outcomes()]
    yield ("\n".join(lines) + "\n").encode()


def checkpoint_data() -> dict[str, Any]:
    """What a checkpoint holds, with a state of next to nothing."""
    import torch

    from articugen.learning.method import load_recipe

    state = {"iteration": 2, "model": {"w": torch.ones(2, 3), "b": torch.zeros(3)}}
    return {
        "format": _checkpoint_format(),
        "recipe": load_recipe("ppd_quick").plain(),
        "category": "box",
        "seed": 0,
        "iteration": 2,
        "best": 0.5,
        "state": state,
    }


def _checkpoint_format() -> str:
    from articugen.learning.run_folder import FORMAT

    return FORMAT


def checkpoints() -> Iterable[bytes]:
    """Without a digest, which `mending.checkpoint` gives them."""
    from articugen.learning.sealed import image_of
    from articugen.learning.tensors import in_numpy

    yield image_of(in_numpy(checkpoint_data()))


def runs() -> Iterable[bytes]:
    about = {
        "category": "box",
        "seed": 0,
        "recipe_sha256": _SHA256,
        "data": {"folder": "d", "content_sha256": _SHA256},
        "articugen": "0",
        "commit": None,
        "torch": "2",
        "machine": {"system": "Linux", "cores": 2},
    }
    yield json.dumps(about).encode()


def metrics() -> Iterable[bytes]:
    lines = [
        {"iteration": 1, "terms": {"loss": 0.5}, "learning_rate": 1e-3, "seconds": 0.1},
        {"iteration": 2, "validation": {"loss": 0.5}, "stage": 1},
    ]
    yield "".join(json.dumps(line) + "\n" for line in lines).encode()


def evaluations() -> Iterable[bytes]:
    from articugen.evaluation.results import RunEvaluation
    from tests.test_report import result

    del RunEvaluation
    yield json.dumps(result().model_dump(mode="json")).encode()


def clouds(kind: str) -> Iterable[bytes]:
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (70, 3)).astype(np.float32)
    buffer = io.BytesIO()
    if kind == "npy":
        np.save(buffer, points)
        yield buffer.getvalue()
        yield _npy(points.astype(">f8").T)
    elif kind == "npz":
        np.savez(buffer, points=points)
        yield buffer.getvalue()
        buffer = io.BytesIO()
        np.savez_compressed(buffer, points=points, other=points)
        yield buffer.getvalue()
        view = {"pc": points, "detection": points[:, 0] < 1, "segmentation": np.arange(70) % 3}
        view |= {"part": np.tile([*np.eye(3).ravel(), 0.1, 0.2, 0.3, 1, 1, 1], (2, 1))}
        buffer = io.BytesIO()
        np.savez(buffer, np.array(view, dtype=object))
        yield buffer.getvalue()
    elif kind == "xyz":
        yield b"# a cloud\n" + b"".join(b"%.3f %.3f %.3f 1\n" % tuple(p) for p in points.tolist())
    else:
        import trimesh

        for cloud in (trimesh.PointCloud(points), trimesh.creation.box()):
            yield cloud.export(file_type="ply")
        head = "ply\nformat ascii 1.0\nelement vertex 70\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        yield head.encode() + b"".join(b"%.3f %.3f %.3f\n" % tuple(p) for p in points.tolist())


def _npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def _small_model() -> dict[str, bytes]:
    files = model_files()
    return {name: data for name, data in files.items() if not name.startswith("images/")}


def zips() -> Iterable[bytes]:
    yield zipped(_small_model(), "1234/")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in _small_model().items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
        archive.mkdir("folder")
    yield buffer.getvalue()


def tars() -> Iterable[bytes]:
    """Archives before they are compressed, which `mending.gzipped` does."""
    for form in (tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=form) as archive:
            for name, data in _small_model().items():
                long = form != tarfile.USTAR_FORMAT and name == "meta.json"
                info = tarfile.TarInfo(f"1234/{'é' * 60 if long else name}")
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))
            link = tarfile.TarInfo("1234/link")
            link.type, link.linkname = tarfile.SYMTYPE, "../outside/secret.obj"
            if form == tarfile.GNU_FORMAT:
                archive.addfile(link)
        yield buffer.getvalue()
