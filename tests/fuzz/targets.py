"""What is read of strangers: for each kind of file who reads it, what it may refuse it with, and
inputs to begin with."""

import os
import shutil
import signal
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from articugen.core.errors import (
    ArticugenError,
    CorruptShard,
    InvalidCheckpoint,
    InvalidRecipe,
    InvalidSource,
)
from tests.fuzz import making, mending

DATA = Path(__file__).resolve().parents[1] / "data" / "fuzz"
"""A folder for each target that has inputs of its own: those to begin with, and what was found."""

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"


def _nothing(_folder: Path) -> None:
    pass


def _nothing_more() -> Iterable[bytes]:
    return ()


def _as_it_is(data: bytes) -> bytes:
    return data


@dataclass(frozen=True, eq=False)
class Target:
    """A kind of file.

    Attributes:
        name: of the target.
        file: the input's name in the model's folder.
        read: reads it, all that is in it.
        refusals: what it may raise.
        around: puts beside it what it names.
        made: inputs to begin with that are made, not kept: of formats of our own.
        mended: an input with checksums and lengths set right, so that more than those is tried.
        tokens: words of the format.
        writes: whether it may write into the model's folder.
        extra: the library that it needs, where that is an extra.
        forks: whether it reads in a process of its own.
    """

    name: str
    file: str
    read: Callable[[Path], object]
    refusals: tuple[type[Exception], ...]
    around: Callable[[Path], None] = _nothing
    made: Callable[[], Iterable[bytes]] = _nothing_more
    mended: Callable[[bytes], bytes] = _as_it_is
    tokens: Sequence[bytes] = ()
    writes: bool = False
    extra: str = ""
    forks: bool = False

    def seeds(self) -> list[bytes]:
        """Inputs to begin with, in an order that is always the same."""
        kept = sorted(p for p in (DATA / self.name).glob("*") if p.is_file())
        return [*self.made(), *(path.read_bytes() for path in kept)]


# --- models


def _read_urdf(path: Path) -> object:
    from articugen.sources.urdf import load_urdf

    return load_urdf(path, object_id="1", category="c", missing_ok="gone*")


def _read_mjcf(path: Path) -> object:
    from articugen.sources.mjcf.reader import load
    from articugen.sources.refs import CategorySettings, ObjectRef

    return load(ObjectRef("folder", "cabinet", "1", "train", path), CategorySettings())


def _read_mesh(path: Path) -> object:
    from articugen.meshes.read import read_mesh

    return read_mesh(path)


def _read_scene(path: Path) -> object:
    """As it is, and with its colours, which change nothing else."""
    from articugen.meshes import looks
    from articugen.meshes.read import read_mesh

    plain = read_mesh(path)
    with mock.patch.object(looks, "decoded", _decoded), looks.with_looks(wanted=True) as reader:
        mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.triangles, plain.triangles)
    return _shown(mesh), reader.notes()


def _shown(mesh: Any) -> object:
    """The colours of faces, and those within them."""
    if mesh.texture is None:
        return mesh.colours
    thirds = np.full((len(mesh.faces), 3), 1.0 / 3.0)
    return mesh.colours, mesh.texture.colours(np.arange(len(thirds)), thirds)


def _check_mesh(path: Path) -> object:
    """Whatever is amiss with a mesh is a finding, or one sentence that is not about us."""
    from articugen.inspection.check.door import check

    checks = check(path, jobs=0)
    problem = checks.models[0].problem or ""
    assert "cannot be checked" not in problem, problem
    return checks.json()


def _read_list(path: Path) -> object:
    from articugen.learning.comparison import recipes_of

    return recipes_of(str(path), "eyeglasses")


def _read_shape2motion(path: Path) -> object:
    from articugen.sources.refs import CategorySettings, ObjectRef
    from articugen.sources.shape2motion import load

    ref = ObjectRef("shape2motion", "cabinet", "1", "train", path.parent)
    return load(ref, CategorySettings())


