"""The pages of the app: one folder and one line each."""

from __future__ import annotations

from importlib import import_module

from app.pages.navigation import Page

FOLDERS = (
    "explore",
    "inspect",
    "compare",
    "tradeoff",
    "paper",
    "learn",
)
"""Folders of `app.pages`, in the order of their buttons; each has a `page.py` with a `PAGE`."""

PAGES: tuple[Page, ...] = tuple(import_module(f"app.pages.{each}.page").PAGE for each in FOLDERS)
