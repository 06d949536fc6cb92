"""Changes to files that are likely to find what a reader forgot; the same for the same seed."""

import json
import random
import re
import struct
from collections.abc import Sequence
from typing import Any

MOST_BYTES = 1 << 16
"""That an input grows to."""

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[\w.+-]+|\s+|.", re.DOTALL)
EXTREME = (
    *(b"0", b"-1", b"1", b"2", b"255", b"256", b"65536", b"2147483647", b"-2147483648"),
    *(b"4294967296", b"9223372036854775807", b"18446744073709551616", b"9" * 40, b"9" * 5000),
    *(b"1e308", b"1e309", b"-1e999", b"1e-320", b"nan", b"inf", b"-inf", b"0x10", b"1_000"),
    *(b"-0.0", b"0.1e", b"1e", b"."),
)
_STRANGE = (
    *(b"", b"\0", b"\n", b'"', b"'", b"<", b">", b"&", b"[]", b"{}", b"null", b"true", b"[", b"{"),
    *(b"..", b"../", b"/", b"\\", b"%00", b"%2e%2e%2f", b"\xff", b"\xc3", b"\xed\xa0\x80"),
    *(b"\xef\xbb\xbf", b"\xf0\x9f\x98\x80", b"\x1b[31m", b"\r", b"\x0b", b"\xe2\x80\xae", b"#"),
)
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 0.5, 2**31, 2**63, 2**64, 10**40, 1e308, -1e308, "", "x"),
    *(float("nan"), float("inf"), [], {}, [[]], [0], {"": 0}, "\0", "\ud800", "../x", "a" * 300),
    *("\n", "\x1b[31m", "0", "nan"),
)


def changed(
    rng: random.Random, data: bytes, others: Sequence[bytes], tokens: Sequence[bytes]
) -> bytes:
    """`data` after one to four changes.

    Args:
        others: inputs of the same kind, to take pieces from.
        tokens: words that mean something to the reader.
    """
    for _ in range(rng.choice((1, 1, 2, 4))):
        how = rng.choice(_HOW)
        data = how(rng, data, others, tokens)
    return data[:MOST_BYTES]


def _span(rng: random.Random, data: bytes, longest: int = 1 << 12) -> tuple[int, int]:
    first = rng.randint(0, len(data))
    return first, min(len(data), first + rng.randint(0, rng.choice((1, 4, 16, 64, longest))))


def _flip(rng: random.Random, data: bytes, *_: Any) -> bytes:
    if not data:
        return b"\0"
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]


def _cut(rng: random.Random, data: bytes, *_: Any) -> bytes:
    return data[: rng.randint(0, len(data))]


def _drop(rng: random.Random, data: bytes, *_: Any) -> bytes:
    first, end = _span(rng, data)
    return data[:first] + data[end:]


