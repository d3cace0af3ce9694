"""A real browser without a network, for tests of pages and of JavaScript."""

import contextlib
import shutil
import time
from collections.abc import Iterator
from typing import Any

import pytest

BROWSER, DRIVER = (shutil.which(name) for name in ("chromium", "chromedriver"))

#: Tests with this mark need the browser.
needs_browser = pytest.mark.skipif(BROWSER is None or DRIVER is None, reason="no chromium with its chromedriver")


@contextlib.contextmanager
def open_browser(size: str = "500,500") -> Iterator[Any]:
    """A browser's driver; the browser is closed afterwards."""
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = BROWSER
    wanted = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader")
    for argument in (*wanted, "--enable-unsafe-swiftshader", f"--window-size={size}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = Chrome(options=options, service=Service(DRIVER))
    try:
        off = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
        driver.execute_cdp_cmd("Network.enable", {})
        driver.execute_cdp_cmd("Network.emulateNetworkConditions", off)
        yield driver
    finally:
        driver.quit()


def wait(driver: Any, script: str) -> None:
    """Wait until a script returns what counts as true."""
    until = time.monotonic() + 60.0
    while not driver.execute_script(script):
        assert time.monotonic() < until, driver.get_log("browser")
        time.sleep(0.05)
