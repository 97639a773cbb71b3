"""What a reader sees of a page."""

import re


def words(text: str) -> str:
    """Reduce a page to the words a reader sees."""
    visible = re.sub(r"<(svg|head).*?</\1>|<[^>]+>", " ", text, flags=re.DOTALL)
    return re.sub(r"\s+", " ", visible.replace("&nbsp;", " ").replace("\u00a0", " "))