def _repeat(rng: random.Random, data: bytes, *_: Any) -> bytes:
    first, end = _span(rng, data)
    times = min(rng.choice((2, 3, 10, 300, 5000)), MOST_BYTES // max(end - first, 1))
    return data[:first] + data[first:end] * times + data[end:]


def _swap(rng: random.Random, data: bytes, *_: Any) -> bytes:
    (a, b), (c, d) = sorted((_span(rng, data), _span(rng, data)))
    c, d = max(c, b), max(d, b)
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _insert(rng: random.Random, data: bytes, _: Any, tokens: Sequence[bytes]) -> bytes:
    first, end = _span(rng, data, 16)
    piece = rng.choice((*tokens, *tokens, *_STRANGE))
    return data[:first] + piece + data[rng.choice((first, end)) :]


def _number(rng: random.Random, data: bytes, *_: Any) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    chosen = rng.choice(found)
    return data[: chosen.start()] + rng.choice(EXTREME) + data[chosen.end() :]


def _words(rng: random.Random, data: bytes, *_: Any) -> bytes:
    words = _WORD.findall(data[: 1 << 13])
    if len(words) < 2:
        return data
    a, b = rng.sample(range(len(words)), 2)
    words[a], words[b] = rng.choice(((words[b], words[a]), (words[b], words[b])))
    return b"".join(words) + data[1 << 13 :]


def _line(rng: random.Random, data: bytes, *_: Any) -> bytes:
    lines = data.split(b"\n")
    at, to = rng.randrange(len(lines)), rng.randrange(len(lines))
    line = lines[at] if rng.random() < 0.6 else lines.pop(at)
    lines.insert(to, line)
    return b"\n".join(lines)


def _splice(rng: random.Random, data: bytes, others: Sequence[bytes], _: Any) -> bytes:
    other = rng.choice(others)
    first, end = _span(rng, other)
    into, until = _span(rng, data)
    return data[:into] + other[first:end] + data[until:]


def _binary(rng: random.Random, data: bytes, *_: Any) -> bytes:
    """A number in the middle of a binary file."""
    form = rng.choice("BHIQfd")
    order = rng.choice("<<<>")
    if form in "fd":
        value: float = rng.choice((0.0, -1.0, 1e38, float("nan"), float("inf"), 1e-40))
    else:
        most = (1 << 8 * struct.calcsize("<" + form)) - 1
        value = rng.choice((0, 1, 2, most, most >> 1, (most >> 1) + 1, rng.randint(0, most)))
    piece = struct.pack(order + form, value)
    at = rng.randint(0, max(len(data) - len(piece), 0))
    return data[:at] + piece + data[at + len(piece) :]


def _json(rng: random.Random, data: bytes, others: Sequence[bytes], _: Any) -> bytes:
    """Another value somewhere in a document, or none, or one twice."""
    text = data.decode("latin-1")  # a byte a character, whatever follows the document
    first = min((i for i in (text.find("{"), text.find("[")) if i >= 0), default=-1)
    if first < 0:
        return _flip(rng, data)
    try:
        document, end = json.JSONDecoder().raw_decode(text, first)
    except (ValueError, RecursionError):
        return _words(rng, data)
    places = places_in(document)
    holder, key = rng.choice(places) if places else ([document], 0)
    act = rng.random()
    if act < 0.5:
        holder[key] = rng.choice(_VALUES)
    elif act < 0.6:
        del holder[key]
    elif act < 0.75:
        other_holder, other_key = rng.choice(places) if places else (holder, key)
        if other_holder is not holder or other_key != key:
            holder[key] = json.loads(json.dumps(_value(other_holder, other_key)))
    elif act < 0.85 and isinstance(holder, list):
        holder += [_value(holder, key)] * rng.choice((1, 2, 50))
    elif act < 0.95 and isinstance(holder, dict):
        holder[rng.choice((str(key) + "x", "", "__proto__", "é", "a" * 300))] = _value(holder, key)
    else:
        value = _value(holder, key)
        for _n in range(rng.choice((1, 20, 300))):
            value = [value]
        holder[key] = value
    try:
        changed = json.dumps(document)
    except (ValueError, RecursionError):  # it holds itself
        return data
    return (text[:first] + changed + text[end:]).encode("latin-1")


def _value(holder: Any, key: Any) -> Any:
    try:
        return holder[key]
    except (KeyError, IndexError):
        return None


def places_in(document: Any) -> list[tuple[Any, Any]]:
    """Everything that holds something, and by which key."""
    found: list[tuple[Any, Any]] = []
    waiting = [document]
    while waiting and len(found) < 2000:
        value = waiting.pop()
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in pairs:
            found.append((value, key))
            if isinstance(inner, dict | list):
                waiting.append(inner)
    return found


_HOW = (
    *(_flip, _flip, _cut, _drop, _repeat, _swap, _insert, _insert, _number, _number),
    *(_words, _line, _splice, _binary, _binary, _json, _json),
)
