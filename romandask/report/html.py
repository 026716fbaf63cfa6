"""HTML elements of the report: embedded pictures and tables."""

from __future__ import annotations

import base64
import html

import pandas as pd


def image_of(png: bytes, caption: str) -> str:
    """Return an HTML figure with an embedded PNG picture and its caption."""
    data = base64.b64encode(png).decode()
    text = html.escape(caption)
    image = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def table_of(frame: pd.DataFrame) -> str:
    """Return an HTML table of a data frame, without its index."""
    return frame.to_html(index=False, border=0)
