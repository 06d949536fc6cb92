"""What the process does that `apart` starts: read one model and write it to its standard output."""

import io
import json
import os
import resource
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from articugen.core.errors import InvalidSource, MachineFault, machine_fault, printable
from articugen.core.processes import die_with


def main() -> None:
    """Answer the request on the standard input."""
    request = json.load(sys.stdin)
    die_with(request["parent"])
    _limit(resource.RLIMIT_CPU, request["seconds"])
    _limit(resource.RLIMIT_AS, request["memory"])
    _limit(resource.RLIMIT_CORE, 0)
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever OpenUSD prints
    answer.write(_answer(request))
    answer.close()
    os._exit(0)  # without taking the stage to pieces


def _limit(what: int, most: int) -> None:
    hard = resource.getrlimit(what)[1]
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    with suppress(OSError, ValueError):  # some systems have no such limit
        resource.setrlimit(what, (most, hard))


def _answer(request: dict[str, Any]) -> bytes:
    """Return a line of JSON, and behind it the arrays as .npz where it tells of a model."""
    from articugen.sources.usd import model  # noqa: PLC0415 - may find no memory

    path, root = Path(request["path"]), Path(request["root"])
    try:
        if request["only_hashed"]:
            return _line({"sha256": model.digest(path, root)})
        return _packed(model.read_model(path, root, with_meshes=request["with_meshes"]))
    except InvalidSource as error:
        return _line({"refused": str(error)})
    except MachineFault as error:
        return _line({"fault": str(error)})
    except MemoryError:
        return _line({"too_large": True})
    except Exception as error:
        fault = machine_fault(error)
        reason = printable(f"{type(error).__name__}: {error}")[:200]
        refused = f"{path}: cannot be read ({reason}); leave it out, or report it, please"
        return _line({"fault": str(fault)} if fault else {"refused": refused})


def _line(said: dict[str, Any]) -> bytes:
    return json.dumps(said).encode() + b"\n"


def _packed(made: Any) -> bytes:
    import numpy as np  # noqa: PLC0415 - not for a digest

    header = {
        "sha256": made.sha256,
        "notes": made.notes,
        "links": [[name, mesh is not None] for name, mesh in made.links],
        "joints": [
            {
                "name": joint.name,
                "kind": str(joint.kind),
                "parent": joint.parent,
                "child": joint.child,
                "T_parent_joint": joint.T_parent_joint.tolist(),
                "axis": joint.axis.tolist(),
                "lower": joint.lower,
                "upper": joint.upper,
            }
            for joint in made.joints
        ],
    }
    arrays = {}
    for number, (_, mesh) in enumerate(made.links):
        if mesh is not None:
            arrays[f"vertices_{number}"], arrays[f"faces_{number}"] = mesh.vertices, mesh.faces
    data = io.BytesIO()
    np.savez(data, **arrays)
    return _line(header) + data.getvalue()
