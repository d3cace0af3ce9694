"""Draw `docs/top.webp`, the README's picture: a wooden top climbs onto its stem, as on its page (needs Chromium).

Run `python docs/hero.py`; it needs the extras `view` and `test`.
"""

import base64
import io
import shutil
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service

import tippe

#: Size of the picture in pixels, and its frames: times of the run [s], 25 per second.
WIDTH, HEIGHT = 720, 450
TIMES = np.linspace(0.9, 3.9, 150)

#: Number of still frames at the end.
REST = 25

FRAME = """
const stage = player.stages[0]; player.seek(arguments[0]);
return stage.renderer.domElement.toDataURL('image/webp', 1);
"""


def browser(*arguments: str) -> Chrome:
    """Chromium without a window; your arguments come last."""
    options = ChromeOptions()
    options.binary_location = shutil.which("chromium")
    drawn_by = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--window-size=1000,900",
        *drawn_by,
        *arguments,
    ):
        options.add_argument(argument)
    return Chrome(options=options, service=Service(shutil.which("chromedriver")))


def main() -> None:
    """Write the picture."""
    run = tippe.simulate(tippe.presets.classroom_scene(), tippe.Launch.degrees(theta=6, rpm=1900), 4.0, tolerance=1e-7)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "top.html"
        run.view(path)
        driver = browser()
        try:
            driver.get(path.as_uri())
            while not driver.execute_script("return !!window.player"):
                pass
            driver.execute_script(
                "player.play(false); player.seek(0); const stage = player.stages[0], { camera, controls } = stage;"
                "stage.show('arrows', 0, false); stage.show('arrows', 1, false);"
                f"stage.box.style.width = '{WIDTH}px'; stage.box.style.height = '{HEIGHT}px'; stage.resize();"
                "camera.position.sub(controls.target).multiplyScalar(0.72).add(controls.target);"
            )
            frames = [driver.execute_script(FRAME, float(time)) for time in TIMES]
        finally:
            driver.quit()
    pictures = [Image.open(io.BytesIO(base64.b64decode(frame.split(",")[1]))).convert("RGB") for frame in frames]
    pictures += REST * pictures[-1:]
    path = Path(__file__).with_name("top.webp")
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=40, loop=0, quality=72, method=4)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, {pictures[0].size}")


if __name__ == "__main__":
    main()
