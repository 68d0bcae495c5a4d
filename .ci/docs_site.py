# SPDX-License-Identifier: MIT
"""Generates the API reference and the index of decisions of the documentation site.

MkDocs calls the ``on_...`` functions (``hooks`` in mkdocs.yml), and mkdocstrings calls the extension. Modules
and decisions are listed from the files, so none is omitted.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.structure.files import File, Files

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("datagen", "mitsuba_plugins", "model", "blender_addon")
# Commands are documented by --help and in the pages; modules that only start them have no interface.
_NOT_API = re.compile(r"(^|\.)(__main__|cli|commands?|command_line)$")
_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):(?=`)")
_CODE = re.compile(r"(``.*?``|`[^`]*`)", re.S)


def _docstring(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def api_pages() -> dict[str, list[str]]:
    """Names of the modules by package: ``{"datagen.formats": ["datagen.formats.asset", ...]}``."""
    pages: dict[str, list[str]] = {}
    for package in PACKAGES:
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            parts = path.relative_to(REPOSITORY).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            if _NOT_API.search(name) or not _docstring(path):
                continue
            owner = ".".join(parts[:2]) if len(parts) > 2 else package
            pages.setdefault(owner, []).append(name)
    return dict(sorted(pages.items(), key=lambda item: (PACKAGES.index(item[0].split(".")[0]), item[0])))


def _api_page(owner: str, modules: list[str]) -> str:
    return "\n".join([f"# {owner}\n", *(f"::: {module}\n" for module in modules)])


def _api_index(pages: dict[str, list[str]]) -> str:
    lines = [
        "# API reference",
        "",
        "Generated from the docstrings of every module. Shapes, units and ranges follow "
        "[the conventions](../conventions.md); bad input raises "
        "`datagen.foundation.errors.InputError` everywhere.",
        "",
    ]
    for owner, modules in pages.items():
        lines.append(f"## [{owner}]({owner}.md)\n\n| module | purpose |\n|---|---|")
        for module in modules:
            path = REPOSITORY.joinpath(*module.split("."))
            file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
            first = _ROLE.sub("", " ".join(_docstring(file).split("\n\n")[0].split())).replace("|", "\\|")
            lines.append(f"| [`{module}`]({owner}.md#{module}) | {first} |")
        lines.append("")
    return "\n".join(lines)


def decisions() -> list[tuple[str, str]]:
    """File name and title of every decision, by number."""
    paths = sorted((REPOSITORY / "docs" / "decisions").glob("[0-9]*.md"))
    return [(path.name, path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")) for path in paths]


def _decisions_index() -> str:
    text = "Reasons for choices that depart from a source, or that a later reader would question."
    lines = [f"- [{title}]({name})" for name, title in decisions()]
    return "\n".join(["# Decisions", "", text, "", *lines]) + "\n"


def on_config(config: Any) -> Any:
    """Add the generated pages to the site's navigation."""
    config.nav += [
        {"API reference": ["api/index.md", *({owner: f"api/{owner}.md"} for owner in api_pages())]},
        {"Decisions": ["decisions/index.md", *(f"decisions/{name}" for name, _ in decisions())]},
    ]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages to the site's files."""
    pages = api_pages()
    content = {f"api/{owner}.md": _api_page(owner, modules) for owner, modules in pages.items()}
    content["api/index.md"] = _api_index(pages)
    content["decisions/index.md"] = _decisions_index()
    for name, text in content.items():
        files.append(File.generated(config, name, content=text))
    return files


class PlainDocstrings(griffe.Extension):
    """Converts docstrings to Markdown: escapes brackets such as those of ``[m]``, and removes roles."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite an object's docstring in place."""
        if obj.docstring is None:
            return
        pieces = _CODE.split(_ROLE.sub("", obj.docstring.value))
        pieces[::2] = [text.replace("[", r"\[").replace("<", "&lt;") for text in pieces[::2]]
        obj.docstring.value = "".join(pieces)
