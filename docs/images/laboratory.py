"""Draw the tasks of the laboratory: the start, on the way, and the end, in one laboratory.

Example: .venv/bin/python docs/images/laboratory.py docs/images/laboratory.jpg --seed 1000001
Each row is one task, carried out by the scripted plan from where the objects are, seen by the
side camera.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from side_by_side import write_rows

from bridge.episode.cdr.messages import CompressedColor
from bridge.media.color import decode_color
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cell_file import draw_hidden, load_cell
from bridge.sources.standin.operator import execute_plan, label_trial
from bridge.sources.standin.planner import NO_ERROR, plan_pick_and_place
from bridge.sources.standin.streams import Streams
from bridge.task.task_file import load_task

TASKS = (
    "push_cube_to_mark",
    "stack_two_cubes",
    "slippery_block_into_box",
    "heavy_block_into_box",
    "sloth_over_rim",
)
FRACTIONS = (0.0, 0.45, 0.7, 1.0)
GAP_PX, TEXT_PX = 4, 18


class Film:
    """A wire that keeps the pictures of one camera."""

    def __init__(self) -> None:
        """Nothing was taken yet."""
        self.pictures: list[np.ndarray] = []

    def publisher(self, topic: str, type_name: str, **_: Any) -> "Film":
        """Keep what the side camera takes; forget the rest."""
        return self if topic.endswith("/cam/side/color/image") else Film()

    def put(self, data: bytes, *, source_ns: int) -> None:
        """Keep a picture, where it is one."""
        try:
            self.pictures.append(decode_color(CompressedColor.from_cdr(data).data))
        except Exception:  # noqa: BLE001  # another topic's
            return

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Nobody is asked."""
        raise NotImplementedError


def filmed(name: str, seed: int, start: int) -> tuple[list[np.ndarray], str]:
    """Carry one task out, and return some of its pictures and how it ended."""
    task = load_task(name)
    file = load_cell(task.cell)
    film = Film()
    cell = StandinCell(
        file,
        task,
        draw_hidden(file, seed, task),
        Streams(film, "lab"),
        rate_hz=1.0,
        seed=seed,
        start_ns=0,
    )
    cell.reset(task.draw_start(np.random.default_rng(start)))
    plan = plan_pick_and_place(
        task,
        cell.world.Ts_base_object(),
        NO_ERROR,
        kinematics=cell.kinematics,
        joints_start_rad=cell.home_rad,
        max_joint_speed_rad_s=file.max_joint_speed_rad_s,
        plan_id="plan",
        condition="without_replanning",
        start_id="start",
    )
    cell.cameras_running = True
    execute_plan(cell, plan)
    outcome = label_trial(cell.world.task, cell.truth, executed=True)
    last = len(film.pictures) - 1
    return [film.pictures[round(part * last)] for part in FRACTIONS], outcome.result


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1_000_001)
    parser.add_argument("--start", type=int, default=1_000_001_000)
    asked = parser.parse_args()
    rows = []
    for name in TASKS:
        pictures, result = filmed(name, asked.seed, asked.start)
        gap = np.full((pictures[0].shape[0], GAP_PX, 3), 255, dtype=np.uint8)
        row = np.hstack([part for image in pictures for part in (image, gap)][:-1])
        heading = Image.new("RGB", (row.shape[1], TEXT_PX), "white")
        ImageDraw.Draw(heading).text((2, 3), f"{name}: {result}", fill="black")
        rows.append(np.vstack([np.asarray(heading), row]))
    write_rows(rows, asked.out)


if __name__ == "__main__":
    main()
