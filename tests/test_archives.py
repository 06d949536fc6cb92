"""Archives that strangers pack: what is unpacked, and what is refused before a byte is written."""

import gzip
import io
import stat
import struct
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

import pytest

from articugen.core.errors import InvalidSource, MachineFault
from articugen.sources.fetch import archives
from articugen.sources.fetch.archives import unpack
from tests.published import model_files, zipped
from tests.trouble import small_disk

MODEL = model_files()


@pytest.fixture
def outside(tmp_path):
    """A folder to unpack into, and all there is outside of it afterwards."""
    into = tmp_path / "into"
    into.mkdir()
    yield into
    assert {p.name for p in tmp_path.iterdir()} <= {"into", "a.zip", "a.tar.gz"}


def tarred(files, *more: tarfile.TarInfo, folder: str = "") -> bytes:
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:gz") as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(f"{folder}{name}")
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
        for info in more:
            archive.addfile(info, io.BytesIO(b"x" * info.size))
    return data.getvalue()


def all_of(path: Path, into: Path) -> dict[str, dict[str, bytes]]:
    """What unpacking gives: the files of each model, by its folder in the archive."""
    return {
        str(model.root): {n: (model.folder / n).read_bytes() for n in model.sizes}
        for model in unpack(path, into, lambda *_: True)
    }


def assert_refused(
    path: Path, data: bytes, into: Path, sentence: str, *, untouched: bool = True
) -> None:
    """An archive of these bytes is refused in a sentence that names it, before a byte is written
    unless it is its content that is damaged."""
    path.write_bytes(data)
    with pytest.raises(InvalidSource, match=sentence) as caught:
        all_of(path, into)
    assert str(path) in str(caught.value)
    assert not (untouched and list(into.iterdir()))


@pytest.mark.parametrize("pack", [zipped, tarred])
@pytest.mark.parametrize("folder", ["", "7128/", "./dataset/7128/", 9 * f"{60 * 'long'}/"])
def test_a_model_comes_out_as_it_went_in(tmp_path, outside, pack, folder):
    path = tmp_path / "a.zip"
    path.write_bytes(pack(MODEL, folder=folder))
    assert all_of(path, outside) == {str(PurePosixPath(folder)): MODEL}


@pytest.mark.parametrize("pack", [zipped, tarred])
def test_of_many_models_each_has_its_own_and_what_lies_beside_them_stays(tmp_path, outside, pack):
    files = {f"data/oven/{k}/{name}": data for k in "12" for name, data in MODEL.items()}
    files |= {"data/README.md": b"hello", "__MACOSX/data/oven/1/._mobility.urdf": b"x"}
    path = tmp_path / "a.zip"
    path.write_bytes(pack(files | {"data/oven/1/.DS_Store": b"x"}))
    assert all_of(path, outside) == {"data/oven/1": MODEL, "data/oven/2": MODEL}


HOSTILE = {
    "../out.obj": "leads out of the folder",
    "m/../../out.obj": "leads out of the folder",
    "/etc/out.obj": "is an absolute name",
    "C:/out.obj": "is an absolute name",
    "..\\out.obj": "has a backslash",
    "m/a\x1b[2J.obj": "a control character",
    "m/" + 40 * "d/" + "a.obj": "has too long a name",
    "m/" + 300 * "d": "has too long a name",
    "mobility.urdf/a": "is a file and a folder",
}


@pytest.mark.parametrize("pack", [zipped, tarred])
@pytest.mark.parametrize("name", HOSTILE)
def test_one_hostile_name_and_nothing_is_written(tmp_path, outside, pack, name):
    assert_refused(tmp_path / "a.zip", pack({**MODEL, name: b"x"}), outside, HOSTILE[name])


def link(name: str, kind: bytes, to: str = "/etc/passwd") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, to
    return info


ODD = "is a link, a device, encrypted or packed in an unusual way"


@pytest.mark.parametrize(
    "entry",
    [
        link("m", tarfile.SYMTYPE),
        link("m", tarfile.LNKTYPE, "mobility.urdf"),
        link("m", tarfile.CHRTYPE),
        link("m", tarfile.FIFOTYPE),
        link("m", tarfile.GNUTYPE_SPARSE),
    ],
)
def test_links_and_devices_in_a_tar_are_refused(tmp_path, outside, entry):
    assert_refused(tmp_path / "a.tar.gz", tarred(MODEL, entry), outside, ODD)


@pytest.mark.parametrize("mode", [stat.S_IFLNK, stat.S_IFIFO])
def test_links_and_devices_in_a_zip_are_refused(tmp_path, outside, mode):
    path = tmp_path / "a.zip"
    path.write_bytes(zipped(MODEL))
    info = zipfile.ZipInfo("m")
    info.external_attr = (mode | 0o777) << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(info, "/etc/passwd")
    assert_refused(path, path.read_bytes(), outside, ODD)


def test_a_name_of_no_letters_is_the_folder_itself(tmp_path, outside):
    data = bytearray(zipped({"x": b"", **MODEL}))
    at = data.index(b"PK\1\2")
    data[at + 28 : at + 30] = b"\0\0"  # the length of its name
    del data[at + 46]
    end = data.rindex(b"PK\5\6")
    size = struct.unpack_from("<I", data, end + 12)[0]
    struct.pack_into("<I", data, end + 12, size - 1)
    (tmp_path / "a.zip").write_bytes(data)
    assert all_of(tmp_path / "a.zip", outside) == {".": MODEL}