def _laid(path: Path, names: Sequence[str]) -> None:
    """Several files, one input: what lies between lines of dashes is one of them each."""
    pieces = path.read_bytes().split(making.BETWEEN, len(names) - 1)
    for number, name in enumerate(names):
        (path.parent / name).write_bytes(b"".join(pieces[number : number + 1]))


def _files(*names: str) -> Callable[[Path], None]:
    def around(folder: Path) -> None:
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(b"")

    return around


def _read_partnet(path: Path) -> object:
    from articugen.sources.folders import meta_category
    from articugen.sources.partnet_mobility import load
    from articugen.sources.refs import CategorySettings, ObjectRef

    _laid(path, _BESIDE)
    meta_category(path.parent)
    ref = ObjectRef("partnet_mobility", "cabinet", "1", "train", path.parent)
    return load(ref, CategorySettings(model_cat=("Storage",)))


_BESIDE = ("mobility_v2.json", "semantics.txt", "meta.json")


def _decoded(data: bytes) -> np.ndarray | None:
    """A texture as the process of its own decodes it, in this one: None is what is refused."""
    from articugen.meshes import pixels

    try:
        raw = pixels.reduced(data)
    except Exception:  # whatever a decoder meets
        return None
    width, height = np.frombuffer(raw, np.uint32, 2)
    return np.frombuffer(raw, np.uint8, offset=8).reshape(height, width, 3)


def _read_looks(path: Path) -> object:
    from articugen.meshes import looks
    from articugen.meshes.read import read_mesh

    _laid(path, _LOOKS)
    with mock.patch.object(looks, "decoded", _decoded), looks.with_looks(wanted=True) as reader:
        return _shown(read_mesh(path.parent / _LOOKS[0])), reader.notes()


_LOOKS = ("m.obj", "m.mtl", "t.png")


def _read_recording(folder: str, names: Sequence[str]) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        from articugen.evaluation.recorded import read_recording

        _laid(path, names)
        return read_recording(path.parent / folder, 2)

    return read


_RBO, _AOD = "interactions/laptop/laptop01_o", "test/Laptop_Seq_1"
_IN_RBO = (
    *("objects/laptop/configuration_2016-10-01/laptop_in.yaml", f"{_RBO}/tf.csv"),
    *(f"{_RBO}/{name}.csv" for name in ("rb_poses_array", "camera_depth_registered_camera_info")),
    f"{_RBO}/camera_depth_registered/00000-1477656000.5.txt",
)
_IN_AOD = (
    *(f"{_AOD}/info/info_0_{part:03d}.txt" for part in range(2)),
    *(f"{_AOD}/mask/0_{part:03d}.png" for part in range(2)),
    f"{_AOD}/depth_filled/0.png",
)


def _rbo_around(folder: Path) -> None:
    _files(*_IN_RBO)(folder)
    (folder / "objects" / "laptop" / "t.obj").write_text(TRIANGLE)


def _read_usd(path: Path) -> object:
    """As the process of its own reads it, in this one; whatever is amiss is a sentence there."""
    from articugen.sources.usd.model import read_model

    try:
        return read_model(path, path.parent)
    except (ArticugenError, MemoryError):
        raise
    except Exception as error:
        raise InvalidSource(f"{path}: {error}; correct it") from error


def _meshes_around(folder: Path) -> None:
    (folder / "t.obj").write_text(TRIANGLE)
    (folder / "empty.obj").write_text("v 0 0 0\n")
    (folder / "part.xml").write_text("<mujocoinclude><geom size='1'/></mujocoinclude>")
    parts = folder / "part_objs"
    parts.mkdir(exist_ok=True)
    for name in ("none_motion", "door", "knob", "drawer"):
        (parts / f"{name}.obj").write_text(TRIANGLE)


