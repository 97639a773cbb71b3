"""Commands and flags of earlier editions, each with what to use instead; kept for one release."""

from collections.abc import Sequence

from bridge.errors import UsageError

GONE: dict[str, str] = {
    "import kinova": "Run python datasets/kinova/make_episodes.py DIR RUN.",
}
"""By command, or by command and flag (``"record --quota-mb"``); each text is a sentence."""


def refuse_gone(tokens: Sequence[str]) -> None:
    """Answer a command or a flag that went.

    Raises:
        UsageError: Naming it, with what to use instead.
    """
    words = [token.partition("=")[0] for token in tokens]
    for command in (" ".join(words[:2]), words[0] if words else ""):
        for name in (command, *(f"{command} {word}" for word in words if word.startswith("--"))):
            if name in GONE:
                raise UsageError(f"{name} is gone. {GONE[name]}")
