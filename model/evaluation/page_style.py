# SPDX-License-Identifier: MIT
"""Style and script of the page, embedded so that it is self-contained; parts of its charts."""

from __future__ import annotations

import html
from collections.abc import Sequence

STYLE = """
:root { --ink: #1d2127; --soft: #6a717d; --line: #e3e6ea; --paper: #ffffff; --wash: #f6f7f9; --accent:
  #2f6f8f; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7e9ec; --soft: #9aa2ad; --line: #31363d; --paper:
  #14171b; --wash: #1c2026; --accent: #7fb8d4; } }
* { box-sizing: border-box; }
body { font: 15px/1.6 system-ui, -apple-system, "Segoe UI", sans-serif; color: var(--ink); background:
  var(--paper); margin: 0; }
main { max-width: 84rem; margin: 0 auto; padding: 2.5rem 1.5rem 5rem; }
h1 { font-size: 2rem; font-weight: 650; letter-spacing: -.02em; margin: 0 0 .25rem; }
h2 { font-size: 1.35rem; font-weight: 620; letter-spacing: -.01em; margin: 3.5rem 0 .5rem; padding-top:
  1.25rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.02rem; font-weight: 620; margin: 2rem 0 .5rem; }
p, li, figcaption { color: var(--soft); } p { max-width: 68ch; } .notes { padding-left: 1.1rem; font-size:
  13.5px; }
nav { display: flex; flex-wrap: wrap; gap: .4rem; margin: 1.2rem 0 0; }
nav a { color: var(--accent); text-decoration: none; border: 1px solid var(--line); border-radius: 99px;
  padding: .15rem .8rem; font-size: 13.5px; } nav a:hover { background: var(--wash); }
.wide { overflow-x: auto; } table { border-collapse: collapse; margin: .75rem 0; font-size: 13px;
  font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .65rem; text-align: right; border-bottom: 1px solid var(--line); }
th { font-weight: 600; vertical-align: bottom; color: var(--soft); }
td:first-child, th:first-child, td:nth-child(2), th:nth-child(2) { text-align: left; }
td:first-child { white-space: nowrap; } tbody tr:hover td { background: var(--wash); }
.summary td:nth-child(2), .summary th:nth-child(2) { text-align: right; } .summary b { color: var(--accent); }
tr.paper td { color: var(--soft); font-style: italic; }
.pictures td { padding: 2px; border: 0; text-align: center; vertical-align: top; }
.pictures tr th, .pictures tr th:first-child { border: 0; text-align: center; padding: 2px 6px; }
.pictures tr th:first-child { text-align: right; vertical-align: middle; color: var(--ink); }
.pictures img { display: block; min-width: 160px; border-radius: 4px; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(17.5rem, 1fr)); gap: 1.1rem; }
.cards:not(:has(> :nth-child(5))) { grid-template-columns: repeat(auto-fill, minmax(26rem, 1fr)); }
figure { margin: 0; } figure img { width: 100%; display: block; border-radius: 6px; }
figcaption { font-size: 12.5px; padding: .3rem .1rem 0; } figcaption b { color: var(--ink); font-weight:
  600; }
.pair { position: relative; overflow: hidden; border-radius: 6px; line-height: 0; touch-action: pan-y;
  --at: 50%; cursor: ew-resize; }
.pair img { border-radius: 0; user-select: none; } .pair .over { position: absolute; inset: 0; clip-path:
  inset(0 calc(100% - var(--at)) 0 0); }
.pair::after { content: ""; position: absolute; top: 0; bottom: 0; left: var(--at); width: 2px;
  margin-left: -1px; background: #fff; box-shadow: 0 0 4px rgba(0,0,0,.6); }
.pair input { position: absolute; inset: 0; width: 100%; height: 100%; opacity: 0; margin: 0; cursor:
  ew-resize; }
.pair:focus-within { outline: 2px solid var(--accent); outline-offset: 2px; }
.tag { position: absolute; top: .45rem; font-size: 11px; line-height: 1; color: #fff; background:
  rgba(0,0,0,.55); padding: .28rem .45rem; border-radius: 4px; pointer-events: none; } .tag.left { left:
  .45rem; }
.tag.right { right: .45rem; }
.errors { display: grid; grid-template-columns: 1.4rem repeat(var(--methods), minmax(9rem, 20rem));
  gap: .35rem; align-items: center; }
.errors .head { color: var(--soft); font-size: 12.5px; text-align: center; } .errors .row { font-size:
  13px; font-weight: 600; }
.errors img { width: 100%; display: block; border-radius: 4px; }
.overview svg { min-width: 46rem; width: 100%; margin: 1.2rem 0 0; }
.scale { display: flex; align-items: center; gap: .6rem; font-size: 12px; color: var(--soft); margin:
  .5rem 0 0; }
.scale img { height: 10px; width: 14rem; border-radius: 3px; }
.chart { display: grid; gap: .2rem 1.6rem; grid-template-columns: repeat(auto-fit, minmax(22rem, 1fr)); }
.chart svg { width: 100%; height: auto; } .chart text { fill: var(--ink); font-size: 11.5px; }
.chart .quiet { fill: var(--soft); } .chart .axis { stroke: var(--line); }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; font-size: 13px; color: var(--soft); }
.legend i { display: inline-block; width: .75rem; height: .75rem; border-radius: 3px; margin-right: .4rem;
  vertical-align: -1px; }
details { margin: 1.2rem 0; } summary { cursor: pointer; color: var(--accent); }
"""

SCRIPT = """
for (const pair of document.querySelectorAll('.pair')) {
  const range = pair.querySelector('input');
  const move = () => pair.style.setProperty('--at', range.value + '%');
  range.addEventListener('input', move);
  pair.addEventListener('pointermove', event => {
    if (event.pointerType !== 'mouse') return;
    const box = pair.getBoundingClientRect();
    range.value = 100 * (event.clientX - box.left) / box.width;
    move();
  });
}
"""


GRID = "#dfe3e8"
"""Colour of the lines of charts."""


def legend(labels: Sequence[str]) -> tuple[list[str], float]:
    """SVG elements of a chart's legend in one line, and its width in pixels."""
    parts, x = [], 0.0
    for place, label in enumerate(labels):
        parts.append(f'<circle cx="{x + 5:.0f}" cy="9" r="4" fill="{hue(place)}"/>')
        parts.append(f'<text x="{x + 13:.0f}" y="13">{html.escape(label)}</text>')
        x += 26 + 6.2 * len(label)
    return parts, x


def hue(index: int) -> str:
    """Colour of the method at ``index`` in charts."""
    hues = ("#2f6f8f", "#d08a2e", "#5a8f4e", "#8a5a9c", "#b5483f", "#7a7f87", "#3d9c94", "#c06c9a")
    return hues[index % len(hues)]
