r"""Learn a small policy from recorded trials, by behaviour cloning on a CPU, and serve it.

It looks through all cameras, knows joints and fingers, and answers with the next moments of both.
Demonstrations are the trials of a run that succeeded, one task a run; in the stand-in cell:

    robot-gst trials runs/demos --policies nominal --arms without --trials 200 --first-start 100
    pip install 'robot-gst[policies]' torch
    python clone.py runs/demos clone.pt
    CLONE=clone.pt robot-gst rollout runs/lab --policy clone:Clone --name clone
"""

import hashlib
import os
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import nn

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import GRIPPER_STATE

SIZE = (96, 72)
ROWS, FOLLOWED, STEP_S = 12, 4, 0.1
"""Rows that are learned, how many of them are an answer, and the time that each has."""
SPEED_RAD_S, RAD_PER_M = 0.5, 10.0
"""What is learned is the way and not the pace: the joint that moves most goes at this speed, and
fingers that move so far take as long."""
NOISE_RAD = 5e-4
"""Joints that move less in 20 ms rest."""
LATE_S = 0.2
"""A picture of the cell is up to so old when the policy is asked."""
STEPS, BATCH, RATE = 4000, 32, 1e-3


class Demo(NamedTuple):
    """A trial; the cameras take their pictures together."""

    pictures: np.ndarray  # num_cameras num_times 3 height width
    pictures_s: np.ndarray
    track: np.ndarray  # joints, width, and 1 where the fingers close or are closed
    track_s: np.ndarray


def small(picture: np.ndarray) -> np.ndarray:
    """What the network gets of a picture, channels first."""
    return np.array(Image.fromarray(picture).resize(SIZE, Image.Resampling.BOX)).transpose(2, 0, 1)


def read(episode: Episode) -> Demo:
    """Read a trial."""
    joints, width = streams.joint_track(episode), streams.joint_track(episode, GRIPPER_STATE)
    at_ns = np.arange(joints.stamps_ns[0], joints.stamps_ns[-1], 20_000_000)
    tracks = [(joints, column) for column in joints.position.T] + [(width, width.position[:, 0])]
    track = np.column_stack([np.interp(at_ns, one.stamps_ns, x) for one, x in tracks])
    closes = -np.sign(np.diff(track[:, -1], prepend=track[0, -1]).round(3))
    latest = np.maximum.accumulate(np.where(closes, np.arange(len(closes)), 0))
    steps = np.abs(np.diff(track, axis=0)) * np.append(np.ones(track.shape[1] - 1), RAD_PER_M)
    way = np.append(0, np.cumsum(np.where(steps.max(1) > NOISE_RAD, steps.max(1), 1e-6)))
    seen = [list(streams.color_images(episode, name)) for name in streams.camera_ids(episode)]
    count = min(len(items) for items in seen)
    taken_ns = [item.stamp_ns for item in seen[0][:count]]
    return Demo(
        np.array([[small(item.image_u8()) for item in items[:count]] for items in seen]),
        np.interp(taken_ns, at_ns, way / SPEED_RAD_S),
        np.column_stack([track, closes[latest] > 0]),
        way / SPEED_RAD_S,
    )


class Net(nn.Module):
    """An eye for each camera finds points in its picture; a perceptron says where to go."""

    def __init__(self, num_cameras: int, num_joints: int) -> None:
        """Nothing is learned yet."""
        super().__init__()
        self.eyes = nn.ModuleList(self._eye() for _ in range(num_cameras))
        self.head = nn.Sequential(
            *(nn.Linear(num_cameras * 64 + num_joints + 1, 256), nn.ReLU()),
            *(nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, ROWS * (num_joints + 1))),
        )
        self.register_buffer("mean", torch.zeros(num_joints + 1))
        self.register_buffer("spread", torch.ones(num_joints + 1))
        self.register_buffer("open_m", torch.zeros(()))

    def _eye(self) -> nn.Module:
        layers: list[nn.Module] = []
        for num_in, num_out, size, stride in ((3, 32, 6, 4), (32, 32, 3, 1), (32, 32, 3, 1)):
            layers += [nn.Conv2d(num_in, num_out, size, stride, 1), nn.BatchNorm2d(num_out)]
            layers.append(nn.ReLU())
        return nn.Sequential(*layers, nn.Conv2d(32, 32, 1))

    def forward(self, pictures: torch.Tensor, posture: torch.Tensor) -> torch.Tensor:
        """Joints of the next rows, and how surely (a logit) the fingers are closed."""
        found = [(posture - self.mean) / self.spread]
        for eye, picture in zip(self.eyes, pictures.unbind(1), strict=True):
            maps = 3 * eye(4 * picture - 2)
            weight = maps.flatten(2).softmax(-1).view_as(maps)
            for axis in (2, 3):  # where each map is largest
                line = torch.linspace(-1, 1, maps.shape[axis])
                found.append((weight.sum(5 - axis) * line).sum(-1))
        rows = self.head(torch.cat(found, 1)).view(len(posture), ROWS, -1)
        joints = posture[:, None, :-1] + rows[..., :-1] * self.spread[:-1]
        return torch.cat([joints, rows[..., -1:]], -1)


