"""Errors about a message say which one of which topic of which file it was."""

from collections.abc import Iterator
from contextlib import contextmanager

from bridge.episode.reader import Episode
from bridge.errors import BridgeError, EpisodeError


@contextmanager
def message_named(episode: Episode, topic: str, number: int) -> Iterator[None]:
    """Name the message in whatever goes wrong in the block; ``number`` counts from 1.

    Raises:
        EpisodeError: In place of the ``BridgeError`` that came out.
    """
    try:
        yield
    except BridgeError as error:
        raise EpisodeError(
            path=episode.path,
            found=f"message {number} of {topic}: {error}",
            hint="robot-gst check lists everything that is wrong with it.",
        ) from error
