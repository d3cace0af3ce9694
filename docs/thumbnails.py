"""Draw the gallery's thumbnails, `docs/gallery/*.webp`: figures, and the scenes of pages (needs Chromium).

Run `python docs/thumbnails.py [NAME ...]`; it needs the extras `view` and `test`.
"""

import base64
import io
import runpy
import sys
import tempfile
from pathlib import Path
from typing import Any

from hero import browser
from PIL import Image, ImageOps

HERE = Path(__file__).parent

#: Size of a thumbnail in pixels, and the displayed time of the run [s].
SIZE, HALFWAY = (480, 300), 3.0

#: Script that draws the scene of a page at a given time.
DRAW = """
const [time, done] = arguments;
views.ready.then((player) => {
  player.play(false);
  player.seek(time);
  done(player.stages[0].renderer.domElement.toDataURL("image/png"));
});
"""


def scene(page: Any) -> bytes:
    """The scene that a page shows in a browser."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        path.write_text(page.html)
        driver = browser("--window-size=500,600", "--force-prefers-reduced-motion")
        try:
            driver.get(path.as_uri())
            driver.set_script_timeout(120.0)
            return base64.b64decode(driver.execute_async_script(DRAW, HALFWAY).partition(",")[2])
        finally:
            driver.quit()


def main(names: list[str]) -> None:
    """Write the thumbnail of each example that draws."""
    for path in sorted((HERE.parent / "examples").glob("*.py")):
        if "def draw(" not in path.read_text() or (names and path.stem not in names):
            continue
        picture = runpy.run_path(str(path))["draw"]()
        if hasattr(picture, "savefig"):
            memory = io.BytesIO()
            picture.savefig(memory, dpi=100)
            image = ImageOps.pad(Image.open(memory).convert("RGB"), SIZE, Image.Resampling.LANCZOS, color="white")
        else:
            image = Image.open(io.BytesIO(scene(picture))).convert("RGB")
            image = ImageOps.fit(image, SIZE, Image.Resampling.LANCZOS)
        image.save(HERE / "gallery" / f"{path.stem}.webp", quality=70, method=6)


if __name__ == "__main__":
    main(sys.argv[1:])
