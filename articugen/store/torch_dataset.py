"""Data sets and streams for torch's DataLoader: the only file of the store that imports torch."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from articugen.core.errors import MissingExtra
from articugen.store.rows import in_units, is_scaled

try:
    import torch
    from torch.utils.data import Dataset, IterableDataset, get_worker_info
except ImportError:
    raise MissingExtra("torch", "ppd") from None

Sample = dict[str, Any]


class TorchDataSet(Dataset):
    """Instances as dicts of tensors; see `DataSet.torch`. It can be sent to worker processes."""

    def __init__(self, data: Any, fields: tuple[str, ...], points: int | None) -> None:
        self.data, self.fields, self.points = data, fields, points

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> Sample:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Several at once, as a DataLoader asks for them."""
        seed = int(torch.randint(2**62, ()))
        batch = self.data.batch(indices, self.fields, points=self.points, rng=seed)
        tensors = {name: _tensor(array) for name, array in batch.items()}
        return [{name: array[n] for name, array in tensors.items()} for n in range(len(indices))]

    def __repr__(self) -> str:
        points = "all" if self.points is None else self.points
        return f"TorchDataSet({len(self):,} instances, {', '.join(self.fields)}, {points} points)"


class TorchStream(IterableDataset):
    """Instances without end as dicts of tensors; see `Stream.torch`. Each iteration begins where
    `rows` was, or where `load_state_dict` says, as torchdata's StatefulDataLoader has it."""

    def __init__(self, rows: Any, fields: tuple[str, ...]) -> None:
        self.rows, self.fields = rows, fields
        self._here, self._state = rows, None

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        self._here = self.rows.part(*((worker.id, worker.num_workers) if worker else (0, 1)))
        if self._state is not None:
            self._here.load_state_dict(self._state)
        return ({n: _of_row(n, row.stored(n)) for n in self.fields} for row in self._here)

    def state_dict(self) -> dict[str, Any]:
        return self._here.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._state = state


def _of_row(name: str, stored: Any) -> Any:
    """Return a field of a row as a tensor; of text, the text."""
    if isinstance(stored, str | tuple):
        return stored
    return _tensor(in_units(name, stored) if is_scaled(name) else np.array(stored))


def _tensor(array: NDArray[Any]) -> Any:
    """Torch's like of an array; of text, which it has none for, the array's lists."""
    if array.dtype.kind == "U":
        return array.tolist()
    if array.dtype == np.float64:
        return torch.from_numpy(array.astype(np.float32))
    if array.dtype.kind == "u" and array.dtype.itemsize > 1:
        return torch.from_numpy(array.astype(np.int64))
    return torch.from_numpy(array)
