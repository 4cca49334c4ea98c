"""Drives the installed Chromium with Playwright, to test the pages. Nothing is downloaded."""

import shutil
import time
from contextlib import contextmanager

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
MISSING = "no Chromium to open pages in: apt-get install chromium"


class Page:
    """A page opened from disk without a network."""

    def __init__(self, page):
        self.page = page
        """The page of Playwright."""
        self.said = []
        """Errors and warnings: from the console, exceptions and the browser's own log."""
        self.requests = []
        """Addresses the page requested from outside its own folder."""
        page.on("pageerror", lambda error: self.said.append(str(error)))
        page.on(
            "console", lambda message: message.type in ("error", "warning", "assert") and self.said.append(message.text)
        )
        page.on("request", lambda request: self._note(request.url))

    def _note(self, address):
        if not address.startswith(("file:", "data:", "blob:", "about:")):
            self.requests.append(address)

    def do(self, script):
        """Evaluate a JavaScript expression in the page, await it, and return its value."""
        return self.page.evaluate(script)

    def wait(self, condition, seconds=60.0):
        """Wait until a JavaScript condition is true; raises AssertionError after ``seconds``."""
        # not Playwright's wait_for_function, which the pages' security policy forbids
        end = time.monotonic() + seconds
        while not self.do(condition):
            assert time.monotonic() < end, f"not within {seconds} s: {condition}; messages of the page: {self.said}"
            self.page.wait_for_timeout(50)

    def open(self, path):
        """Open a file and wait until it is loaded."""
        self.said.clear()
        self.page.goto(path.resolve().as_uri())

    def show(self, folder, text):
        """Write a page into a folder and open it."""
        path = folder / "report.html"
        path.write_text(text)
        self.open(path)

    def size(self, width, height, dark=False):
        """Set the size of the window in pixels, and whether the system prefers a dark theme."""
        self.page.set_viewport_size({"width": width, "height": height})
        self.page.emulate_media(color_scheme="dark" if dark else "light", media="null")

    def press(self, key):
        """Press and release a key."""
        self.page.keyboard.press(key)

    def click(self, x, y):
        """Click the left button at a position in the window, in pixels."""
        self.page.mouse.click(x, y)

    def violations(self):
        """Return what axe-core finds against WCAG 2.2 AA and its best practices: rule, help and elements."""
        from axe_playwright_python.sync_playwright import Axe

        found = Axe().run(self.page).response["violations"]
        return [f"{one['id']}: {one['help']}: {[node['html'][:200] for node in one['nodes'][:5]]}" for one in found]

    def overflow(self):
        """Return by how many pixels the page is wider than its window."""
        return float(self.do("document.documentElement.scrollWidth - document.documentElement.clientWidth"))


@contextmanager
def chromium():
    """Start the installed browser with an empty profile and yield its page."""
    from playwright.sync_api import sync_playwright

    assert CHROMIUM is not None
    with sync_playwright() as playwright:
        flags = ["--disable-dev-shm-usage", "--disable-gpu", "--disable-component-update"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        try:
            context = browser.new_context(offline=True)
            context.set_default_timeout(300_000)  # [ms]; a loaded machine is no fault of a page
            yield Page(context.new_page())
        finally:
            browser.close()
