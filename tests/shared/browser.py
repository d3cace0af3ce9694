"""A real browser without a network, for tests of pages and of JavaScript."""

import contextlib
import shutil
import time
from collections.abc import Iterator
from typing import Any

import pytest

BROWSER, DRIVER = (shutil.which(name) for name in ("chromium", "chromedriver"))

#: How it draws on a processor: stages by WebGL, all else without it, which takes a hundred times as long (half a minute for the
#: first picture of a page). Pages that play by themselves do not where less motion is asked for.
DRAWING = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-rasterization",
    "--disable-accelerated-2d-canvas",
    "--disable-gpu-compositing",
    "--force-prefers-reduced-motion",
)

#: Tests with this mark need the browser.
needs_browser = pytest.mark.skipif(BROWSER is None or DRIVER is None, reason="no chromium with its chromedriver")


@contextlib.contextmanager
def open_browser(size: str = "500,500") -> Iterator[Any]:
    """A browser's driver; the browser is closed afterwards."""
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = BROWSER
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", *DRAWING, f"--window-size={size}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = Chrome(options=options, service=Service(DRIVER))
    try:
        network = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
        driver.execute_cdp_cmd("Network.enable", {})
        driver.execute_cdp_cmd("Network.emulateNetworkConditions", network)
        yield driver
    finally:
        driver.quit()


def wait(driver: Any, script: str) -> None:
    """Wait until a script returns what counts as true."""
    deadline = time.monotonic() + 60.0
    while not driver.execute_script(script):
        assert time.monotonic() < deadline, driver.get_log("browser")
        time.sleep(0.05)


def complaints(driver: Any) -> list[dict[str, Any]]:
    """What a browser's console has complained of since it was last asked; how a processor draws is not the page's fault."""
    entries = [entry for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    return [entry for entry in entries if "GL Driver Message" not in entry["message"]]
