"""A real browser without a window, for tests of pages: Debian's chromium, driven by playwright."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

LAPTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


@contextmanager
def browser() -> Iterator[Any]:
    """A browser with an empty profile; the test is skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            yield opened
        finally:
            opened.close()


def alone(chromium: Any, screen: dict[str, int], *known: str, **context: Any) -> tuple[Any, list]:
    """A tab, and its `faults_of`; those before it are shut, or what plays there is drawn on."""
    for before in chromium.contexts:
        before.close()
    tab = chromium.new_context(viewport=screen, **context).new_page()
    tab.set_default_timeout(90_000)
    return tab, faults_of(tab, *known)


def faults_of(tab: Any, *known: str) -> list[str]:
    """What will be found wrong with a page: errors of its console and its scripts, dialogs, and
    what it asks of the net, but for addresses that begin with one of those that are known."""
    faults: list[str] = []
    known = (*known, "file:", "data:", "blob:")
    tab.on("console", lambda m: faults.append(m.text) if m.type == "error" else None)
    tab.on("pageerror", lambda error: faults.append(str(error)))
    tab.on("dialog", lambda dialog: (faults.append(dialog.message), dialog.dismiss()))
    for event in ("request", "websocket"):
        tab.on(event, lambda r: None if r.url.startswith(known) else faults.append(r.url))
    return faults
