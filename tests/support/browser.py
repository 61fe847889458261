"""The real browser that the console is tested in: Debian's Chromium, without a GPU."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

_FLAGS = ("--no-sandbox", "--disable-background-networking")
_WEBGL_FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def chromium_path() -> Path | None:
    """Where Chromium is; None where it is not installed."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    return None if found is None else Path(found)


@contextmanager
def browser(path: Path, webgl: bool = True) -> Iterator[Browser]:
    """A running headless Chromium. With `webgl` all that it shows goes through a GPU made of software."""
    flags = (*_FLAGS, *(_WEBGL_FLAGS if webgl else ("--disable-gpu",)))
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=list(flags))
        try:
            yield chromium
        finally:
            chromium.close()
