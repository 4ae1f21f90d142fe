# SPDX-License-Identifier: Apache-2.0
"""Elements of a self-contained HTML page: no other file, no network, light and dark, usable by keyboard."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from flowing_puppet_ros.draw.pictures import encode_data_uri

CSS = """
:root{--bg:#fbfbfa;--fg:#1c1f23;--soft:#5b636d;--rule:#d9dce0;--card:#fff;--accent:#0b66b3;
--c0:#0b66b3;--c1:#c4560a;--c2:#1b7f5c;--c3:#9a3f86;--c4:#7a6a00;--c5:#3c4aa8;--c6:#a02c2c;--c7:#4d5a63}
@media(prefers-color-scheme:dark){:root{--bg:#15181c;--fg:#e7e9ec;--soft:#a2abb5;--rule:#343a42;--card:#1d2126;
--accent:#62b0f0;--c0:#62b0f0;--c1:#f09a52;--c2:#5cc79c;--c3:#dc8fc9;--c4:#d8c545;--c5:#9aa5f5;--c6:#f08080;--c7:#b4bec6}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--fg);font:16px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif}
main,header,nav{max-width:1080px;margin:0 auto;padding:0 20px}
header{padding-top:28px}h1{font-size:1.7rem;margin:0 0 6px}h2{font-size:1.25rem;margin:44px 0 8px;padding-top:8px;
border-top:1px solid var(--rule)}h3{font-size:1rem;margin:22px 0 6px}
nav ul{list-style:none;display:flex;flex-wrap:wrap;gap:4px 18px;margin:14px 0 0;padding:0}
a{color:var(--accent)}p{max-width:74ch}.soft,figcaption,caption{color:var(--soft);font-size:.9rem}
caption{text-align:left;padding:2px 0 6px}
caption span{position:sticky;left:0;display:inline-block;max-width:min(74ch,88vw)}
code{font-size:.92em;overflow-wrap:anywhere}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.95rem;min-width:50%}
th,td{padding:5px 14px 5px 0;border-bottom:1px solid var(--rule);text-align:left;vertical-align:top}
th[scope=row]{font-weight:600;white-space:nowrap}td.n,th.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
figure{margin:10px 0}img{max-width:100%;height:auto;border-radius:4px;vertical-align:middle}
.row{display:flex;flex-wrap:wrap;gap:12px;align-items:flex-start}.row figure{margin:0 0 6px;flex:0 1 auto}
.row img{outline:1px solid var(--rule);outline-offset:-1px}.row.three figure{flex:0 1 calc((100% - 24px)/3)}
.row.views{flex-wrap:nowrap;overflow-x:auto}.row.views figure{flex:0 1 24%;min-width:150px}
.frame{display:none}.frame.on{display:block}
.frame img{height:min(62vh,420px);width:auto;object-fit:contain;object-position:left}
.frame.pair.on{display:flex;gap:8px}.frame.pair figure{flex:1 1 0;min-width:0}
.frame.pair img{width:100%;height:auto;max-height:min(62vh,420px)}
.panes:has(.pair){width:min(94vw,1500px);margin-left:calc(50% - min(47vw,750px))}
.panes:has(.pair) .pictures{max-width:66%}
.panes{display:flex;gap:16px;align-items:stretch}.panes>*{flex:1 1 0;min-width:0}.pictures{flex:0 1 auto;max-width:58%}
.space{display:flex;flex-direction:column}.space canvas{width:100%;flex:1 1 380px;min-height:380px;touch-action:none;
border:1px solid var(--rule);border-radius:4px;cursor:grab}[hidden]{display:none!important}
.controls{display:flex;flex-wrap:wrap;gap:6px 14px;align-items:center;margin:8px 0}.controls label{white-space:nowrap}
.scrub{position:sticky;bottom:0;background:var(--bg);border-top:1px solid var(--rule);padding:8px 0;margin:0;z-index:1;
flex-wrap:nowrap}.scrub input{flex:1;min-width:60px;accent-color:var(--accent)}
.scrub output{font-variant-numeric:tabular-nums;min-width:4.5em;text-align:right}
button{font:inherit;color:inherit;background:var(--card);border:1px solid var(--rule);border-radius:6px;
padding:3px 14px}
:focus-visible{outline:2px solid var(--accent);outline-offset:2px}
svg.plot{width:100%;max-width:820px;height:auto;display:block}
svg .grid{stroke:var(--rule);stroke-width:1}svg text{fill:var(--soft);font-size:12px}
svg .end{text-anchor:end}svg .centre{text-anchor:middle}svg .mid{dominant-baseline:central}
svg .now{display:none;stroke:var(--fg);stroke-width:1.2}.timeline svg .now{display:inline}
.timeline svg{cursor:crosshair;touch-action:pan-y}
svg .cloud,svg .floor{stroke:var(--soft);stroke-width:2;stroke-linecap:round;opacity:.75}svg .floor{opacity:.22}
svg .rejected{stroke:var(--soft);stroke-width:1.6;fill:none}svg .rejected text{stroke:none}svg .track{stroke-width:2}
svg .line{fill:none;stroke-width:1.8;stroke-linejoin:round}
.legend{display:flex;flex-wrap:wrap;gap:2px 18px;margin:4px 0 10px;font-size:.9rem;color:var(--soft)}
.key{display:inline-block;width:22px;height:4px;border-radius:2px;margin-right:7px;vertical-align:middle}
.ramp{width:120px;height:10px;image-rendering:pixelated;vertical-align:middle}
details{margin:10px 0}summary{cursor:pointer}
@media(max-width:720px){.panes{flex-direction:column}.pictures,.panes:has(.pair) .pictures{max-width:none}
.panes:has(.pair){width:auto;margin-left:0}th[scope=row],td.n{white-space:normal;overflow-wrap:normal}table{font-size:.88rem}
tr:has(>:nth-child(5))>*{white-space:nowrap}}
""" + "".join(f".s{k}{{stroke:var(--c{k})}}.d{k}{{fill:var(--c{k})}}.k{k}{{background:var(--c{k})}}" for k in range(8))

SCRIPTS = ("scene.js", "timeline.js")

type TimelineFrame = tuple[float, Sequence[tuple[np.ndarray, str]]]
"""Seconds, and the pictures that are shown side by side from then on, each with its caption."""

_SCENE_VIEW = (
    '<div class="space"><canvas tabindex="0" role="application" aria-label="3D view of the bodies: drag or arrow keys '
    'turn, plus and minus zoom, Home resets"></canvas><div class="controls">'
    '<label><input type="checkbox" checked data-shows="mesh"> bodies</label>'
    '<label><input type="checkbox" checked data-shows="points"> points</label>'
    '<button type="button" data-home>Reset view</button><span class="soft">drag: turn; two fingers, right button or '
    'Shift: move; wheel: zoom</span></div></div><p class="no-space soft" hidden>This browser has no WebGL 2, so there '
    "is no 3D view; the still pictures below show the bodies.</p>"
)

# Without scripts every frame is shown, one below the other, and what needs scripts is hidden.
NO_SCRIPT = "<noscript><style>.frame{display:block}.scrub,.space,.timeline svg .now{display:none}</style></noscript>"


def read_script(name: str) -> str:
    """Return the text of the page's script report/web/`name`."""
    return (files("flowing_puppet_ros.report") / "web" / name).read_text("utf8")


def build_page(title: str, lead: str, sections: Sequence[tuple[str, str]], scripts: Sequence[str] = ()) -> str:
    """Build the page from a title (text), a lead (HTML), sections of (heading text, HTML) and names of scripts."""
    code = "".join(f"<script>{read_script(name)}</script>" for name in scripts)
    ids = [f"part{index + 1}" for index in range(len(sections))]
    links = "".join(
        f'<li><a href="#{name}">{escape(heading)}</a></li>' for name, (heading, _) in zip(ids, sections, strict=True)
    )
    body = "".join(
        f'<section id="{name}" aria-labelledby="{name}h"><h2 id="{name}h">{escape(heading)}</h2>{html}</section>\n'
        for name, (heading, html) in zip(ids, sections, strict=True)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{CSS}</style>{NO_SCRIPT}</head>\n<body><header><h1>{escape(title)}</h1>"
        f'{lead}</header>\n<nav aria-label="Sections"><ul>{links}</ul></nav>\n<main>\n{body}</main>\n'
        f"{code}</body></html>\n"
    )


def paragraph(text: str, soft: bool = False) -> str:
    """Make a paragraph of plain text."""
    return f"<p{' class=soft' if soft else ''}>{escape(text)}</p>"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int], caption: str) -> str:
    """Make a table of text cells; the columns `numeric` are right-aligned, the first cell of a row is its head."""

    def kind(column: int) -> str:
        return ' class="n"' if column in numeric else ""

    head = "".join(f'<th scope="col"{kind(k)}>{escape(text)}</th>' for k, text in enumerate(heads))
    body = ""
    for row in rows:
        cells = "".join(f"<td{kind(k)}>{escape(text)}</td>" for k, text in enumerate(row) if k)
        body += f'<tr><th scope="row">{escape(row[0])}</th>{cells}</tr>'
    return (
        f'<div class="scroll"><table><caption><span>{escape(caption)}</span></caption><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def figure(image: np.ndarray, alt: str, caption: str = "", kind: str = "jpg") -> str:
    """Make a figure of an RGB image (H, W, 3) with its description and caption."""
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    size = f'width="{image.shape[1]}" height="{image.shape[0]}"'
    return f'<figure><img src="{encode_data_uri(image, kind)}" {size} alt="{escape(alt)}">{text}</figure>'


def row(figures: Sequence[str], kind: str = "") -> str:
    """Set figures side by side; `kind` is "three", "views" or empty."""
    return f'<div class="row {kind}">{"".join(figures)}</div>'


def json_block(name: str, value: Any) -> str:
    """Make the element, with the attribute data-`name`, of data for the page's scripts."""
    # A slash after an angle bracket would end the element.
    text = json.dumps(value, separators=(",", ":")).replace("</", "<\\/")
    return f'<script type="application/json" data-{name}>{text}</script>'


def details(summary: str, html: str) -> str:
    """Fold HTML away under a line of text."""
    return f"<details><summary>{escape(summary)}</summary>{html}</details>"


def make_timeline(frames: Sequence[TimelineFrame], scene: Mapping[str, Any] | None, plots: str, label: str) -> str:
    """Make the pictures of `frames` beside the 3D `scene`, plots below, and the slider for all of them.

    `scene` is what `scene_3d.make_scene_data` returns; `label` is that of the slider.
    """
    times = sorted({round(seconds, 6) for seconds, _ in frames} | {round(t, 6) for t in _scene_times(scene)})
    pictures = "".join(
        f'<div class="frame{" pair" if len(images) > 1 else ""}{"" if index else " on"}" data-t="{seconds:.6f}">'
        f"{''.join(figure(image, caption, caption) for image, caption in images)}</div>"
        for index, (seconds, images) in enumerate(frames)
    )
    panes = f'<div class="pictures">{pictures}</div>' if frames else ""
    if scene is not None:
        panes += json_block("scene", scene) + _SCENE_VIEW
    controls = (
        f'<div class="controls scrub"{"" if len(times) > 1 else " hidden"}>'
        '<button type="button" data-play>Play</button>'
        f'<input type="range" min="0" max="{len(times) - 1}" value="0" aria-label="{escape(label)}">'
        f"<output>{times[0]:.2f} s</output></div>"
    )
    panes = f'<div class="panes">{panes}</div>'
    return f'<div class="timeline">{json_block("times", times)}{panes}{plots}{controls}</div>'


def _scene_times(scene: Mapping[str, Any] | None) -> list[float]:
    return [] if scene is None else [float(frame["t"]) for frame in scene["frames"]]