@pytest.mark.parametrize("suffix", ["zip", "tar.gz"])
def test_a_bomb_is_refused_before_it_goes_off(tmp_path, outside, suffix):
    zeros = MODEL | {f"m{k}.obj": bytes(2**26) for k in range(2)}
    packed = io.BytesIO()
    if suffix == "zip":
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in zeros.items():
                archive.writestr(name, data)
    data = packed.getvalue() or tarred(zeros)
    assert len(data) < 2**19
    reason = "unpacks to more than 200 times its size"
    assert_refused(tmp_path / f"a.{suffix}", data, outside, reason)


def header(kind: bytes, data: bytes = b"") -> bytes:
    """A header that tells more of the next entry of a tar."""
    info = tarfile.TarInfo("more")
    info.type, info.size = kind, len(data)
    return info.tobuf(tarfile.USTAR_FORMAT) + data + bytes(-len(data) % 512)


@pytest.mark.parametrize(
    "headers",
    [
        header(tarfile.XHDTYPE) * 4000,
        header(tarfile.GNUTYPE_LONGNAME, b"m\0") * 4000,
        header(tarfile.XGLTYPE, b"9 a=1234\n") * 4000,
        header(tarfile.XHDTYPE, b"5 aaa" * 200_000),  # the square of its length, by tarfile
        header(tarfile.XHDTYPE, b"9" * 5000 + b" path=m\n"),
        header(tarfile.XHDTYPE, b"9" * 20 + b" path=m\n"),  # an OverflowError, of `re`
        header(tarfile.XHDTYPE, b"5014 size=" + b"9" * 5003 + b"\n"),
        header(tarfile.XHDTYPE, b"11 size=-1\n"),
        header(tarfile.XHDTYPE, b"22 GNU.sparse.major=1\n"),
    ],
    ids=["pax", "gnu", "global", "long", "digits", "index", "size", "no size", "sparse"],
)
def test_headers_before_a_file_that_claim_too_much_are_refused(tmp_path, outside, headers):
    data = gzip.compress(headers + gzip.decompress(tarred(MODEL)))
    reason = "is damaged|has more than|unusual way"
    assert_refused(tmp_path / "a.tar.gz", data, outside, reason)


def test_a_tar_of_which_one_header_is_damaged_is_no_shorter_one(tmp_path, outside):
    image = bytearray(gzip.decompress(tarred(MODEL)))
    image[image.rindex(b"textured_objs/a.obj")] ^= 1
    assert_refused(tmp_path / "a.tar.gz", gzip.compress(bytes(image)), outside, "is damaged")


@pytest.mark.parametrize("below", ["", 9 * "d/"])
def test_more_names_than_an_archive_of_its_size_can_mean_are_refused(
    tmp_path, outside, monkeypatch, below
):
    """Each costs memory and time, folders too of which only the names of files tell."""
    monkeypatch.setattr(archives, "_ALWAYS_FILES", 1000)
    files = {f"{k}/{below}a.obj": b"" for k in range(2000)}
    reason = "holds more than .* files and folders, or"
    assert_refused(tmp_path / "a.tar.gz", tarred(MODEL | files), outside, reason)


def encrypted(data: bytes) -> bytes:
    """The same .zip with every entry marked as encrypted."""
    for mark, place in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        start = 0
        while (start := data.find(mark, start)) >= 0:
            flags = struct.unpack_from("<H", data, start + place)[0] | 1
            data = data[: start + place] + struct.pack("<H", flags) + data[start + place + 2 :]
            start += 4
    return data


def gigabyte_of_header() -> bytes:
    """A tar whose header claims a gigabyte of itself."""
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XHDTYPE, 2**30
    return info.tobuf(tarfile.USTAR_FORMAT) + bytes(2**22)


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "is no .zip or .tar.gz"),
        (b"<html>log in</html>", "is no .zip or .tar.gz"),
        (zipped(MODEL)[:-30], "is damaged"),
        (zipped(MODEL).replace(b"v 1 0 0", b"v 2 0 0"), "is damaged"),
        (tarred(MODEL)[:-300], "is damaged"),
        (gzip.compress(b"no tar" * 1000, mtime=0), "is damaged"),
        (gzip.compress(gigabyte_of_header(), mtime=0), "is damaged"),
        (encrypted(zipped(MODEL)), ODD),
        (zipped({**MODEL, "./mobility.urdf": b"<robot/>"}), "is there twice"),
        (zipped({**MODEL, "m_evil": b"x"}).replace(b"m_evil", b"m\0evil"), "a control character"),
        (zipped({"README.md": b"x"}), "holds no URDF and no motion_attributes.json"),
    ],
    # Bytes as a name would tell the second they were packed in.
    ids=["empty", "page", "cut zip", "changed zip", "cut tar", "no tar", "gigabyte",
         "encrypted", "twice", "nul", "no model"],
)  # fmt: skip
def test_what_is_no_sound_archive_of_models_is_told(tmp_path, outside, data, sentence):
    assert_refused(tmp_path / "a.zip", data, outside, sentence, untouched=False)


def test_a_disk_that_is_too_small_is_told_before_it_is_full(tmp_path):
    path = tmp_path / "a.zip"
    path.write_bytes(zipped({**MODEL, "large.bin": bytes(2**20)}))
    with (
        small_disk(tmp_path / "disk", "512k") as disk,
        pytest.raises(
            MachineFault, match=r"1\.1 MB are to be unpacked from a\.zip and 0\.5 MB are free"
        ),
    ):
        list(unpack(path, disk, lambda *_: True))
