"""Objects as small tables for notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


def html_table(title: str, facts: Mapping[str, str]) -> str:
    """Return a heading and named texts as HTML; any text is escaped."""
    rows = (
        f'<tr><th style="text-align:left">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(text)}</td></tr>'
        for name, text in facts.items()
    )
    return f"<table><caption>{escape(title)}</caption><tbody>{''.join(rows)}</tbody></table>"
