"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

from articugen.meshes.obj_kernel import read_plain


def files() -> None:
    read_plain(b"v 0 0 0\nf 1 1 1\n", vertices=9, faces=9, line=99)
