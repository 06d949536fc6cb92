"""Inputs without end for one target: by atheris, which sees what they reach, or by chance."""

import contextlib
import importlib.util
import json
import mmap
import random
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.fuzz.mutations import MOST_BYTES, changed

if TYPE_CHECKING:
    from tests.fuzz.targets import Target

_HEAD = struct.Struct("<QI")
_INSTRUMENTED = (
    *("articugen", "collada", "trimesh.exchange", "yourdfpy", "yaml", "numpy.lib"),
    *("tarfile", "zipfile", "json"),
)
_NOT_INSTRUMENTED = ["articugen.core.jit", "articugen.core.portable"]
"""numba compiles these, and knows nothing of what atheris puts in."""


def has_atheris() -> bool:
    return importlib.util.find_spec("atheris") is not None


def instrumented(engine: str) -> AbstractContextManager[Any]:
    """Modules that are imported meanwhile tell atheris which lines they reach."""
    if engine != "atheris":
        return nullcontext()
    import atheris

    return atheris.instrument_imports(
        include=list(_INSTRUMENTED), exclude=_NOT_INSTRUMENTED, enable_loader_override=False
    )


class Progress:
    """What a process does, in a file that outlives it: how many inputs, and the one it is at."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(bytes(_HEAD.size + 2 * MOST_BYTES))
        with path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), 0)

    @property
    def executions(self) -> int:
        return _HEAD.unpack_from(self._map)[0]

    @property
    def data(self) -> bytes:
        size = _HEAD.unpack_from(self._map)[1]
        return self._map[_HEAD.size : _HEAD.size + size]

    def begin(self, data: bytes) -> None:
        """Note an input before it is read."""
        executions = self.executions + 1
        self._map[_HEAD.size : _HEAD.size + len(data)] = data
        _HEAD.pack_into(self._map, 0, executions, len(data))


@dataclass
class Findings:
    """Inputs that escaped: one file for each thing they do, and a line about it."""

    folder: Path
    keys: set[str] = field(default_factory=set)

    def add(self, key: str, sentence: str, data: bytes) -> None:
        if key in self.keys:
            return
        self.keys.add(key)
        name = f"{zlib.crc32(data):08x}"
        (self.folder / name).write_bytes(data)
        with (self.folder / "escapes.jsonl").open("a") as file:
            file.write(json.dumps({"key": key, "sentence": sentence[:2000], "file": name}) + "\n")

    def known(self) -> list[dict[str, str]]:
        path = self.folder / "escapes.jsonl"
        lines = path.read_text().splitlines() if path.exists() else []
        return list({said["key"]: said for said in map(json.loads, lines)}.values())


def inputs(target: "Target", seed: int) -> Iterator[bytes]:
    """The inputs to begin with, and then changed ones, the same for the same seed."""
    seeds = target.seeds()
    yield from seeds
    rng = random.Random(f"{target.name} {seed}")
    while True:
        yield changed(rng, rng.choice(seeds), seeds, target.tokens)


def by_chance(
    target: "Target", read: Callable[[bytes], None], *, seed: int, runs: int, seconds: float
) -> None:
    """Read inputs until there were so many, or so long."""
    until = time.monotonic() + seconds
    for number, data in enumerate(inputs(target, seed), 1):
        read(data)
        if number >= runs or time.monotonic() >= until:
            return


def by_atheris(
    target: "Target", read: Callable[[bytes], None], *, seed: int, runs: int, seconds: float
) -> None:
    """The same, but inputs that reach something new are kept, and changed again. Never returns."""
    import atheris

    seeds = target.seeds()
    folder = Path(tempfile.mkdtemp(prefix="articugen-corpus-"))
    for number, data in enumerate(seeds):
        (folder / f"{number:04d}").write_bytes(data)
    words = folder.with_name(f"{folder.name}.dict")
    words.write_text("".join(f'"{_escaped(token)}"\n' for token in target.tokens))

    def mutated(data: bytes, most: int, number: int) -> bytes:
        rng = random.Random(number)
        if rng.random() < 0.5:
            with contextlib.suppress(RuntimeError):
                return atheris.Mutate(data, most)
        return changed(rng, data, seeds, target.tokens)[:most]

    options = {"max_len": MOST_BYTES, "timeout": 0, "rss_limit_mb": 0, "seed": seed + 1}
    options |= {"runs": runs, "max_total_time": max(int(seconds), 1), "verbosity": 0}
    options |= {"detect_leaks": 0, "artifact_prefix": f"{folder}/"}
    arguments = [sys.argv[0], *(f"-{name}={value}" for name, value in options.items())]
    if target.tokens:
        arguments.append(f"-dict={words}")
    atheris.Setup([*arguments, str(folder)], read, custom_mutator=mutated)
    atheris.Fuzz()


def _escaped(token: bytes) -> str:
    return "".join(chr(b) if 32 <= b < 127 and b not in b'"\\' else f"\\x{b:02x}" for b in token)
