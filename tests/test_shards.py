"""Shards: what is written is read back, and a fault while writing leaves what was there."""

import errno
import hashlib
import os
import pickle
import resource
import signal
import subprocess
import sys
import time
import tracemalloc
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from instances import SMALL, assert_same, changed, hinged_box
from ppd_data import attributes_of
from python_process import NO_BYTECODE
from trouble import small_disk

from articugen.core import schema
from articugen.core.errors import ArticugenError, MachineFault, RejectedInstance
from articugen.core.files import whole_name
from articugen.core.schema import Instance, stored_name
from articugen.store import columns
from articugen.store.shards import content_sha256, instance_sha256, open_shard
from articugen.store.writer import write_shard
from tests.format_tables import markdown

VERSION_1 = Path(__file__).parent / "data" / "shard_version_1.h5"
ROWS = hinged_box()
NAMED = tuple(
    changed(
        row,
        joint_name=("Scharnier für den Deckel", "滑"),
        part_name=("base", "ü" * 127 + "x", "part with spaces"),
        part_semantic=("", "lid", ""),
        coverage={
            r: np.where(grid > 0, 255, r).astype(np.uint8) for r, grid in row.occupancy.items()
        },
    )
    for row in ROWS
)
"""With every field that is optional."""

ABOUT = attributes_of()


def test_a_shard_tells_of_its_instances_and_its_record_of_the_file(written):
    path, record = written
    data = path.read_bytes()
    assert (record.name, record.bytes) == (path.name, len(data))
    assert record.sha256 == hashlib.sha256(data).hexdigest()
    with open_shard(path) as shard:
        assert len(shard) == record.instances == len(ROWS)
        assert shard.object_ids() == ("box-0",) * len(ROWS)
        assert ABOUT.items() <= shard.attributes.items()
        row = shard.instance(0)
        with pytest.raises(IndexError, match="no instance 4"):
            shard.instance(4)
    assert (row.joint_name, row.part_name, row.part_semantic, dict(row.coverage)) == (None,) * 3 + (
        {},
    )


def test_names_are_text_for_plain_h5py(tmp_path):
    write_shard(tmp_path / "named.h5", NAMED, ABOUT)
    with h5py.File(tmp_path / "named.h5") as file:
        dataset = file["part_name"]
        assert isinstance(dataset, h5py.Dataset)
        assert tuple(dataset.asstr()[2]) == NAMED[2].part_name


def test_names_count_in_the_content_whatever_the_grouping(tmp_path):
    """An object's digest is the same beside one with longer names, and another for other names."""
    other = [
        changed(row, object_id="the-longer-one", part_name=("n" * 255, "b", "c")) for row in NAMED
    ]
    alone = write_shard(tmp_path / "alone.h5", NAMED, ABOUT).content
    both = write_shard(tmp_path / "both.h5", [*other, *NAMED], ABOUT).content
    assert both[len(other) :] == alone
    renamed = [changed(row, part_semantic=("", "", "lid")) for row in NAMED]
    again = write_shard(tmp_path / "renamed.h5", renamed, ABOUT).content
    assert not {digest for *_, digest in alone} & {digest for *_, digest in again}


@pytest.mark.parametrize(
    ("name", "stored"),
    [
        ("Tür", "Tür"),
        ("", ""),
        ("x" * 255, "x" * 255),
        ("x" * 254 + "ü", "x" * 254),
        ("a\0b\0", "a\ufffdb\ufffd"),
        ("a\ud800b", "a\ufffdb"),
    ],
)
def test_any_name_fits_into_a_shard(tmp_path, name, stored):
    assert stored_name(name) == stored
    write_shard(tmp_path / "a.h5", [changed(NAMED[0], joint_name=(stored, "other"))], ABOUT)
    with open_shard(tmp_path / "a.h5") as shard:
        assert shard.instance(0).joint_name == (stored, "other")


def test_longer_names_are_faults_of_the_caller(tmp_path):
    with pytest.raises(ValueError, match="a text of more than 255 bytes"):
        write_shard(tmp_path / "a.h5", [changed(ROWS[0], object_id="x" * 256)], ABOUT)
    with pytest.raises(ValueError, match=r"part_name: shape \(1, 2\), not \(N, P\)"):
        changed(ROWS[0], part_name=("a", "b"))


