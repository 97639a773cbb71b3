"""Commands of the room ``dashboards``; imports stay late so that --help is quick."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.terminal import Output
from dashboards.config import DashboardConfig
from dashboards.demo import DemoConfig

OUTPUT = Output()
DASHBOARD = DashboardConfig()
DEMO = DemoConfig()


def dashboard(
    runs: list[Path],
    /,
    *,
    config: Annotated[DashboardConfig, Parameter(name="*")] = DASHBOARD,
    output: Output = OUTPUT,
) -> int:
    """Show the review pages of one or more runs until stopped.

    Example: robot-gst dashboard runs/monday runs/tuesday --port 0

    Args:
        runs: Run folders; the first one is shown first.
        config: Where to listen.
        output: How to talk.
    """
    from bridge.errors import MissingDependencyError, UsageError

    if not runs:
        raise UsageError("which run? For example: robot-gst dashboard runs/demo.")
    try:
        from dashboards.server import serve
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn", "jinja2"):
            raise
        raise MissingDependencyError(
            package=error.name, extra="dashboard", purpose="the dashboard"
        ) from error
    return serve(runs, config, output)


def demo(run: Path, /, *, config: DemoConfig = DEMO, output: Output = OUTPUT) -> int:
    """Run the whole loop on the stand-in cell: record, rebuild, replay, evaluate, show.

    Example: robot-gst demo runs/demo --quick

    Args:
        run: Run folder; made where needed. Episodes already there are kept and used.
        config: How much to do.
        output: How to talk.
    """
    from dashboards.demo import run_demo

    return run_demo(run, config, output)
