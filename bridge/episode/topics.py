"""Names that become parts of topics."""

import re

from bridge.errors import UsageError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def refuse_bad_name(what: str, name: str) -> None:
    """Check that a name can stand between two slashes.

    Raises:
        UsageError: When it cannot.
    """
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{what} name {name!r} cannot be part of a topic. "
            "Use letters, digits and '_', starting with a letter."
        )
