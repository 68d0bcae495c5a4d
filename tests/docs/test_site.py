# SPDX-License-Identifier: MIT
"""The documentation site builds without warnings, needs no network, and is searchable from disk."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.browser.driver import WAIT_S, open_browser
from tests.conftest import REPOSITORY

pytestmark = pytest.mark.slow
_RESOURCE = re.compile(
    r"<(?:script|img|iframe|source)[^>]+src=\"(https?:[^\"]+)|<link[^>]+href=\"(https?:[^\"]+)"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="needs MkDocs: pip install -e '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)],
        cwd=REPOSITORY,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr[-3000:]
    return out


def test_every_decision_and_every_package_has_its_page(site: Path) -> None:
    index = (site / "decisions" / "index.html").read_text()
    decisions = sorted((REPOSITORY / "docs" / "decisions").glob("*.md"))
    assert len(decisions) > 20 and all(f'href="{path.stem}.html"' in index for path in decisions)
    for name in (
        "datagen.formats",
        "datagen.tradeoff",
        "mitsuba_plugins",
        "model.training",
        "blender_addon.bake",
    ):
        assert (site / "api" / f"{name}.html").is_file(), name
    assert ":class:" not in "".join(page.read_text() for page in (site / "api").glob("*.html"))


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 60
    assert [(p.name, m.group()) for p in pages for m in _RESOURCE.finditer(p.read_text())] == []


def test_the_site_opens_from_disk_and_is_searched(site: Path, tmp_path: Path) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    with open_browser(tmp_path, logs_requests=False) as browser:
        browser.get((site / "index.html").as_uri())
        browser.execute_script("document.querySelector('#__search').click()")
        browser.find_element(By.CSS_SELECTOR, ".md-search__input").send_keys("roughness")
        WebDriverWait(browser, WAIT_S).until(
            lambda b: b.find_elements(By.CSS_SELECTOR, ".md-search-result__item"),
            "the search found nothing",
        )
        errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
        assert errors == []
