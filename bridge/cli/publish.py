"""The command that publishes an episode; leaves bring others."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from bridge.sources.playback.config import PlaybackConfig
from bridge.sources.source import Duration
from bridge.terminal import Output
from bridge.wire.config import LOOPBACK

if TYPE_CHECKING:
    from bridge.record.control import RecorderClient

OUTPUT = Output()


@contextlib.contextmanager
def _recorded(
    client: "RecorderClient", episode: str | None, info: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Have the recorder record while the context lasts; an error throws the episode away.

    Yields:
        What the recorder says at the end; empty until then, and where nothing is recorded.
    """
    from bridge.errors import GstError

    answer: dict[str, Any] = {}
    if episode is None:
        yield answer
        return
    client.start(episode, info)
    try:
        yield answer
    except GstError:
        with contextlib.suppress(GstError):  # the first error is the one to show
            client.stop(discard=True)
        raise
    answer.update(client.stop())


PLAYBACK = PlaybackConfig()


def publish_episode(
    file: Path,
    /,
    *,
    config: Annotated[PlaybackConfig, Parameter(name="*")] = PLAYBACK,
    duration_s: Duration = None,
    episode: str | None = None,
    recorder: str = "main",
    connect: tuple[str, ...] = LOOPBACK,
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None,
    output: Output = OUTPUT,
) -> int:
    """Play an episode back: the same bytes in the same order, as far apart as they came.

    Example: robot-gst publish episode runs/monday/episodes/trial_0001.mcap --rate 2 --episode again
    Some of it: robot-gst publish episode FILE --topics "lab/**"

    Args:
        file: A finished episode, or any other MCAP file.
        duration_s: Stop after this long [s].
        episode: Ask the recorder to record this episode from the first to the last message.
        recorder: Name of the recorder.
        connect: Where it listens.
        zenoh_config: zenoh configuration (JSON5).
    """
    from dataclasses import asdict

    from bridge.record.control import RecorderClient
    from bridge.record.status import describe_answer
    from bridge.sources.playback.publish import EpisodeSource, describe_counts
    from bridge.sources.source import stopping
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    source = EpisodeSource(file, config)
    about = source.episode.info
    output.say(
        f"{file}: {source.num_messages} messages on {len(source.topics)} topics, "
        f"{source.episode.duration_s:.1f} s"
    )
    info = {**asdict(about), "tags": [*about.tags, f"playback:{about.id}"]}
    wire = WireConfig(
        connect=connect, config=zenoh_config, shared_memory_mb=config.shared_memory_mb
    )
    with stopping(duration_s) as stop, open_session(wire) as session:
        client = RecorderClient(session, recorder)
        with _recorded(client, episode, info) as answer:
            sent = source.run(session, stop, output)
    text = describe_counts(sent)
    if answer:
        text += f"\n{describe_answer(answer)}"
    output.result({"sent": sent, "recorded": answer or None}, text)
    return 0