def test_shards_of_version_1_are_read():
    """The file was written by version 1; the digests are those that its writer printed."""
    with open_shard(VERSION_1) as shard:
        assert shard.attributes["schema_version"] == 1
        assert shard.attributes["note"] == "Größe"
        assert shard.content() == (
            ("box-0", 0, "234b858de71e1e3869b733e1b718378c5250701ad5bb69d1e060e0230cc53efb"),
            ("box-0", 1, "c3e12e2936857b2fceceabe29e987d021f935c4d918bcd7cc84b4c6fa602f77c"),
            ("box-0", 2, "3aeb5b0ecda9104e29dda3ccbdbd45203b94a8629a26f8a31b50ef64ec3671c1"),
        )
        row, same = shard.instance(2), hinged_box(((0.0, 0.0), (0.5, 0.1), (1.2, 0.25)))[2]
        assert (row.state_index, row.joint_name, sorted(row.occupancy)) == (2, None, [4, 8])
        np.testing.assert_allclose(row.joint_state, [1.2, 0.25 / row.scale])
        for name in ("joint_axis", "part_motion", "center", "scale"):
            np.testing.assert_allclose(getattr(row, name), getattr(same, name), atol=1e-12)
        batch = shard.batch([2, 0], ["state_index", "uniform_label"])
        assert batch["state_index"].tolist() == [2, 0]


def test_what_users_add_is_left_alone(written, copy):
    with h5py.File(copy, "r+") as file:
        own = file.create_group(schema.USER_GROUP)
        own["away"] = h5py.ExternalLink("/etc/passwd", "/x")
        own["nowhere"] = h5py.SoftLink("/not/there")
        own.create_dataset("outside", (4,), "<f8", external=[("/etc/passwd", 0, 32)])
        own.create_dataset("names", data=["of", "any", "length"])
        own.create_group("deeper")["scale"] = np.zeros(3)
    with open_shard(copy) as shard:
        assert shard.content() == written[1].content
        assert set(shard.fields) == set(ROWS[0].arrays())


def test_content_digest_is_the_one_documented(written):
    row = ROWS[2]
    text = b"object_id box-0\n"
    for name, value in sorted(row.arrays().items()):
        if name != "object_id":
            field = schema.field_of(name)
            assert field is not None
            if field.dtype == "S":
                text += f"{name} utf-8 ({len(value)},)\n".encode()
                text += b"".join(each.encode() + b"\0" for each in value)
                continue
            array = np.asarray(value, field.dtype)
            text += f"{name} {array.dtype.str} {array.shape}\n".encode() + array.tobytes()
    digest = hashlib.sha256(text).hexdigest()
    assert written[1].content[2] == ("box-0", 2, digest)
    lines = sorted(f"{i}\x1f{s}\x1f{d}" for i, s, d in written[1].content)
    expected = hashlib.sha256("\n".join(lines).encode()).hexdigest()
    assert content_sha256(reversed(written[1].content)) == expected


def test_content_digest_does_not_depend_on_the_layout(written, copy):
    with h5py.File(copy, "r+") as file:
        array = file.pop("uniform_points")[()]
        packed = {"chunks": (1, *array.shape[1:]), "compression": 9, "fletcher32": True}
        file.create_dataset("uniform_points", data=array, **packed)
    with h5py.File(copy) as file:
        names = sorted(set(file) - {"object_id"})
        for row, (object_id, _, digest) in enumerate(written[1].content):
            arrays = [(name, np.asarray(file[name][row])) for name in names]
            assert instance_sha256(object_id, reversed(arrays)) == digest
    assert copy.read_bytes() != written[0].read_bytes()


def test_same_instances_same_bytes(written, tmp_path):
    time.sleep(1.1)  # HDF5 counts time in seconds
    again = tmp_path / "another-name.h5"
    assert write_shard(again, iter(ROWS), ABOUT).sha256 == written[1].sha256


def test_format_page_is_true():
    page = (Path(__file__).parents[1] / "docs" / "format.md").read_text()
    assert markdown() in page, "docs/format.md: put in what python -m tests.format_tables prints"
    assert f"version {schema.SCHEMA_VERSION}\n" in page
    stored = [f.name for f in schema.FIELDS if getattr(NAMED[0], f.stem) is not None]
    assert {f.name for f in schema.FIELDS if not f.optional} <= set(stored)
    assert set(NAMED[0].arrays()) == {
        name.replace("<R>", str(r)) for name in stored for r in (8, 16, 32)
    }


def test_plain_h5py_reads_it_and_finds_it_described(written):
    with h5py.File(written[0]) as file:
        for name, dataset in file.items():
            field = schema.field_of(name)
            assert dataset.chunks == (1, *dataset.shape[1:])
            assert dataset.fletcher32
            assert (dataset.compression == "gzip") is field.compressed
            assert dataset.attrs["meaning"] == field.meaning
            assert dataset.attrs["shape"] == field.written_shape
            assert dataset.attrs.get("unit", "") == field.unit
            assert dataset.attrs.get("frame", "") == field.frame
        points = file["surface_points"][1] / 65535 - 0.5
        assert np.abs(points).max() <= 0.45 + 1e-5