def _partnet_around(folder: Path) -> None:
    _meshes_around(folder)
    shutil.copy(DATA / "urdf" / "partnet.urdf", folder / "mobility.urdf")
    _files(*_BESIDE)(folder)


# --- settings


def _read_recipe(path: Path) -> object:
    from articugen.core.recipe import load_recipe

    recipe = load_recipe(path, "laptop")
    return recipe.text(), recipe.sha256(), recipe.instance_bytes()


def _read_training_recipe(path: Path) -> object:
    from articugen.learning.method import load_recipe

    recipe = load_recipe(path)
    return recipe.text(), recipe.sha256()


def _read_source_file(path: Path) -> object:
    from articugen.sources.source_file import read_source_file

    return read_source_file(path).maker


# --- data sets


def _read_shard(path: Path) -> object:
    from articugen.store.shards import open_shard

    with open_shard(path) as shard:
        shard.content()
        handle = os.open(path, os.O_RDONLY)
        try:
            for name in shard.fields:
                stored = shard.columns[name]
                shard.read(name)
                try:
                    offset, size = stored.span(0)
                    stored.row(os.pread(handle, size, offset))
                except (OSError, ValueError):  # as it is documented
                    continue
        finally:
            os.close(handle)
        try:
            return [shard.instance(i) for i in range(len(shard))]
        except ValueError:  # a record's, which verify makes a finding of
            return None


def _read_apart(path: Path) -> object:
    """As verify's workers do: where HDF5 ends the process, that is a sentence."""
    reads, writes = os.pipe()
    child = os.fork()
    if child == 0:
        said = b""
        try:
            _read_shard(path)
        except CorruptShard as refusal:
            said = f"refused {refusal}".encode()
        except BaseException as error:
            said = f"{type(error).__name__}: {error}".encode(errors="replace")
        finally:
            os.write(writes, said[:60_000])
            os._exit(0)
    os.close(writes)
    try:
        with os.fdopen(reads, "rb") as answer:
            said = answer.read().decode(errors="replace")
    except BaseException:
        os.kill(child, signal.SIGKILL)
        raise
    finally:
        ended = os.waitpid(child, 0)[1]
    if ended or said.startswith("refused "):
        raise CorruptShard(said.removeprefix("refused ") or f"ended by {ended}")
    if said:
        raise AssertionError(said)
    return None


def _read_manifest(path: Path) -> object:
    """What follows lines of dashes are its pages, under the names that they would have."""
    from articugen.store.manifest import Manifest, _parsed
    from articugen.store.manifest_pages import page_of

    head, *pages = path.read_bytes().split(making.BETWEEN)
    if not pages:
        return Manifest.read(path.parent).outcomes
    beside = {page_of(n, data, 1).name: data for n, data in enumerate(pages) if data}
    return _parsed(head, path, lambda page: beside.get(page.name)).outcomes


class _InMemory:
    """A ledger's place that holds one file, as its plan and as a record."""

    at_once = 1

    def __init__(self, data: bytes) -> None:
        self.data = data

    def read(self, name: str) -> bytes:
        return self.data

    def list(self, under: str = "") -> dict[str, object]:
        return {"a.0123456789abcdef.json": None}


def _read_records(path: Path) -> object:
    from pydantic import ValidationError

    from articugen.core import ledger
    from articugen.core.errors import ArticugenError
    from articugen.pipeline.common import CommonPlan
    from articugen.store.outcome import Outcome

    data = path.read_bytes()
    records = ledger.Ledger(_InMemory(data))  # type: ignore[arg-type]
    # What is damaged stays so: it need not be looked at again after a pause.
    with suppress(ArticugenError), mock.patch.object(ledger, "_PAUSES", (0.0,)):
        records.agreed()
    read = list(records.known().values())
    for line in data.splitlines():  # sealed, as whoever means harm would
        for kind in (Outcome, CommonPlan):
            with suppress(ValidationError):
                read.append(kind.model_validate_json(line))
    return read


# --- learning


