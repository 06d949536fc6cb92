"""The header of a PLY file: what it claims to hold, examined before a library believes it."""

import re

MAX_HEADER_BYTES = 2**16


def claimed_rows(data: bytes) -> dict[str, int]:
    """Return how many rows of each element the header of a file claims, by the element's name.

    A row takes at least one byte a property, so that no header can claim more rows than the file
    has bytes.

    Raises:
        ValueError: there is no header, or it claims more than that.
    """
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    header = data[: end + 1].decode("ascii", "replace")
    if not header.startswith("ply"):
        raise ValueError("has no PLY header")
    claimed = {name: float(count) for name, count in re.findall(r"element (\w+) (\d+)", header)}
    if any(count > len(data) for count in claimed.values()):
        raise ValueError("its PLY header claims more than the file holds")
    return {name: int(count) for name, count in claimed.items()}
