# SPDX-License-Identifier: MIT
"""Screenshots for the documentation: ``python -m tests.browser.pictures OUT --report FOLDER``.

``--report`` is a folder of ``datagen report``, ``--predictions`` a report with predictions, ``--asset`` a
folder of ``materials view``. ``--view`` chooses the view whose pixels are shown. The pictures are JPEG files
with the names that docs/report.md uses; check each before it replaces another.
"""

from __future__ import annotations

import argparse
import io
import tempfile
import time
from pathlib import Path

from PIL import Image

from tests.browser.driver import SOFTWARE_GL, Page, open_browser

SIZE = (1400, 860)
SECTIONS = ("findings", "distributions", "views")
ASSET_KEYS = {"lit": "1", "roughness": "4", "seen": "5"}
QUALITY, SETTLE_S, SLOW_S = 88, 1.0, 600


class Camera:
    """Saves screenshots of a page."""

    def __init__(self, page: Page, out: Path):
        self.page, self.out = page, out

    def shot(self) -> Image.Image:
        time.sleep(SETTLE_S)
        return Image.open(io.BytesIO(self.page.driver.get_screenshot_as_png())).convert("RGB")

    def take(self, name: str) -> None:
        self.save(name, self.shot())

    def save(self, name: str, picture: Image.Image) -> None:
        picture.save(self.out / f"{name}.jpg", quality=QUALITY, optimize=True)
        print(self.out / f"{name}.jpg", picture.size, flush=True)

    def emulate(self, size: tuple[int, int]) -> None:
        screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        self.page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        features = [{"name": "prefers-color-scheme", "value": "light"}]
        self.page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def _scroll(page: Page, section: str) -> None:
    page.run("document.getElementById(arguments[0]).scrollIntoView({behavior: 'instant'})", section)


def _view(camera: Camera, folder: Path, key: str, method: str = "", wipes: bool = False) -> None:
    camera.page.driver.get("about:blank")  # discard the settings of the previous view
    camera.page.open(folder / "index.html", f"#view/{key}" + (f"?method={method}" if method else ""))
    camera.page.wait_for_view(key)
    if wipes:
        camera.page.keys("w")
        camera.page.wait_for_view(key)


def report(camera: Camera, folder: Path, view: str) -> None:
    """Take pictures of the report's sections and of its viewer."""
    page = camera.page
    camera.emulate(SIZE)
    page.open(folder / "index.html")
    key = view or page.run("return document.querySelector('.rooms a').hash").removeprefix("#view/")
    camera.take("overview")
    for section in SECTIONS:
        _scroll(page, section)
        camera.take("gallery" if section == "views" else section)
    _view(camera, folder, key)
    frame = page.run("return REPORT.viewer.frame()")
    page.hover("beauty", int(frame["width"]) // 2, int(frame["height"]) * 2 // 3, click=True)
    page.wait("return document.getElementById('sources').dataset.ready === 'true'")
    camera.take("viewer")
    _view(camera, folder, key, wipes=True)
    camera.take("wipe")


def predictions(camera: Camera, folder: Path) -> None:
    """Take pictures of prediction errors: the table and the worst view."""
    page = camera.page
    camera.emulate(SIZE)
    page.open(folder / "index.html")
    _scroll(page, "predictions")
    camera.take("predictions")
    method = page.run("return document.getElementById('worst-method').value")
    key = page.run("return document.querySelector('#worst-views tbody tr').dataset.view")
    _view(camera, folder, key, method)
    camera.take("errors")


def asset(camera: Camera, folder: Path) -> None:
    """Take pictures of the 3D page: lit, and two of its channels."""
    camera.emulate((1200, 620))
    camera.page.open(folder / "index.html")
    for name, key in ASSET_KEYS.items():
        camera.page.keys(key, to="#picture")
        camera.take(f"atlas_{name}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--report", type=Path)
    parser.add_argument("--view", default="", help="configuration/view; the first view if left out")
    parser.add_argument("--predictions", type=Path)
    parser.add_argument("--asset", type=Path)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as profile,
        open_browser(Path(profile), *SIZE, flags=SOFTWARE_GL) as driver,
    ):
        driver.set_script_timeout(SLOW_S)  # software WebGL
        camera = Camera(Page(driver), given.out)
        if given.report:
            report(camera, given.report, given.view)
        if given.predictions:
            predictions(camera, given.predictions)
        if given.asset:
            asset(camera, given.asset)


if __name__ == "__main__":
    main()