def _read_checkpoint(path: Path) -> object:
    from articugen.learning.run_folder import read_checkpoint

    return read_checkpoint(path)


def _read_run_json(path: Path) -> object:
    from articugen.learning.run_folder import RunFolder

    return RunFolder(path.parent).about()


def _read_metrics(path: Path) -> object:
    from articugen.learning.run_folder import RunFolder

    return RunFolder(path.parent).metrics()


def _read_evaluation(path: Path) -> object:
    from articugen.evaluation.results import read_evaluation

    return read_evaluation(path.parents[1])


def _read_cloud(path: Path) -> object:
    from articugen.discovery.objects import discover
    from articugen.meshes.points import cloud_of_file, shape_of_file

    del discover
    shape_of_file(path)
    return cloud_of_file(path, fit=True)


# --- what fetch unpacks


def _into(folder: Path) -> None:
    (folder / "into").mkdir()


def _unpack(path: Path) -> object:
    from articugen.sources.fetch.archives import unpack

    return list(unpack(path, path.parent / "into", lambda *_: True))


_IN_XML = (
    *(b"<link", b"<joint", b"</link>", b"<visual>", b"<geometry>", b"<mesh", b' filename="'),
    *(b'type="', b' name="', b"<origin", b' rpy="', b' xyz="', b"<axis", b"<limit", b"<mimic"),
    *(b"<!DOCTYPE r [<!ENTITY e SYSTEM 'file:///@OUTSIDE@/secret.xml'>]>", b"&e;", b"<![CDATA["),
    *(b"@OUTSIDE@/secret.obj", b"../outside/secret.obj", b"package://model/t.obj", b"file://"),
    *(b"package://outside/secret.obj", b"<?xml version='1.0' encoding='utf-16'?>", b"xmlns="),
    *(b"package://../secret.obj", b"http://127.0.0.1/x.obj", b"gone.obj", b"empty.obj", b"t.obj"),
)
_IN_OBJ = (b"\nv ", b"\nf ", b"/", b"//", b"-1", b"\\\n", b"\r", b"#", b" 1 2 3", b"\nf 1 1 1\n")
_IN_STL = (b"solid", b"facet normal", b"outer loop", b"vertex ", b"endfacet", b"endloop")
_IN_PLY = (
    *(b"ply\n", b"format ascii 1.0\n", b"format binary_little_endian 1.0\n", b"end_header\n"),
    *(b"format binary_big_endian 1.0\n", b"element vertex 3\n", b"element face 1\n"),
    *(b"property list uchar int vertex_indices\n", b"property float x\n", b"property double y\n"),
    *(b"property list uint double z\n", b"comment TextureFile ../outside/secret.bin\n"),
    *(b"element edge 2\n", b"property int8 q\n", b"property list float float vertex_index\n"),
)
_IN_DAE = (
    *(b"<node", b"</node>", b"<instance_node", b' url="#', b"<instance_geometry", b"<matrix>"),
    *(b"<triangles", b"<polylist", b"<polygons", b"<tristrips", b"<vcount>", b"<p>", b"<input"),
    *(b"<float_array", b' count="', b' offset="', b' stride="', b"<accessor", b' source="#'),
    *(b"<unit meter='0.01'/>", b"<instance_controller", b"<scale>", b"<rotate>", b"<skew>"),
    *(b"<init_from>../outside/secret.bin</init_from>", b"<library_images>", b"<lookat>"),
    *(b"<diffuse>", b"<color>", b"<texture texture=", b'<instance_material symbol="'),
)
_IN_GLTF = (
    *(b'"uri":', b'"../outside/secret.bin"', b'"@OUTSIDE@/secret.bin"', b'"data:,', b"base64,"),
    *(b'"count":', b'"byteOffset":', b'"byteLength":', b'"componentType":', b'"sparse":'),
    *(b'"children":', b'"mode":', b'"matrix":', b'"rotation":', b'"scale":', b'"extensions":'),
    *(b'"KHR_draco_mesh_compression"', b'"images":', b'"textures":', b'"type":', b'"normalized"'),
    *(b'"materials":', b'"baseColorFactor":', b'"baseColorTexture":', b'"TEXCOORD_0":'),
    *(b'"COLOR_0":', b'"KHR_texture_transform":', b'"offset":', b'"texCoord":', b'"VEC4"'),
)
_IN_YAML = (
    *(b": ", b"\n", b"  ", b"- ", b"[", b"]", b"{", b"}", b"&a ", b"*a", b"<<: ", b"!!int ", b"|"),
    *(b"!!python/object/apply:os.system ", b"!!binary ", b"!!timestamp ", b"!!set ", b"? "),
    *(b"extends: category", b"extends: quick", b"2001-01-01"),
    *(b"null", b"yes", b".inf", b".nan", b"0o17", b"1:30", b"'", b'"', b"%YAML 9.9\n---\n", b"..."),
)
_IN_JSON = (b"null", b"true", b"[]", b"{}", b'""', b"1e999", b"NaN", b"-1", b'"../x"', b'"\\ud800"')
_IN_MTL = (
    *(b"newmtl ", b"Kd ", b"map_Kd ", b"-s 1 1 1 ", b"usemtl ", b"mtllib ", b"vt ", b"\nf 1/1"),
    *(b"../outside/secret.bin", b"@OUTSIDE@/secret.bin", b"C:\\t.png", b"\\\\host\\t.png", b"nan"),
)
_IN_TABLES = (
    *(b"link_ids: ", b"meshes: ", b"mesh_poses: ", b"../../../outside/secret.obj", b"xyz='", b","),
    *(b"field.markers0.id", b"field.transforms0.", b"%time", b"\n", b'"', b".inf", b"1e999"),
    b"nan",
)
_IN_POSES = (
    *(b"rotation:", b"center:", b"extent:", b"1e999", b"nan", b"\x89PNG\r\n", b"IHDR", b"IDAT"),
)
_IN_USDA = (
    *(b"#usda 1.0\n", b'def Xform "x"', b'def Mesh "m"', b"references = @", b"payload = @"),
    *(b"subLayers = [", b"@../outside/secret.bin@", b"@@@", b"</root>", b"over ", b"class "),
    *(b"rel physics:body0 = ", b"PhysicsRevoluteJoint", b"variantSet", b"inherits = ", b"clips"),
)


