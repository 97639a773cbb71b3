"""docs/tutorials/record_live.md, "Your own cell", typed in a laboratory that nobody plans for."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pyrealsense2 as rs
from joint_by_joint import BESIDE_M, move_by_hand
from loopback import free_endpoint
from rtde_server import RtdeServer
from software_camera import SoftwareCamera

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
from bridge.geometry import se3  # noqa: E402
from bridge.robots.default import MAX_WIDTH_M  # noqa: E402
from bridge.sources.realsense import publish  # noqa: E402
from bridge.sources.standin.cell import TICK_NS, StandinCell  # noqa: E402
from bridge.sources.standin.cell_file import CellFile, draw_hidden, load_cell  # noqa: E402
from bridge.sources.standin.kinematics import arm_kinematics  # noqa: E402
from bridge.sources.standin.scan import joint_move, scan_joints  # noqa: E402
from bridge.task.find import chosen_task_file  # noqa: E402
from robot_gst import run as type_here  # noqa: E402

SEED, TASK = 7, "cube_into_box"
SERIALS = {"side": "123622270224", "wrist": "230322271234"}
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""From the controller's base to base_link."""


class Tape:
    """What controller and cameras show, tick by tick; takes the place of the cell's topics."""

    def __init__(self, cell: StandinCell | None = None) -> None:
        """Begin empty."""
        self.cell, self.width_m = cell, MAX_WIDTH_M
        self.robot: list[dict[str, Any]] = []
        self.frames: list[tuple[int, str, np.ndarray, np.ndarray]] = []

    def joints(self, position: np.ndarray, velocity: np.ndarray, *_: object) -> None:
        T = self.cell.kinematics.T_base_tcp(position)
        pose = [*HALF_TURN @ T[:3, 3], *pinocchio.log3(HALF_TURN @ T[:3, :3])]
        closed = 255 * (1 - self.width_m / MAX_WIDTH_M)
        sample = {"actual_q": list(position), "actual_qd": list(velocity), "robot_mode": 7}
        sample |= {"actual_TCP_pose": pose, "safety_mode": 1, "output_double_register_0": closed}
        self.robot.append({"target_q": list(position), "speed_scaling": 1.0, **sample})

    def gripper(self, width_m: float, _: int) -> None:
        self.width_m = width_m

    def frame(self, camera: str, color: np.ndarray, depth: np.ndarray, _: int) -> None:
        self.frames.append((len(self.robot), camera, color, depth))

    def __getattr__(self, name: str) -> Any:
        """Nobody publishes plans, events or the truth here."""
        return lambda *_, **__: None


def perform(file: CellFile) -> dict[str, Tape]:
    """Let the laboratory do everything beforehand: a scan and three trials, from home to home."""
    task = chosen_task_file(TASK).task()
    hidden, how = draw_hidden(file, SEED, task), {"rate_hz": 1.5, "scale": 2.0}
    cell = StandinCell(file, task, hidden, Tape(), seed=SEED, start_ns=0, **how)
    tapes = {}
    for name, start in {"scan_1": 1, "trial_1": 1, "trial_2": 2, "trial_3": 3}.items():
        tape = tapes[name] = cell.streams = Tape(cell)
        poses = task.draw_start(np.random.default_rng([SEED, start]))
        cell.reset(poses)
        cell.wait(1.0)
        cell.capture()
        if name == "scan_1":
            at = cell.home_rad
            for stop in scan_joints(file.cameras["wrist"], cell.kinematics, at):
                cell.follow(*joint_move(at, stop, file.max_joint_speed_rad_s))
                cell.wait(0.2)
                cell.capture()
                at = stop
        else:
            cell.cameras_running = True
            move_by_hand(cell, poses, BESIDE_M * (start == 2))
            at = np.array(tape.robot[-1]["actual_q"])
        cell.follow(*joint_move(at, cell.home_rad, file.max_joint_speed_rad_s / 2))
        cell.cameras_running = False
        cell.wait(1.0)
        cell.capture()
    return tapes


