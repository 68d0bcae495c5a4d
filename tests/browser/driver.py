# SPDX-License-Identifier: MIT
"""A headless Chromium for tests of pages that open from disk."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
import pytest

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
)
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Browser flags for WebGL in software."""
_ADVICE = ("willReadFrequently", "GPU stall due to ReadPixels")
WAIT_S = 60.0
"""Longest wait for the page (s); an action of one second may take tens of seconds on a busy machine."""


def find_browser() -> tuple[str, str]:
    """Paths of Chromium and its driver; skips the test if one of them or selenium is absent."""
    pytest.importorskip("selenium", reason="selenium is not installed (extra `dev`)")
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("no Chromium to drive (Debian: apt-get install chromium chromium-driver)")
    return browser, driver


@contextmanager
def open_browser(
    profile: Path,
    width: int = 1500,
    height: int = 1000,
    logs_requests: bool = True,
    flags: tuple[str, ...] = (),
) -> Iterator[Chrome]:
    """A browser with an empty profile in ``profile``; closed at the end.

    :meth:`Page.requested` needs ``logs_requests``, which makes the browser keep all loaded text: disable it
    to measure memory.
    """
    browser, driver_path = find_browser()
    from selenium.webdriver import Chrome, ChromeOptions, ChromeService

    options = ChromeOptions()
    options.binary_location = browser
    for flag in (*_FLAGS, *flags, f"--user-data-dir={profile}", f"--window-size={width},{height}"):
        options.add_argument(flag)
    logs = {"browser": "ALL", **({"performance": "ALL"} if logs_requests else {})}
    options.set_capability("goog:loggingPrefs", logs)
    driver = Chrome(options=options, service=ChromeService(driver_path))
    try:
        driver.set_page_load_timeout(WAIT_S)
        driver.set_script_timeout(WAIT_S)
        yield driver
    finally:
        driver.quit()


class Page:
    """A page under test: user input, and displayed values."""

    def __init__(self, driver: Chrome):
        self.driver = driver
        self.requests: list[str] = []

    def open(self, path: Path, fragment: str = "") -> None:
        self.driver.get(path.absolute().as_uri() + fragment)
        self.wait("return document.documentElement.dataset.ready === 'true'")

    def go(self, fragment: str) -> None:
        """Follow a link inside the page and wait until its views are shown."""
        self.run("location.hash = arguments[0]", fragment)
        if fragment.startswith("#view/"):
            self.wait_for_view(re.split(r"[@?]", fragment.removeprefix("#view/"))[0])

    def wait_for_view(self, key: str) -> None:
        ready = (
            "return document.getElementById('viewer').dataset.ready === 'true' && "
            "document.getElementById('configuration').value + '/' + document.getElementById('view').value"
            " === arguments[0]"
        )
        self.wait(ready, key)

    def run(self, script: str, *arguments: Any) -> Any:
        return self.driver.execute_script(script, *arguments)

    def wait(self, script: str, *arguments: Any) -> Any:
        return self.until(lambda: self.run(script, *arguments), script)

    def until(self, condition: Callable[[], Any], what: str, longest_s: float = WAIT_S) -> Any:
        from selenium.webdriver.support.ui import WebDriverWait

        return WebDriverWait(self.driver, longest_s, 0.05).until(lambda _: condition(), what)

    def keys(self, *keys: str, to: str = "#panels") -> None:
        """Press keys while the element with the CSS selector ``to`` is focused."""
        from selenium.webdriver.common.by import By

        self.driver.find_element(By.CSS_SELECTOR, to).send_keys(*keys)

    def hover(self, buffer: str, x: int, y: int, click: bool = False) -> None:
        """Move the real pointer over pixel (x, y) of a buffer's picture; ``click`` also clicks it."""
        from selenium.webdriver import ActionChains
        from selenium.webdriver.common.by import By

        canvas = self.driver.find_element(By.CSS_SELECTOR, f'#panels canvas[data-buffer="{buffer}"]')
        self.run("arguments[0].scrollIntoView({block: 'center'})", canvas)
        width, height = self.run("return [arguments[0].clientWidth, arguments[0].clientHeight]", canvas)
        size = self.run("return REPORT.viewer.frame()")
        scale = min(width / size["width"], height / size["height"]) * size["zoom"]
        at = [(x + 0.5 - size["x"]) * scale, (y + 0.5 - size["y"]) * scale]
        actions = ActionChains(self.driver).move_to_element_with_offset(canvas, round(at[0]), round(at[1]))
        (actions.click() if click else actions).perform()

    def values(self, buffer: str) -> list[float]:
        """Displayed values of a buffer at the pixel under the cursor."""
        texts = self.run(
            "return [...document.querySelectorAll(`#values tr[data-buffer='${arguments[0]}'] .value`)]"
            ".map((n) => n.textContent)",
            buffer,
        )
        return [float(text) for text in texts]

    def console(self) -> list[str]:
        """Console messages of warning level or above since the last call, without performance advice about
        reading pixels back (caused by the tests) and software GL."""
        return [
            entry["message"]
            for entry in self.driver.get_log("browser")
            if entry["level"] in ("WARNING", "SEVERE")
            and not any(advice in entry["message"] for advice in _ADVICE)
        ]

    def requested(self) -> list[str]:
        """Addresses of all requests of the page so far."""
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
        return self.requests

    def screenshot(self, path: Path) -> None:
        self.driver.save_screenshot(str(path))

    def _renderers(self, what: Callable[[psutil.Process], float]) -> float:
        """Sum of ``what`` over the page's renderer processes, including the browser's one or two spare
        ones."""
        total, num = 0.0, 0
        for process in psutil.Process(self.driver.service.process.pid).children(recursive=True):
            try:
                if "--type=renderer" in process.cmdline():
                    total += what(process)
                    num += 1
            except psutil.Error:
                continue  # the process has just ended
        assert num > 0
        return total

    def memory_mb(self) -> float:
        """Unshared memory (MB) of all renderer processes."""
        return self._renderers(lambda process: process.memory_full_info().uss / 1e6)

    def processor_s(self) -> float:
        """Processor seconds of the renderer processes, independent of other load."""
        return self._renderers(lambda process: sum(process.cpu_times()[:2]))
