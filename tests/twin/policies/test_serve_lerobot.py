"""The example that serves LeRobot's policies speaks the protocol; LeRobot itself is played here."""

import hashlib
import runpy
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from websockets.sync.server import serve

from bridge.robots.default import ROBOT
from twin.policies.errors import PolicyError
from twin.policies.mapping import DEFAULT, Interpreter, read_mapping
from twin.policies.openpi import ServedPolicy
from twin.robot.model import load_robot

EXAMPLES = Path(__file__).parents[3] / "examples" / "policies"
STATE, STEPS = "observation.state", np.arange(5.0)[:, None]


@pytest.fixture
def policy(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[ServedPolicy, list[dict[str, torch.Tensor]]]]:
    """A policy that goes on from where the arm is, and what it was shown."""
    shown: list[dict[str, torch.Tensor]] = []

    def chunk(batch: dict[str, torch.Tensor]) -> torch.Tensor:
        shown.append(batch)
        return batch[STATE][:, None] + torch.from_numpy(STEPS).float()

    act = SimpleNamespace(from_pretrained=lambda _: SimpleNamespace(predict_action_chunk=chunk))
    shapes = {
        f"observation.images.{name}": SimpleNamespace(shape=(3, 3, 4)) for name in request.param
    }
    config = SimpleNamespace(type="act", image_features=shapes)
    before, after = lambda batch: batch | {STATE: 2 * batch[STATE]}, lambda rows: rows / 2 + 0.25
    factory = SimpleNamespace(
        get_policy_class={"act": act}.get,
        make_pre_post_processors=lambda config, path: (before, after),
    )
    configs = SimpleNamespace(PreTrainedConfig=SimpleNamespace(from_pretrained=lambda _: config))
    for name in ("lerobot", "lerobot.configs", "lerobot.policies"):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace())
    monkeypatch.setitem(sys.modules, "lerobot.configs.policies", configs)
    monkeypatch.setitem(sys.modules, "lerobot.policies.factory", factory)
    (tmp_path / "model.safetensors").write_bytes(b"learned")
    talk = runpy.run_path(str(EXAMPLES / "serve_lerobot.py"))["Server"](str(tmp_path)).talk
    with serve(talk, "127.0.0.1", 0, compression=None, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        client = ServedPolicy(f"ws://127.0.0.1:{server.socket.getsockname()[1]}", 20.0)
        yield client, shown
        client.close()
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    ("policy", "mapping"),
    [(("side", "wrist"), None), (("front", "wrist"), EXAMPLES / "lerobot_so101.toml")],
    indirect=["policy"],
)
def test_it_is_shown_small_pictures_and_answers_rows(
    policy: tuple[ServedPolicy, list[dict[str, torch.Tensor]]], mapping: Path | None
) -> None:
    client, shown = policy
    assert client.metadata == {"checkpoint": hashlib.sha256(b"learned").hexdigest()[:12]}
    speak = Interpreter(read_mapping(mapping), load_robot(ROBOT.urdf_text()), "put it there")
    rng = np.random.default_rng(0)
    names = ("side", "wrist")
    pictures = {name: rng.integers(0, 255, (30, 40, 3), dtype=np.uint8) for name in names}
    told = speak.observation(pictures, rng.normal(size=6), 0.04)
    state = told["agent_pos"] if speak.mapping == DEFAULT else told[STATE]
    rows = speak.rows(client.infer(told))

    np.testing.assert_allclose(rows, state + STEPS / 2 + 0.25, rtol=1e-6)
    (batch,) = shown
    assert batch.pop("task") == ["put it there"]
    np.testing.assert_array_equal(batch.pop(STATE), 2 * state[None])
    for found, picture in zip(batch.values(), pictures.values(), strict=True):
        means = picture.reshape(3, 10, 4, 10, 3).mean((1, 3)) / 255
        np.testing.assert_allclose(found[0], means.transpose(2, 0, 1), atol=1e-6)


@pytest.mark.parametrize("policy", [("side",)], indirect=True)
def test_what_fails_behind_it_is_told_in_text(policy: tuple[ServedPolicy, object]) -> None:
    with pytest.raises(PolicyError, match=r"failed: KeyError: 'observation\.images\.side'"):
        policy[0].infer({"agent_pos": np.zeros(7), "task": ""})
