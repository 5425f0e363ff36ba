# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pieces of pages in HTML that need no other file, and print on any paper without a cut."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

_STYLE = """
body { font: 16px/1.5 sans-serif; color: #222; max-width: 44rem; margin: 1.5rem auto;
       padding: 0 1rem; overflow-wrap: break-word }
h1 { font-size: 1.5rem; margin-bottom: .3rem; overflow-wrap: anywhere }
h2 { font-size: 1.15rem; margin-top: 2rem }
h3 { font-size: 1rem; margin-bottom: .2rem }
.quiet, figcaption { color: #555; font-size: .9rem }
.verdict { font-size: 1.1rem; padding: .8rem 1rem; border-left: .4rem solid; background: #f3f3f3 }
.traced { border-color: #1f77b4 }
.none { border-color: #2ca02c }
.unexplained { border-color: #d62728 }
.unseen { border-color: #999 }
pre { background: #f3f3f3; padding: .8rem; white-space: pre-wrap; font-size: .85rem }
table { border-collapse: collapse; margin: .5rem 0; width: 100%; font-size: .9rem }
th, td { border-bottom: 1px solid #ccc; padding: .25rem .5rem .25rem 0; text-align: left;
         vertical-align: top; font-variant-numeric: tabular-nums }
.pairs td, .pairs th, .cards td { overflow-wrap: anywhere }
th { color: #555; font-weight: normal }
figure { margin: 1rem 0 }
img { width: 100%; max-width: 38rem }
summary { cursor: pointer; font-weight: bold; padding: .3rem 0 }
@media (max-width: 40rem) {
  .cards tr { display: block; padding: .4rem 0; border-bottom: 1px solid #ccc }
  .cards tr.head { display: none }
  .cards td { display: grid; grid-template-columns: 9rem minmax(0, 1fr); border: none; padding: 0 }
  .cards td::before { content: attr(data-label); color: #555 }
}
@page { margin: 14mm 12mm }
@media print {
  body { font-size: 9.5pt; line-height: 1.35; max-width: none; margin: 0; padding: 0 }
  h1, h2, h3, summary { break-after: avoid }
  h2 { margin-top: 1rem }
  th, td { padding: .1rem .5rem .1rem 0 }
  tr, li, figure, .verdict { break-inside: avoid }
  img { max-width: 100%; max-height: 215mm; object-fit: contain; object-position: left }
  .half img { max-height: 105mm }
  .wide img { max-height: 66mm }
  figure { margin: .5rem 0 }
  figure h2 { margin: .3rem 0 }
}
"""


def page(title: str, parts: Sequence[str]) -> str:
    """Return a page of its parts, which are HTML."""
    return ('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n'
            '<body>\n' + '\n'.join(parts) + '\n</body>\n</html>\n')


def figure(title: str, picture: bytes, caption: str = '', *, kind: str = 'tall') -> str:
    """
    Return a figure with its title; `picture` is a PNG.

    A sheet has room for one that is `tall`, two that are `half` as tall, three `wide` ones.
    """
    data = base64.b64encode(picture).decode()
    below = f'<figcaption>{escape(caption)}</figcaption>' if caption else ''
    return (f'<figure class="{kind}"><h2>{escape(title)}</h2>\n'
            f'<img alt="{escape(title)}" src="data:image/png;base64,{data}">{below}</figure>')


def part(title: str, *parts: str) -> str:
    """Return parts that a reader opens by a title."""
    content = '\n'.join(parts)
    return f'<details><summary>{escape(title)}</summary>\n{content}\n</details>'


def table(head: Sequence[str], rows: Iterable[Sequence[Any]], *, kind: str = '') -> str:
    """
    Return a table.

    On a narrow screen the rows of the kind `cards` are blocks with a line per cell; in `pairs`
    long words break.
    """
    lines = ['<thead><tr class="head">' + ''.join(f'<th>{escape(cell)}</th>' for cell in head)
             + '</tr></thead>']
    lines += ['<tr>' + ''.join(f'<td data-label="{escape(name)}">{kept(str(cell))}</td>'
                               for name, cell in zip(head, row)) + '</tr>' for row in rows]
    style = f' class="{kind}"' if kind else ''
    return f'<table{style}>\n' + '\n'.join(lines) + '\n</table>'


def kept(text: str) -> str:
    """Return a text in which numbers stay together with their errors and units."""
    return escape(text.replace(' ± ', '\u00a0±\u00a0').replace(' %', '\u00a0%'))
