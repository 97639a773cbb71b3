r"""Serve a policy of LeRobot 0.4.4 in openpi's protocol; runs in LeRobot's own Python.

pip install 'lerobot==0.4.4' websockets msgpack
python serve_lerobot.py outputs/act 8000
echo 'rate_hz = 5
horizon = 4' > act.toml   # the rate of its data; lerobot_so101.toml will do, too
robot-gst rollout runs/lab --policy ws://127.0.0.1:8000 --map act.toml --name act
"""

import hashlib
import sys
import traceback
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from websockets.sync.server import ServerConnection, serve

IMAGES, STATE = "observation.images", "observation.state"


def packed(array: np.ndarray) -> dict[bytes, Any]:
    """An array as the protocol has it."""
    about = {b"dtype": array.dtype.str, b"shape": array.shape}
    return {b"__ndarray__": True, b"data": array.tobytes(), **about}


def unpacked(found: dict[Any, Any]) -> Any:
    """The array of such a map; other maps as they are."""
    if b"__ndarray__" not in found:
        return found
    return np.frombuffer(found[b"data"], found[b"dtype"]).reshape(found[b"shape"])


class Server:
    """One policy, asked for its next rows."""

    def __init__(self, path: str) -> None:
        """Load it with its processors."""
        config = PreTrainedConfig.from_pretrained(path)
        self._policy = get_policy_class(config.type).from_pretrained(path)
        self._sizes = {name: shape.shape[1:] for name, shape in config.image_features.items()}
        self._before, self._after = make_pre_post_processors(config, path)
        weights = Path(path, "model.safetensors").read_bytes()
        self.metadata = {"checkpoint": hashlib.sha256(weights).hexdigest()[:12]}

    def answer(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Its next rows; pictures are made as small as those that it learned from."""
        pictures = {f"{IMAGES}.{k}": v for k, v in observation.pop("pixels", {}).items()}
        found = pictures | observation
        state = found.get("agent_pos", found.get(STATE))
        told = {STATE: torch.from_numpy(np.array(state, "f4"))[None], "task": [found["task"]]}
        for name, size in self._sizes.items():
            picture = torch.from_numpy(found[name].copy())[None].movedim(-1, 1) / 255
            told[name] = torch.nn.functional.interpolate(picture, size=size, mode="area")
        rows = self._after(self._policy.predict_action_chunk(self._before(told)))
        return {"actions": rows[0].numpy()}

    def talk(self, socket: ServerConnection) -> None:
        """Answer whoever has connected; text is an error."""
        socket.send(msgpack.packb(self.metadata))
        for message in socket:
            try:
                answer = self.answer(msgpack.unpackb(message, object_hook=unpacked))
            except Exception:
                socket.send(traceback.format_exc())
                raise
            socket.send(msgpack.packb(answer, default=packed))


if __name__ == "__main__":
    policy = Server(sys.argv[1])
    serve(
        policy.talk, "127.0.0.1", int(sys.argv[2]), compression=None, max_size=None
    ).serve_forever()
