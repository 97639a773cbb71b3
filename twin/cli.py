"""Commands of the package ``twin``; imports stay late so that --help is quick."""

from pathlib import Path
from typing import Any

from bridge.episode.run_folder import RunFolder, refuse_full
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.gate.config import GateConfig
from twin.replay.config import ReplayRunConfig
from twin.scene.settings import RebuildConfig, RenderConfig

OUTPUT = Output()
REPLAY = ReplayRunConfig()
REBUILD = RebuildConfig()
RENDER = RenderConfig()
CALIBRATE = CalibrateConfig()


def replay(run: Path, /, *, config: ReplayRunConfig = REPLAY, output: Output = OUTPUT) -> int:
    """Replay every plan and every execution of a run, and judge each: I(tau).

    A trial needs joint states and a task; a plan is not needed. Exit code 2 where an episode has
    nothing to replay, with the reason for each.
    Example: robot-gst replay runs/today

    Args:
        run: Run folder.
    """
    from twin.calibrate.physics.imported import replay_imported
    from twin.replay.runner import replay_run
    from twin.replay.summary import describe_run

    folder = RunFolder.open(run)
    with folder.alone_in(folder.derived_dir):
        summary = replay_run(folder, config, output, replay_imported(folder, config, output))
    output.result(summary, describe_run(summary))
    if summary["skipped_episodes"] or any(row["error"] for row in summary["rows"]):
        return 1
    return 2 if summary["nothing_to_replay"] or not (summary["rows"] or summary["imported"]) else 0


def gate(
    run: Path,
    /,
    *,
    config: GateConfig = GateConfig(),  # noqa: B008 (frozen)
    output: Output = Output(),  # noqa: B008 (frozen)
) -> int:
    """Judge plans live over zenoh, before the robot moves; stop with Ctrl-C.

    Example: robot-gst gate runs/today --cell standin --task cube_into_box

    Args:
        run: Run folder with the rebuilt scene.
    """
    from twin.gate.service import run_gate

    return run_gate(run, config, output)


def rebuild(run: Path, /, *, config: RebuildConfig = REBUILD, output: Output = OUTPUT) -> int:
    """Rebuild the static scene as Gaussians, and render the held-out views.

    Example: robot-gst rebuild runs/monday --budget 60s

    Args:
        run: Run folder.
    """
    from twin.scene.rebuild.record import describe_scene
    from twin.scene.rebuild.run import rebuild as rebuild_scene

    folder = RunFolder.open(run)
    with folder.alone_in(folder.scene_dir):
        record = rebuild_scene(folder, config, output)
    output.result(record, describe_scene(record))
    return 0


def render(run: Path, /, *, config: RenderConfig = RENDER, output: Output = OUTPUT) -> int:
    """Draw the rebuilt scene: one image in any state, or a whole trial as a video.

    Example: robot-gst render runs/monday --camera wrist --at-s 3 --object cube=0.5,-0.1,0.02
    Example: robot-gst render runs/monday --episode trial_0001 --camera side --out trial.mp4

    Args:
        run: Run folder.
    """
    from twin.scene.render import describe_drawn
    from twin.scene.render import render as render_scene

    drawn = render_scene(RunFolder.open(run), config)
    output.result(drawn, describe_drawn(drawn))
    return 0


def robot_check(robot: str, /, *, urdf_out: Path | None = None, output: Output = OUTPUT) -> int:
    """Look at a robot file: its joints, limits, frames and gripper, and what is unsupported.

    Example: robot-gst robot check mine.toml --urdf-out mine.urdf

    Args:
        robot: Robot file, the name of one that ships, or a URDF.
        urdf_out: Write the description that carries the record there, to be published.
    """
    from twin.robot.check import check_robot, describe_robot

    found = check_robot(robot, urdf_out=urdf_out)
    output.result(found, describe_robot(found))
    return 2 if found["hulls"] is None else 0


def calibrate(run: Path, /, *, config: CalibrateConfig = CALIBRATE, output: Output = OUTPUT) -> int:
    """Find out from recorded episodes where the cameras are, or how contact works.

    Writes scene/calibration.json.
    Example: robot-gst calibrate runs/monday --cameras
    From imported pushes, or trials' efforts: robot-gst calibrate runs/kinova --physics
    From trials: robot-gst calibrate runs/monday --posterior

    Args:
        run: Run folder.
    """
    from bridge.errors import UsageError

    if config.cameras + config.physics + config.posterior != 1:
        raise UsageError("say what to calibrate: RUN with --cameras, --physics or --posterior.")
    folder = RunFolder.open(run)
    with folder.alone_in(folder.scene_dir):
        refuse_full(folder.scene_dir)
        output.result(*_calibrated(folder, config, output))
    return 0


def _calibrated(
    run: RunFolder, config: CalibrateConfig, output: Output
) -> tuple[dict[str, Any], str]:
    if config.posterior:
        from twin.calibrate.posterior import calibrate_posterior, describe_posterior

        posterior, calibration_id = calibrate_posterior(
            run, num_draws=config.draws, workers=config.workers, output=output
        )
        record = {**posterior, "calibration_id": calibration_id}
        return record, describe_posterior(posterior, calibration_id)
    if config.physics:
        from twin.calibrate.physics.arm_motion import calibrate_physics

        return calibrate_physics(run, config, output)
    from twin.calibrate.cameras import calibrate_cameras, describe_cameras

    record = calibrate_cameras(run, config, output)
    return record, describe_cameras(record)
