"""Send an episode over the wire once more, in its order, and have it recorded.

    python tests/played.py EPISODE ENDPOINT ID RATE

Prints what the recorder says of it.
"""

import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

from bridge.episode.reader import Episode
from bridge.record.control import RecorderClient
from bridge.wire.config import WireConfig
from bridge.wire.session import open_session

path, endpoint, name, rate = sys.argv[1:]
episode = Episode.open(Path(path))
types = {topic: each.type_name for topic, each in episode.topics().items()}
types = {topic: kind for topic, kind in types.items() if not topic.startswith("/recorder/")}
with open_session(WireConfig(connect=(endpoint,))) as session:
    client = RecorderClient(session, timeout_s=30.0)
    publishers = {topic: session.publisher(topic, kind) for topic, kind in types.items()}
    client.start(name, {key: v for key, v in asdict(episode.info).items() if key != "id" and v})
    begun_s = time.monotonic()
    for message in episode.messages(types):
        due_s = (message.log_time_ns - episode.start_ns) * 1e-9 / float(rate)
        time.sleep(max(0.0, begun_s + due_s - time.monotonic()))
        publishers[message.topic].put(message.data, source_ns=message.publish_time_ns)
    print(json.dumps(client.stop()))
