"""A page for the browser, in one file: tables, and pictures inside."""

import os
from base64 import b64encode
from collections.abc import Mapping
from html import escape
from io import BytesIO

import pandas as pd

from gdptlab._files import written_whole

STYLE = """
body { font: 15px/1.5 sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } th, td { text-align: left; padding: 0.3em 0.8em }
td, th { border-bottom: 1px solid #ddd; vertical-align: top } img { max-width: 100%; height: auto }
.bad { background: #f6cfc0 } .look { background: #fbeec2 } .good { background: #d6ecd9 }
"""
"""Look of the page (CSS)."""


def write_page(path: str | os.PathLike[str], title: str, parts: Mapping[str, object]) -> None:
    """Write a page of HTML, whole or not at all.

    Parameters
    ----------
    path : str or path-like
    title : str
    parts : dict
        What stands under each heading: text, a DataFrame, or a figure of matplotlib's.
    """
    body = "".join(f"<h2>{escape(heading)}</h2>\n{_as_html(part)}\n" for heading, part in parts.items())
    head = f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
    with written_whole(path) as temporary:
        text = f"{head}<style>{STYLE}</style></head>\n<body><h1>{escape(title)}</h1>\n{body}</body></html>\n"
        temporary.write_text(text, encoding="utf-8")


def _as_html(part: object) -> str:
    """HTML of a text, a table or a figure; a verdict in a table is coloured."""
    if isinstance(part, str):
        return f"<p>{escape(part)}</p>"
    if isinstance(part, pd.DataFrame):
        html = part.to_html(border=0, float_format=lambda value: f"{value:.4g}")
        for verdict in ("bad", "look", "good"):
            html = html.replace(f"<td>{verdict}</td>", f'<td class="{verdict}">{verdict}</td>')
        return html
    picture = BytesIO()
    part.set_layout_engine("none")  # it was laid out when it was drawn; once more would take as long again
    part.savefig(picture, format="png", dpi=100)
    return f'<img alt="" src="data:image/png;base64,{b64encode(picture.getvalue()).decode()}">'