class Laboratory:
    """Plays tapes in real time: rests at the first tick, moves when told, rests at the last."""

    def __init__(self, tape: Tape, cameras: dict[str, SoftwareCamera]) -> None:
        """Rest."""
        self.tape, self.moves_from = tape, None
        self._cameras, self._number, self._began_ns = cameras, 0, 0

    def state(self, number: int) -> dict[str, object]:
        """What the controller says in its n-th sample."""
        self._began_ns = self._began_ns or time.time_ns() - number * TICK_NS
        self._number = number
        return self.tape.robot[min(self.tick(), len(self.tape.robot) - 1)]

    def tick(self) -> int:
        return 0 if self.moves_from is None else max(0, self._number - self.moves_from)

    def move(self) -> None:
        """Play the tape to its end."""
        self.moves_from = self._number + 1
        while self.tick() < len(self.tape.robot):
            time.sleep(0.1)

    def take_pictures(self) -> None:
        """Send each frame at its tick; at rest the latest one again, five times a second."""
        sent, shown = dict.fromkeys(self._cameras, 0), dict.fromkeys(self._cameras, -1)
        for turn in count():
            time.sleep(0.02)
            tape, tick, from_ = self.tape, self.tick(), self.moves_from
            rests = from_ is None or tick >= len(tape.robot)
            for camera, device in self._cameras.items():
                frames = [each for each in tape.frames if each[1] == camera]
                at, _, color, depth = ([f for f in frames if f[0] <= tick] or frames[:1])[-1]
                if turn % 10 if rests else at > tick or at == shown[camera]:
                    continue
                shown[camera] = at
                stamp_ns = self._began_ns + (self._number if rests else from_ + at) * TICK_NS
                device.send(sent[camera], stamp_ns / 1e6, color=color, depth=depth)
                sent[camera] += 1


def typed(words: str, *, waits: bool = True) -> "subprocess.Popen[bytes]":
    """Type a command; wait for it, unless it stays."""
    print(f"$ robot-gst {words}", flush=True)
    child = subprocess.Popen([sys.executable, ROOT / "robot_gst.py", *words.split()], cwd=ROOT)
    if waits and child.wait():
        raise SystemExit(f"robot-gst {words} ended with {child.returncode}")
    return child


def record(lab: Laboratory, tapes: dict[str, Tape], here: str) -> None:
    """Type all that is typed while the cameras run, then end them."""
    gripper = "--gripper double_register:0 --gripper-closed-value 255 --gripper-open-m 0.085"
    try:
        with RtdeServer(lab.state) as controller:
            port = f"--port {controller.port} --rate-hz {1e9 / TICK_NS:g}"
            arm = typed(f"publish ur 127.0.0.1 {port} --cell lab {gripper} {here}", waits=False)
            threading.Thread(target=lab.take_pictures, daemon=True).start()
            time.sleep(10.0)
            for name, tape in tapes.items():
                lab.moves_from, lab.tape = None, tape
                kind, _, number = name.partition("_")
                typed(f"ctl start --id {name} --kind {kind} --cell lab --task {TASK} {here}")
                time.sleep(1.5)
                lab.move()
                time.sleep(1.5)
                result = f"--result {'failure' if number == '2' else 'success'} "
                typed(f"ctl stop {result if kind == 'trial' else ''}{here}")
            arm.send_signal(signal.SIGINT)
            arm.wait()
    finally:
        os.kill(os.getpid(), signal.SIGINT)


def main(run: Path) -> int:
    """Play the laboratory and type the recipe."""
    file = load_cell(chosen_task_file(TASK).task().cell)
    tapes, cameras, mounts = perform(file), {}, {}
    arm, zeros = arm_kinematics(), np.zeros(6)
    T_tcp_tool0 = se3.invert(arm.T_base_tcp(zeros)) @ arm.T_base_frame(zeros, "tool0")
    for name, mount in file.cameras.items():
        camera, lens = mount.camera.scaled(2.0), rs.intrinsics()
        lens.width, lens.height = camera.width, camera.height
        lens.fx, lens.fy, lens.ppx, lens.ppy = camera.to_ros()
        cameras[name] = SoftwareCamera(serial=SERIALS[name], lens=lens)
        T = mount.T_parent_camera
        q, p = se3.split(T_tcp_tool0 @ T if mount.moving else T)
        parent = "tool0_controller" if mount.moving else mount.parent
        mounts[name] = {"parent": parent, "p_m": p.tolist(), "q_wxyz": q.tolist()}
    run.mkdir(parents=True)
    (run / "mounts.json").write_text(json.dumps(mounts))
    publish.attached_devices = lambda: lambda: [each.device for each in cameras.values()]
    lab, endpoint = Laboratory(tapes["scan_1"], cameras), free_endpoint()
    recorder = typed(f"record {run} --listen {endpoint}", waits=False)
    time.sleep(5.0)
    here = f"--connect {endpoint}"
    threading.Thread(target=record, args=(lab, tapes, here)).start()
    serials = " ".join(f"--camera {name}={SERIALS[name]}" for name in cameras)
    type_here(f"publish realsense --cell lab {serials} --mounts {run}/mounts.json {here}".split())
    recorder.send_signal(signal.SIGINT)
    recorder.wait()
    for words in ("check RUN", "rebuild RUN --iterations 300", "replay RUN", "evaluate RUN"):
        typed(words.replace("RUN", str(run)))
    measured = json.loads((run / "results" / "results.json").read_text())["measurements"]
    (agreement,) = [m for m in measured if m["id"] == "agreement.sim_executed.rate"]
    print(json.dumps(agreement, indent=1))
    return 0 if agreement["n"] else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
