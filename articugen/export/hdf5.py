"""HDF5 of others' layouts; our own shards have a stricter writer."""

import io
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import h5py
from numpy.typing import NDArray

from articugen.store.writer import Disk, new_hdf5


def packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a file of arrays by name; slashes in a name are groups."""
    data = io.BytesIO()
    with h5py.File(data, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array)
    return data.getvalue()


def stack(file: BinaryIO, count: int, rows: Iterator[Mapping[str, NDArray[Any]]]) -> None:
    """Write rows into one data set a name, (count, ...); OSError as the disk gave it, not HDF5."""
    disk = Disk(file)
    with new_hdf5(disk) as hdf5:
        stacks: dict[str, h5py.Dataset] = {}
        for index, row in enumerate(rows):
            for name, array in row.items():
                if name not in stacks:
                    shape, chunk = (count, *array.shape), (1, *array.shape)
                    stacks[name] = hdf5.create_dataset(
                        name, shape, array.dtype, chunks=chunk, compression=4
                    )
                stacks[name][index] = array
            if disk.fault is not None:
                break
