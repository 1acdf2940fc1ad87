"""Pages of HTML from the templates beside this module."""

from jinja2 import Environment, PackageLoader, StrictUndefined


def filled(template: str, **values: object) -> str:
    """A template with its values; whatever they hold is text and no HTML unless it is marked so."""
    environment = Environment(
        loader=PackageLoader("torchcal.display", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
