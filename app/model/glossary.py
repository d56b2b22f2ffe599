"""The glossary, and texts whose terms open it."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

from core.checks import require

ANCHOR = "#term-"
"""Beginning of the address of an entry; alone, that of the whole glossary."""


@dataclass(frozen=True)
class Term:
    """An entry of the glossary."""

    name: str
    meaning: str
    symbol: str = ""
    unit: str = ""
    synonyms: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Name of the entry in addresses."""
        return re.sub(r"\W+", "-", self.name.lower())

    @property
    def spellings(self) -> tuple[str, ...]:
        """Name and synonyms."""
        return (self.name, *self.synonyms)


@cache
def glossary() -> tuple[Term, ...]:
    """Return all terms in alphabetical order.

    Raises
    ------
    ValueError
        If two terms share a spelling.
    """
    text = (resources.files("app") / "glossary.toml").read_text("utf-8")
    terms = [
        Term(**{**each, "synonyms": tuple(each.get("synonyms", ()))})
        for each in tomllib.loads(text)["terms"]
    ]
    spellings = [each.lower() for term in terms for each in term.spellings]
    for each in spellings:
        require("spelling of a term", each, spellings.count(each) == 1, "one of one term only")
    return tuple(sorted(terms, key=lambda term: term.name.lower()))


_UNTOUCHED = re.compile(r"(^#.*$|`[^`]*`|!?\[[^\]]*\]\([^)]*\))", re.MULTILINE)
"""Headings, code and links of Markdown."""


@cache
def linked(source: str) -> str:
    """Return Markdown in which the first occurrence of each term is a link to its entry."""
    keys, pattern = _spellings()
    seen: set[str] = set()

    def link(found: re.Match[str]) -> str:
        key = keys[" ".join(found["term"].lower().split())]
        if key in seen:
            return found[0]
        seen.add(key)
        return f"[{found[0]}]({ANCHOR}{key})"

    parts = _UNTOUCHED.split(source)
    return "".join(part if at % 2 else pattern.sub(link, part) for at, part in enumerate(parts))


@cache
def _spellings() -> tuple[Mapping[str, str], re.Pattern[str]]:
    """Return the key of each spelling in lower case, and a pattern of all, in the plural, too."""
    keys = {each.lower(): term.key for term in glossary() for each in term.spellings}
    longest_first = sorted(keys, key=len, reverse=True)
    either = "|".join(re.escape(each).replace(r"\ ", r"\s+") for each in longest_first)
    return keys, re.compile(rf"(?<![\w-])(?P<term>{either})s?(?![\w-])", re.IGNORECASE)