def error_of(net: Net, demos: list[Demo], rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
    """Mean errors of the joints [rad] and of the gripper, at random moments."""
    pictures, postures, rows = [], [], []
    for number in rng.integers(len(demos), size=BATCH):
        demo = demos[number]
        k = int(rng.integers(len(demo.pictures_s)))
        times = demo.pictures_s[k] + rng.uniform(0, LATE_S) + STEP_S * np.arange(ROWS + 1)
        track = np.array([np.interp(times, demo.track_s, x) for x in demo.track.T]).T
        pictures.append(demo.pictures[:, k] * rng.uniform(0.9, 1.1, (1, 3, 1, 1)))
        postures.append(track[0, :-1] + np.append(rng.normal(0, 0.01, track.shape[1] - 2), 0))
        rows.append(track[1:])
    seen, posture, wanted = (
        torch.from_numpy(np.array(each)).float() for each in (pictures, postures, rows)
    )
    found = net((seen + 3 * torch.randn(seen.shape)) / 255, posture)
    closed = (wanted[..., -1] > 0.5).float()
    gripper = nn.functional.binary_cross_entropy_with_logits(found[..., -1], closed)
    return (found[..., :-1] - wanted[..., :-2]).abs().mean(), gripper


def train(demos: list[Demo]) -> Net:
    """Learn from nine tenths; the others say how well."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    held, demos = demos[::10], [demo for k, demo in enumerate(demos) if k % 10]
    tracks = torch.from_numpy(np.concatenate([demo.track[:, :-1] for demo in demos])).float()
    net = Net(len(demos[0].pictures), tracks.shape[1] - 1)
    net.mean, net.spread, net.open_m = tracks.mean(0), tracks.std(0) + 1e-3, tracks[:, -1].max()
    adam = torch.optim.AdamW(net.parameters(), RATE)
    slower = torch.optim.lr_scheduler.OneCycleLR(adam, RATE, STEPS)
    for step in range(1, STEPS + 1):
        joints, gripper = error_of(net, demos, rng)
        adam.zero_grad()
        (10 * joints + 0.1 * gripper).backward()
        adam.step()
        slower.step()
        if step % 500 == 0:
            with torch.no_grad():
                net.eval()
                new = np.mean([error_of(net, held, rng)[0].item() for _ in range(16)])
            print(
                f"{step}: joints off by {1e3 * joints.item():.1f} mrad, by {1e3 * new:.1f} in new"
            )
    return net


class Clone:
    """The policy of a checkpoint, which the environment variable CLONE names."""

    def __init__(self) -> None:
        """Load it."""
        path = Path(os.environ.get("CLONE", "clone.pt"))
        self.metadata = {"checkpoint": hashlib.sha256(path.read_bytes()).hexdigest()[:12]}
        weights = torch.load(path, weights_only=True)
        num_cameras = len({name.split(".")[1] for name in weights if name.startswith("eyes")})
        self._net = Net(num_cameras, len(weights["mean"]) - 1)
        self._net.load_state_dict(weights)
        self._net.eval()

    @torch.no_grad()
    def infer(self, observation: dict) -> np.ndarray:
        """Joints and width of the next moments."""
        seen = np.array([[small(picture) for picture in observation["pixels"].values()]])
        posture = torch.from_numpy(observation["agent_pos"])[None]
        rows = self._net(torch.from_numpy(seen).float() / 255, posture)[0, :FOLLOWED]
        steps = torch.diff(rows[:, :-1], dim=0, prepend=posture[:, :-1])
        fast = steps.abs().amax(1, keepdim=True) / (1.2 * SPEED_RAD_S * STEP_S)
        joints = posture[:, :-1] + (steps / fast.clamp(min=1)).cumsum(0)
        width_m = self._net.open_m * (rows[:, -1:] < 0)
        return torch.cat([joints, width_m], 1).numpy()


if __name__ == "__main__":
    RUN = RunFolder.open(Path(sys.argv[1]))
    TRIALS = [e for e in map(Episode.open, RUN.episodes()) if e.info.kind == "trial"]
    DONE = [e for e in TRIALS if (outcome := outcome_of(RUN, e)) and outcome.result == "success"]
    print(f"learns from {len(DONE)} of {len(TRIALS)} trials: those that succeeded")
    torch.save(train([read(episode) for episode in DONE]).state_dict(), sys.argv[2])
