"""Commands that run the stand-in cell from end to end; imports stay late."""

from pathlib import Path

from bridge.terminal import Output
from dashboards.standin_settings import DemoConfig, TrialsConfig

OUTPUT, DEMO, TRIALS = Output(), DemoConfig(), TrialsConfig()


def demo(run: Path, /, *, config: DemoConfig = DEMO, output: Output = OUTPUT) -> int:
    """Run the whole loop on the stand-in cell: record, rebuild, replay, evaluate, show.

    Example: robot-gst demo runs/demo --quick

    Args:
        run: Run folder; made where needed. The same command again goes on where it was stopped.
        config: How much to do.
    """
    from dashboards.demo import run_demo

    return run_demo(run, config, output)


def trials(run: Path, /, *, config: TrialsConfig = TRIALS, output: Output = OUTPUT) -> int:
    """Try policies on the same starts, without and with replanning, in the stand-in cell.

    Example: robot-gst trials runs/study --task cube_into_box --trials 20
    With a coin in the gate's place too:
    robot-gst trials runs/study --arms without with control --coin 0.4

    Args:
        run: Run folder; made where needed. The same command again goes on where it was stopped.
        config: What the study does; written to protocol.json before the first trial.
    """
    from dashboards.trials import run_trials

    return run_trials(run, config, output)
