"""Studies that anyone can run again: settings as data, rows as records, tables as Markdown."""
