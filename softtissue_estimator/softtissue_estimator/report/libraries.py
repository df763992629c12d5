"""The libraries of this room, which are an extra (`report`): Jinja2 for the page, matplotlib for its curves."""

from softtissue_estimator.errors import MissingDependencyError

try:
    import jinja2 as jinja2
    import matplotlib as matplotlib
except ImportError as error:
    raise MissingDependencyError(
        f"report: expected Jinja2 and matplotlib, got no {error.name}; pip install jinja2 matplotlib,"
        " or softtissue_estimator with [report]"
    ) from error
