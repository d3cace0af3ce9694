"""Draw the thumbnails of the gallery and of tutorials, `docs/*/*.webp`: figures, and the scenes of pages (needs Chromium).

Run `python docs/thumbnails.py [NAME ...]`; it needs the extras `view` and `test`.
"""

import base64
import io
import re
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

#: The figures of tutorials without an example: a name, which one of the first cells defines, and what draws it.
TUTORIALS = {
    "own_oscillator": ("run", ".portrait('y0', 'y1')"),
    "own_sleigh": ("run", ".portrait('q0', 'q1')"),
    "video": ("fit", ".plot()"),
    "walker": ("diagram", ".plot('y0')"),
}

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


def drawn_by(path: Path) -> Any:
    """The figure or the page of an example, or the figure of a tutorial."""
    if path.suffix == ".py":
        return runpy.run_path(str(path))["draw"]()
    variables: dict[str, Any] = {}
    for cell in re.findall(r"```{code-cell}\n(.*?)```", path.read_text(), re.DOTALL):
        exec(cell, variables)
        if TUTORIALS[path.stem][0] in variables:
            break
    return eval("".join(TUTORIALS[path.stem]), variables)


def main(names: list[str]) -> None:
    """Write the thumbnail of each example that draws, and of the tutorials without an example."""
    examples = [path for path in (HERE.parent / "examples").glob("*.py") if "def draw(" in path.read_text()]
    for path in sorted([*examples, *(HERE / "tutorials" / f"{name}.md" for name in TUTORIALS)]):
        if names and path.stem not in names:
            continue
        picture = drawn_by(path)
        if hasattr(picture, "savefig"):
            memory = io.BytesIO()
            picture.savefig(memory, dpi=100)
            image = ImageOps.pad(Image.open(memory).convert("RGB"), SIZE, Image.Resampling.LANCZOS, color="white")
        else:
            image = Image.open(io.BytesIO(scene(picture))).convert("RGB")
            image = ImageOps.fit(image, SIZE, Image.Resampling.LANCZOS)
        folder = HERE / ("gallery" if path.suffix == ".py" else "tutorials")
        image.save(folder / f"{path.stem}.webp", quality=70, method=6)


if __name__ == "__main__":
    main(sys.argv[1:])
