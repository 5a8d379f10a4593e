"""Chromium with WebGL in software, on a page that is served."""

from __future__ import annotations

import base64
import io
import time
from contextlib import contextmanager

import numpy as np
from PIL import Image

from ..bench import browser

CHROMIUM = browser.CHROMIUM
FLAGS = (
    *(flag for flag in browser.FLAGS if flag != "--disable-gpu"),
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)


@contextmanager
def served_page(folder, url):
    """A page of a browser, at an address."""
    before, browser.FLAGS = browser.FLAGS, FLAGS
    try:
        with browser.chromium(folder) as page:
            go(page, url)
            yield page
    finally:
        browser.FLAGS = before


def go(page, url):
    page.open(url, 800, 600)


def screenshot(page):
    """What the page shows, [H, W, 3]."""
    data = base64.b64decode(page.call("Page.captureScreenshot")["data"])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def waits_for(condition, seconds=30.0):
    """Whether something comes true in time."""
    until = time.monotonic() + seconds
    while not (answer := condition()) and time.monotonic() < until:
        time.sleep(0.1)
    return answer


def text(page):
    return page.run("document.body.innerText")


def click_text(page, words, tag):
    """Click the last element that has just these words."""
    page.run(
        f"[...document.querySelectorAll({tag!r})]"
        f".filter(e => e.innerText === {words!r}).at(-1).click()"
    )


def toggle(page, label):
    """Click the checkbox that stands beside a label."""
    page.run(
        "(() => { let e = [...document.querySelectorAll('*')]"
        f".filter(e => e.innerText === {label!r}).at(-1);"
        " while (!e.querySelector('input[type=checkbox]')) e = e.parentElement;"
        " e.querySelector('input[type=checkbox]').click(); })()"
    )
