"""Where bodies of imported runs end: against NumPy, pairs, runs something was fitted to."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float

from bridge.episode import schema
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import TCP_POSE, cell_topic, object_topic
from bridge.episode.writer import EpisodeWriter
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare import compare_run
from evaluator.compare.end_points import body_distance
from evaluator.motion_measurements import BODY_DISTANCES

Way = Float[np.ndarray, "num_samples 3"]
ENGINE = "twin executed calibrated"


def way(end_m: float, num: int = 30, bend_m: float = 0.0) -> Way:
    """From the origin along x, with a bend to the side."""
    t = np.linspace(0.0, 1.0, num)
    return np.stack([end_m * t, bend_m * np.sin(np.pi * t), np.zeros(num)], axis=1)


def write(path: Path, info: EpisodeInfo, bodies: dict[str, Way], derived: Derived | None) -> None:
    """One run of a tool and objects at 100 Hz."""
    with EpisodeWriter(path) as writer:
        writer.describe(info, derived=derived)
        for name, p_m in bodies.items():
            topic = (
                cell_topic("lab", TCP_POSE) if name == "tool" else object_topic("lab", name, "pose")
            )
            for index, p in enumerate(p_m):
                T = np.eye(4)
                T[:3, 3] = p
                stamp_ns = 10_000_000 * (index + 1)
                sample = PoseSample(stamp_ns=stamp_ns, frame_id="world", T_frame_body=T)
                writer.write(
                    topic, sample.to_cdr(), type_name=schema.POSE_STAMPED, log_time_ns=stamp_ns
                )


Made = dict[str, dict[str, Way]]


@pytest.fixture
def lab(tmp_path: Path) -> Callable[..., tuple[RunFolder, Made]]:
    """Eight recorded pushes, a replay of each, two runs of another simulator."""

    def make(fitted: tuple[str, ...] = (), lamp_m: float = 0.0) -> tuple[RunFolder, Made]:
        run = RunFolder.create(tmp_path / "run")
        run.derived_dir.mkdir()
        made: Made = {}

        def add(name: str, bodies: dict[str, Way], derived: Derived | None, of: str = "") -> None:
            made[name] = bodies
            folder = run.episodes_dir if derived is None else run.derived_dir
            info = EpisodeInfo(id=of or name, kind="imported", task="push", cell="lab")
            write(folder / f"{name}.mcap", info, bodies, derived)

        for index in range(8):
            name = f"push_{index}"
            tool, cube = way(0.3 + 0.001 * index), way(0.1 + 0.002 * index, bend_m=0.004)
            add(name, {"tool": tool, "cube": cube, "lamp": way(lamp_m)}, None)
            off_m = 0.001 * (index + 1) * (-1) ** index
            replay = {"tool": tool, "cube": way(0.1 + 0.002 * index + off_m)}
            settings = {"fitted_to": list(fitted)}
            add(
                f"{name}.replay",
                replay | {"lamp": way(lamp_m)},
                Derived(
                    kind="replay",
                    source_episode=name,
                    source_sha256="0" * 64,
                    trajectory="executed",
                    engine="twin",
                    calibration_id="abcd1234",
                    settings=settings,
                ),
                of=name,
            )
        for number in range(2):
            free = Derived(kind="replay", source_episode="", source_sha256="", engine="other")
            bodies = {"tool": way(0.31), "cube": way(0.15 + 0.01 * number) + 0.02}
            add(f"other_{number}", bodies, free)
        return run, made

    return make


def value(run: RunFolder, engine: str, name: str, body: str = "cube") -> Any:
    slug = engine.replace(" ", "_")
    return compare_run(run).results().get(f"body.push.{slug}.{body}.{name}_median_m")


def test_a_replay_is_compared_with_the_run_it_was_made_from(lab: Any) -> None:
    run, made = lab()
    ends = []
    for index in range(8):
        mine, other = made[f"push_{index}"]["cube"], made[f"push_{index}.replay"]["cube"]
        ends.append(np.linalg.norm(mine[-1] - other[-1]))
    found = value(run, ENGINE, "end_point")
    assert found.value == pytest.approx(np.median(ends), abs=1e-9)
    assert found.value == pytest.approx(0.0045)
    # The narrowest pair of order statistics that holds a median of 8 with 95 %.
    assert (found.n, found.interval.low, found.interval.high) == (
        8,
        pytest.approx(0.001),
        pytest.approx(0.008),
    )
    assert 0.002 < value(run, ENGINE, "path_mean").value < 0.006  # the bend that no replay has
    assert value(run, ENGINE, "end_point", "tool").value == pytest.approx(0.0, abs=1e-12)


def test_other_simulated_runs_are_compared_with_every_recorded_one(lab: Any) -> None:
    run, made = lab()
    others = [made[f"other_{number}"]["cube"] for number in range(2)]
    ends, ways = [], []
    for index in range(8):
        mine = made[f"push_{index}"]["cube"]
        ends.append(np.mean([np.linalg.norm(mine[-1] - other[-1]) for other in others]))
        moved = [np.linalg.norm(mine[-1] - mine[0] - (other[-1] - other[0])) for other in others]
        ways.append(np.mean(moved))
    assert value(run, "other", "end_point").value == pytest.approx(np.median(ends), abs=1e-9)
    # Where it starts plays no part in how far it is moved.
    assert value(run, "other", "displacement").value == pytest.approx(np.median(ways), abs=1e-9)
    assert np.median(ways) < np.median(ends) - 0.005


def test_the_nearest_engine_stands_first_and_is_named(lab: Any) -> None:
    run, _ = lab()
    (table,) = compare_run(run).tables
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    errors = [row["end-point error (mm)"] for row in rows if row["body"] == "cube"]
    assert len(errors) == 2
    assert errors == sorted(errors)
    engines = [row["engine"] for row in rows if row["body"] == "cube"]
    nearest = min(engines, key=lambda engine: value(run, engine, "end_point").value)
    assert engines[0] == nearest
    assert f"cube: {nearest}, {errors[0]} mm" in table.note


def test_runs_something_was_fitted_to_do_not_count_and_are_named(lab: Any) -> None:
    fitted = ("push_0", "push_2", "push_4", "push_6")
    run, _ = lab(fitted=fitted)
    comparison = compare_run(run)
    found = value(run, ENGINE, "end_point")
    assert found.n == 4
    assert found.value == pytest.approx(np.median([0.002, 0.004, 0.006, 0.008]))
    assert found.interval is None
    assert "4 values" in found.reason_without_interval
    named = {e.episode for e in comparison.exclusions if "fitted to this run" in e.reason}
    assert named == set(fitted)
    assert value(run, "other", "end_point").n == 8


@pytest.mark.parametrize(("lamp_m", "compared"), [(0.009, False), (0.011, True)])
def test_what_recorded_runs_do_not_move_is_not_compared(
    lab: Any, lamp_m: float, *, compared: bool
) -> None:
    run, _ = lab(lamp_m=lamp_m)
    ids = [m.id for m in compare_run(run).measurements if ".lamp." in m.id]
    assert bool(ids) is compared


def test_of_two_replays_of_one_run_the_newest_counts(lab: Any) -> None:
    run, made = lab()
    old = made["push_0.replay"]["cube"]
    info = EpisodeInfo(id="push_0", kind="imported", task="push", cell="lab")
    derived = Derived(
        kind="replay",
        source_episode="push_0",
        source_sha256="0" * 64,
        trajectory="executed",
        engine="twin",
        calibration_id="ffff0000",
    )
    bodies = {"tool": way(0.3), "cube": old + np.array([0.05, 0.0, 0.0])}
    write(run.derived_dir / "push_0.again.mcap", info, bodies, derived)
    newest = [0.051, *(0.001 * n for n in range(2, 9))]  # it was 1 mm off, now 51
    assert value(run, ENGINE, "end_point").value == pytest.approx(np.median(newest), abs=1e-5)


def test_another_clock_and_a_late_start_leave_the_same_path_and_the_lag_is_told_apart() -> None:
    t_s = np.linspace(0.0, 3.0, 301)

    def track(first_s: float, waits_s: float, off_m: float = 0.0) -> PoseTrajectory:
        s = np.clip((t_s - waits_s) / 2.0, 0.0, 1.0)
        p_m = np.stack([0.3 * s * s * (3 - 2 * s), off_m + 0 * s, 0 * s], axis=1)
        stamps = (1e9 * (first_s + t_s)).round().astype(np.int64)
        return PoseTrajectory(stamps, p_m, np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1)))

    recorded = track(1000.0, 0.5)
    same = body_distance(recorded, track(7.0, 0.1))
    assert same["path_mean_m"] == pytest.approx(0.0, abs=2e-4)
    assert same["lag_s"] == pytest.approx(0.0, abs=0.011)
    beside = body_distance(recorded, track(7.0, 0.1, off_m=0.004))
    assert beside["path_mean_m"] == pytest.approx(0.004, abs=2e-4)
    assert beside["displacement_m"] == pytest.approx(0.0, abs=1e-9)
    assert beside["end_point_m"] == pytest.approx(0.004)
    still = track(0.0, 9.0)
    assert body_distance(still, still) == dict.fromkeys(BODY_DISTANCES, 0.0)
