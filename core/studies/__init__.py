"""Studies that anyone can run again: settings as data, rows as records, tables as Markdown."""

from core.studies import outputs, range_prior
from core.studies.outputs import Table, as_csv, without_nan

__all__ = [
    "Table",
    "as_csv",
    "outputs",
    "range_prior",
    "without_nan",
]
