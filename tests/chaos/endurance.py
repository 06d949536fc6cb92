"""Whether memory stays flat over many instances: python -m tests.chaos.endurance [10000]

One object at so many states, next to nothing of each; prints the memory of the worker as it goes.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from articugen.core.memory import resident_bytes
from tests.chaos.commands import PYTHON, RECIPE
from tests.chaos.disk import ROOT


def main(instances: int) -> None:
    with tempfile.TemporaryDirectory(prefix="articugen-endurance-") as name:
        folder = Path(name)
        (folder / "recipe.yaml").write_text(RECIPE.format(objects=1))
        command = [*PYTHON, "generate", "-c", "eyeglasses", "-r", str(folder / "recipe.yaml")]
        command += ["--states", str(instances - 1), "-j", "1", "-o", name]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        with subprocess.Popen(command, cwd=ROOT, env=environment) as process:
            _watched(process, folder)
        sys.exit(process.returncode)


def _watched(process: "subprocess.Popen[bytes]", folder: Path) -> None:
    began, following = time.monotonic(), 0.0
    while process.poll() is None:
        time.sleep(0.2)
        spent = time.monotonic() - began
        if spent < following:
            continue
        following = spent + 10.0
        listed = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        held = resident_bytes([int(word) for word in listed.read_text().split()])
        written = sum(path.stat().st_size for path in folder.rglob("*.partial"))
        workers = ", ".join(f"{size / 1e6:.0f} MB" for size in held.values())
        sys.stdout.write(f"{spent:5.0f} s: {workers} held, {written / 1e6:.1f} MB written\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