def _mesh(kind: str, tokens: Sequence[bytes], mended=_as_it_is, made=_nothing_more) -> Target:
    read = _read_scene if kind in ("dae", "glb", "gltf") else _read_mesh
    return Target(
        kind, f"m.{kind}", read, (InvalidSource,), tokens=tokens, mended=mended, made=made
    )


def _cloud(kind: str, tokens: Sequence[bytes] = (), mended=_as_it_is) -> Target:
    return Target(
        f"cloud_{kind}",
        f"cloud.{kind}",
        _read_cloud,
        (InvalidSource,),
        tokens=tokens,
        made=lambda: making.clouds(kind),
        mended=mended,
    )


def _of_a_run(name: str, file: str, read: Callable[[Path], object], **more) -> Target:
    return Target(name, file, read, (InvalidCheckpoint,), extra="torch", **more)


TARGETS = {
    target.name: target
    for target in (
        Target("urdf", "model.urdf", _read_urdf, (InvalidSource,), _meshes_around, tokens=_IN_XML),
        Target("mjcf", "model.xml", _read_mjcf, (InvalidSource,), _meshes_around, tokens=_IN_XML),
        _mesh("obj", _IN_OBJ, made=making.objs),
        Target("check", "m.obj", _check_mesh, (InvalidSource,), tokens=_IN_OBJ, made=making.objs),
        _mesh("stl", _IN_STL, mending.stl),
        _mesh("ply", _IN_PLY),
        _mesh("dae", _IN_DAE),
        _mesh("glb", _IN_GLTF, mending.glb),
        _mesh("gltf", _IN_GLTF),
        Target(
            "shape2motion", "motion_attributes.json", _read_shape2motion, (InvalidSource,),
            _meshes_around, tokens=_IN_JSON,
        ),
        Target(
            "partnet", "beside.txt", _read_partnet, (InvalidSource,), _partnet_around,
            tokens=(*_IN_JSON, making.BETWEEN),
        ),
        Target(
            "looks", "beside.txt", _read_looks, (InvalidSource,), _files(*_LOOKS),
            made=making.looks, mended=mending.pngs, tokens=(*_IN_MTL, making.BETWEEN),
        ),
        Target(
            "rbo", "beside.txt", _read_recording(_RBO, _IN_RBO), (InvalidSource,), _rbo_around,
            tokens=(*_IN_TABLES, making.BETWEEN),
        ),
        Target(
            "aod", "beside.txt", _read_recording(_AOD, _IN_AOD), (InvalidSource,),
            _files(*_IN_AOD), made=making.aods, mended=mending.pngs,
            tokens=(*_IN_POSES, making.BETWEEN),
        ),
        Target(
            "usd", "model.usda", _read_usd, (InvalidSource,), tokens=_IN_USDA, extra="pxr"
        ),
        Target(
            "recipe", "own.yaml", _read_recipe, (InvalidRecipe,), made=making.recipes,
            tokens=_IN_YAML,
        ),
        Target(
            "training", "own.yaml", _read_training_recipe, (InvalidRecipe,),
            made=making.training_recipes, tokens=_IN_YAML,
        ),
        Target(
            "list", "own.yaml", _read_list, (InvalidRecipe,), made=making.lists,
            tokens=(*_IN_YAML, b"only: laptop", b"method: bsp"), extra="torch",
        ),
        Target(
            "source", "source.yaml", _read_source_file, (InvalidSource,), made=making.source_files,
            tokens=_IN_YAML,
        ),
        Target(
            "shard", "train-00000.h5", _read_shard, (CorruptShard,), made=making.shards,
            mended=mending.shard,
        ),
        Target(
            "forged", "train-00000.h5", _read_apart, (CorruptShard,), made=making.shards,
            mended=mending.forged, forks=True,
        ),
        Target(
            "shard_1", "train-00000.h5", _read_shard, (CorruptShard,), made=making.old_shards,
        ),
        Target(
            "manifest", "manifest.json", _read_manifest, (CorruptShard,), made=making.manifests,
            mended=mending.manifest, tokens=_IN_JSON,
        ),
        Target(
            "journal", "records.jsonl", _read_records, (CorruptShard,),
            made=making.journals, tokens=_IN_JSON,
        ),
        _of_a_run(
            "checkpoint", "latest.safetensors", _read_checkpoint, made=making.checkpoints,
            mended=mending.checkpoint, tokens=_IN_JSON,
        ),
        _of_a_run("run", "run.json", _read_run_json, made=making.runs, tokens=_IN_JSON),
        _of_a_run("metrics", "metrics.jsonl", _read_metrics, made=making.metrics, tokens=_IN_JSON),
        Target(
            "evaluation", "evaluation/evaluation.json", _read_evaluation, (InvalidCheckpoint,),
            lambda folder: (folder / "evaluation").mkdir(exist_ok=True),
            made=making.evaluations, tokens=_IN_JSON,
        ),
        _cloud("ply", _IN_PLY),
        _cloud("npy"),
        _cloud("npz"),
        _cloud("xyz"),
        Target(
            "zip", "a.zip", _unpack, (InvalidSource,), _into, made=making.zips,
            writes=True,
        ),
        Target(
            "tar", "a.tar.gz", _unpack, (InvalidSource,), _into, made=making.tars,
            mended=mending.gzipped, writes=True,
        ),
    )
}  # fmt: skip
