"""The words of the project: docstrings, names, messages and pages; CONTRIBUTING.md has the rules.

`LEFT` counts the offenders of each kind that are still there. A number may only fall: who mends
some lowers it in the same commit.
"""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
FILES = sorted((CHECKOUT / "articugen").rglob("*.py"))
PAGES = sorted(
    {*(CHECKOUT / "docs").rglob("*.md"), CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md"}
)

LEFT = {"clause": 0, "article": 0, "type": 0, "name": 19, "dialect": 1}

CLAUSES = {
    "What", "Of", "How", "Whether", "Where", "Whose", "That", "Those", "For", "As", "In", "Which",
    "Who", "When", "Why", "All", "Everything",
}  # fmt: skip
"""First words of no docstring of a function or a type."""
ARTICLES = {"The", "A", "An", "One", "Each", "Every", "("}
"""First words of no docstring of a function: it says what it is instead of what it does."""
NAMES = {
    "told", "said", "seen", "held", "own", "mine", "each", "found", "made", "asked", "given",
}  # fmt: skip
"""Names of no variable, parameter or attribute: participles, which name nothing."""
DIALECT = re.compile(
    r"\b(anew|afresh|go(?:es)? on where|look(?:s|ed|ing)? at|tells?|told|is said|so many"
    r"|one's own|at hand|from (?:it|them|him) on|what lies|in the place of|as it were)\b",
    re.IGNORECASE,
)
"""What a stranger would have to decode."""

Def = ast.FunctionDef | ast.AsyncFunctionDef
PROPERTY = re.compile("property|contextmanager")


@cache
def tree(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text("utf-8"))))


def nodes(kind: type | tuple[type, ...]) -> Iterator[tuple[str, ast.AST]]:
    for path in FILES:
        for node in tree(path):
            if isinstance(node, kind):
                yield f"{path.relative_to(CHECKOUT)}:{getattr(node, 'lineno', 0)}", node


def first_word(node: ast.AST) -> str:
    assert isinstance(node, Def | ast.ClassDef)
    word = re.match(r"\(|\w+", ast.get_docstring(node) or "")
    return word[0] if word else ""


def is_noun(node: ast.AST) -> bool:
    """Return whether a function is used as a noun: a property, or what `with` enters."""
    return any(PROPERTY.search(ast.unparse(d)) for d in getattr(node, "decorator_list", ()))


def clauses() -> list[str]:
    found = nodes((ast.FunctionDef, ast.AsyncFunctionDef))
    return [where for where, node in found if first_word(node) in CLAUSES]


def articles() -> list[str]:
    found = nodes((ast.FunctionDef, ast.AsyncFunctionDef))
    return [w for w, node in found if first_word(node) in ARTICLES and not is_noun(node)]


def types() -> list[str]:
    return [where for where, node in nodes(ast.ClassDef) if first_word(node) in CLAUSES]


def names() -> list[str]:
    """Return where a banned name is bound: assigned, a parameter, an attribute."""
    bound = []
    for where, node in nodes((ast.Name, ast.arg, ast.Attribute)):
        name = getattr(node, "id", None) or getattr(node, "arg", None) or getattr(node, "attr", "")
        if name in NAMES and isinstance(getattr(node, "ctx", ast.Store()), ast.Store):
            bound.append(f"{where} {name}")
    return bound


def dialect() -> list[str]:
    """Return where docstrings, messages and other texts of the package use dialect."""
    return [
        f"{where} {word}"
        for where, node in nodes(ast.Constant)
        if isinstance(getattr(node, "value", None), str)
        for word in DIALECT.findall(node.value)  # type: ignore[attr-defined]
    ]


KINDS = {
    "clause": clauses, "article": articles, "type": types, "name": names, "dialect": dialect,
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_words_only_become_plainer(kind: str) -> None:
    offenders = KINDS[kind]()
    rooms = Counter(where.split("/")[1] for where in offenders)
    assert len(offenders) <= LEFT[kind], f"{rooms}\n" + "\n".join(offenders)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_pages_are_in_plain_words(path: Path) -> None:
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", path.read_text("utf-8"), flags=re.DOTALL)
    assert DIALECT.findall(prose) == []


def test_the_manual_is_no_longer_than_a_short_book() -> None:
    pages = (CHECKOUT / "docs").rglob("*.md")
    assert sum(len(path.read_text("utf-8").split()) for path in pages) <= 30_000


def test_what_the_rules_look_for_is_what_they_find(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "articugen" / "room.py"
    path.parent.mkdir()
    path.write_text(
        'class A:\n    """What is there."""\n\n'
        'def f(told):\n    """The answer."""\n    own = told\n    return own\n\n'
        'def g(x):\n    """Whether x is looked at anew."""\n    x.seen = 1\n    x.told()\n\n'
        'def h():\n    """Return it."""\n'
    )
    monkeypatch.setitem(globals(), "CHECKOUT", tmp_path)
    monkeypatch.setitem(globals(), "FILES", [path])
    assert {kind: len(rule()) for kind, rule in KINDS.items()} == {
        "clause": 1, "article": 1, "type": 1, "name": 3, "dialect": 2,
    }  # fmt: skip
