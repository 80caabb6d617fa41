"""The HTML and SVG of pages: Jinja2's templates beside this file, with all text escaped."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

if TYPE_CHECKING:
    from jinja2 import Environment


@cache
def _environment() -> Environment:
    import jinja2  # not before a page is made: a command that makes none does without

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
    """Fills a template; texts are escaped, ``Markup`` stays as it is.

    Args:
        name: of the file.
        values: of its variables.
    """
    return Markup(_environment().get_template(name).render(values))
