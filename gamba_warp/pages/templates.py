"""HTML of pages from Jinja2 templates in this folder, with all text escaped."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

if TYPE_CHECKING:
    from jinja2 import Environment


@cache
def _environment() -> Environment:
    import jinja2  # only when a page is made

    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters["px"] = "{:.1f}".format
    return found


def render(name: str, /, **values: Any) -> Markup:
    """Fill a template; texts are escaped, ``Markup`` is inserted unchanged.

    Args:
        name: of the file.
        values: of its variables.
    """
    return Markup(_environment().get_template(name).render(values))
