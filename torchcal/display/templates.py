"""Pages of HTML from the templates beside this module."""

from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined


@cache
def _environment() -> Environment:
    """Compiles each template once."""
    return Environment(
        loader=PackageLoader("torchcal.display", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def filled(template: str, **values: object) -> str:
    """A template with its values; whatever they hold is text and no HTML unless it is marked so."""
    return _environment().get_template(template).render(**values)