def test_batch_is_the_rows_asked_for(written):
    with open_shard(written[0]) as shard:
        batch = shard.batch([3, 0, 3], ["surface_points", "scale", "object_id"])
        np.testing.assert_array_equal(
            batch["surface_points"], [ROWS[i].surface_points for i in (3, 0, 3)]
        )
        assert batch["scale"].shape == (3,)
        assert batch["object_id"].tolist() == [b"box-0"] * 3
        part = shard.read("occupancy_16", slice(1, 3))
        np.testing.assert_array_equal(part, [ROWS[1].occupancy[16], ROWS[2].occupancy[16]])


def test_it_can_be_sent_to_workers_and_survives_a_fork(written):
    with open_shard(written[0]) as shard:
        with pickle.loads(pickle.dumps(shard)) as sent:
            assert_same(sent.instance(1), ROWS[1])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python 3.12 warns where threads run
            child = os.fork()
        if child == 0:
            same = np.array_equal(shard.read("surface_points", 2), ROWS[2].surface_points)
            os._exit(0 if same else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert_same(shard.instance(2), ROWS[2])


@st.composite
def made_up(draw):
    """Instances of one random shape, filled with random bytes."""
    J, S, U, K, C, M, E, V, H = (draw(st.integers(0, 4)) for _ in range(9))
    names = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=60)
    grids = draw(st.sets(st.integers(1, 5), max_size=2))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    known = {"J": J, "P": J + 1, "S": S, "U": U, "K": K, "C": C, "M": M}
    known |= {"E": E, "V": V, "H": H}

    def values(field):
        if field.name == "collision_depth":
            return float(rng.random())
        shape = [known[s] if isinstance(s, str) else s for s in field.shape[1:]]
        if field.dtype in ("<f4", "<f8"):
            return rng.normal(size=shape).astype(field.dtype)
        if field.dtype == "S":
            return tuple(draw(names) for _ in range(shape[0]))
        return rng.integers(0, 100, shape).astype(field.dtype)

    named = draw(st.booleans())
    rows = []
    for index in range(draw(st.integers(1, 3))):
        plain = [f for f in schema.FIELDS if not f.is_grid and (named or not f.optional)]
        arrays = {f.name: values(f) for f in plain if f.name != "object_id"}
        arrays |= {"state_index": index, "scale": float(arrays["scale"])}
        grid = {r: rng.integers(0, 9, (r, r, r)).astype(np.uint8) for r in grids}
        rows.append(Instance(object_id=draw(names), occupancy=grid, coverage=grid, **arrays))
    return rows


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(made_up())
def test_any_shape_comes_back(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("any") / "shard.h5"
    record = write_shard(path, rows, ABOUT)
    with open_shard(path) as shard:
        assert shard.content() == record.content
        for index, row in enumerate(rows):
            assert_same(shard.instance(index), row)


def test_memory_does_not_grow_with_the_number_of_instances(tmp_path):
    """Neither while writing nor while reading back."""

    def peak(count: int) -> int:
        rows = (changed(ROWS[i % len(ROWS)], state_index=i) for i in range(count))
        tracemalloc.start()
        try:
            write_shard(tmp_path / f"{count}.h5", rows, ABOUT)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    one_row = sum(np.asarray(value).nbytes for value in ROWS[0].arrays().values())
    peak(2)  # imports, caches
    assert peak(160) - peak(40) < one_row
    with open_shard(tmp_path / "160.h5") as shard:
        assert shard.read("state_index").tolist() == list(range(160))


def test_instances_that_end_in_an_error_leave_no_file(tmp_path):
    def rows():
        yield from ROWS[:2]
        raise RejectedInstance("nothing of it can be seen")

    with pytest.raises(RejectedInstance, match="nothing of it can be seen"):
        write_shard(tmp_path / "train-00000.h5", rows(), ABOUT)
    assert _leftovers(tmp_path) == []
    with pytest.raises(ValueError, match="is missing"):
        write_shard(tmp_path / "train-00000.h5", iter(()), ABOUT)
    assert _leftovers(tmp_path) == []


def test_mixed_shapes_are_refused(tmp_path):
    other = hinged_box(recipe=SMALL.model_copy(update={"padding": 0.2}))[0]
    fewer = Instance(**{**_kept(other), "occupancy": {8: other.occupancy[8]}})
    with pytest.raises(ValueError, match="of different fields or shapes"):
        write_shard(tmp_path / "a.h5", [ROWS[0], fewer], ABOUT)
    with pytest.raises(ValueError, match="'split' is missing"):
        write_shard(tmp_path / "a.h5", ROWS, {k: v for k, v in ABOUT.items() if k != "split"})
    assert not list(tmp_path.iterdir())


def _kept(row: Instance) -> dict:
    return {name: v for name, v in row.arrays().items() if not name.startswith("occupancy_")}


def _leftovers(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("code", [errno.EMFILE, errno.EIO])
def test_a_fault_of_the_machine_is_no_damage(tmp_path, monkeypatch, code):
    path = tmp_path / "train-00000.h5"
    write_shard(path, ROWS, ABOUT)

    def fails(*_, **__):
        raise OSError(code, os.strerror(code))

    shard = open_shard(path)
    for where, name, read in (
        (os, "pread", lambda: shard.instance(0)),
        (columns, "open_regular", lambda: open_shard(path)),
    ):  # fmt: skip
        with monkeypatch.context() as patch:
            patch.setattr(where, name, fails)
            with pytest.raises(MachineFault, match=os.strerror(code)):
                read()
    assert shard.instance(0).scale == ROWS[0].scale


@pytest.mark.parametrize("written_before", [0, 1, 40])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_fault_in_the_middle_is_the_disks_own(tmp_path, monkeypatch, written_before, code):
    """Whatever HDF5 makes of it, however much was written by then; no more rows are made."""
    writes, made = iter(range(10_000)), []

    def write(handle, data, at):
        if next(writes) >= written_before:
            raise OSError(code, os.strerror(code))
        return whole(handle, data[:5_000], at)  # as a disk may

    def rows():
        for row in ROWS * 20:
            made.append(row)
            yield row

    whole = os.pwrite
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", write)
        with pytest.raises(MachineFault, match="not written: ") as caught:
            write_shard(tmp_path / "train-00000.h5", rows(), ABOUT)
    assert isinstance(caught.value.__cause__, OSError)
    assert caught.value.__cause__.errno == code
    assert _leftovers(tmp_path) == []
    assert len(made) < 20
    write_shard(tmp_path / "train-00000.h5", ROWS, {**ABOUT, "seed": 1})  # HDF5 is as it was


@pytest.mark.parametrize("name", ["fsync", "replace", "write"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_failing_step_leaves_what_was_there(written, tmp_path, monkeypatch, name, code):
    path = tmp_path / "train-00000.h5"
    path.write_bytes(b"old")

    def fail(*_args):
        raise OSError(code, os.strerror(code))

    if name == "replace":
        monkeypatch.setattr(Path, "replace", fail)
    elif name == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    else:
        path = tmp_path / "full" / "train-00000.h5"
    with pytest.raises(ArticugenError, match="not written: ") as caught:
        write_shard(path, ROWS, ABOUT)
    assert "\n" not in str(caught.value)
    assert _leftovers(tmp_path) == ["train-00000.h5"]
    assert (tmp_path / "train-00000.h5").read_bytes() == b"old"


SCRIPT = """
import sys
sys.path.insert(0, {tests!r})
from test_shards import ABOUT, ROWS
from articugen.core.errors import ArticugenError
from articugen.store.writer import write_shard
from pathlib import Path
"""


def _script(rest: str) -> list[str]:
    head = SCRIPT.format(tests=str(Path(__file__).parent))
    return [sys.executable, "-c", head + rest]


WRITE = "try: write_shard(Path(sys.argv[1]), ROWS, ABOUT)\nexcept ArticugenError as e: print(e)"


def test_file_size_limit_is_one_sentence(tmp_path):
    limit = 50_000
    done = subprocess.run(
        [*_script(WRITE), str(tmp_path / "train-00000.h5")],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"} | NO_BYTECODE,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert "files may not grow so large here" in done.stdout
    assert _leftovers(tmp_path) == []


def test_full_disk_is_one_sentence(tmp_path):
    with small_disk(tmp_path / "disk", "64k") as disk:
        with pytest.raises(ArticugenError, match=r"the disk is full \(0\.\d MB are free\);"):
            write_shard(disk / "train-00000.h5", ROWS, ABOUT)
        assert _leftovers(disk) == []


def test_killed_while_writing(written, tmp_path):
    """Whenever the process dies, the final name is absent or a whole shard."""
    path = tmp_path / "train-00000.h5"
    loop = "print('go', flush=True)\nwhile True: write_shard(Path(sys.argv[1]), ROWS, ABOUT)"
    for moment in (0.01, 0.13, 20.0):
        process = subprocess.Popen([*_script(loop), str(path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        until = time.monotonic() + moment
        while time.monotonic() < until and not (moment > 1.0 and path.exists()):
            _assert_absent_or_whole(path, written[1].sha256)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        _assert_absent_or_whole(path, written[1].sha256)
    assert path.exists()
    left = [name for name in _leftovers(tmp_path) if name != path.name]
    assert {whole_name(name) for name in left} <= {path.name}
    write_shard(path, ROWS, ABOUT)  # what killed runs leave, the next one removes: journal.py
    assert _leftovers(tmp_path) == sorted([*left, path.name])


def _assert_absent_or_whole(path: Path, sha256: str) -> None:
    if path.exists():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
