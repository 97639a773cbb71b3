"""Leaves: what the core works without. Each makes itself known here, once, and is read when needed.

Nothing in the core imports a leaf; a leaf imports the core, and no other leaf.
"""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, NamedTuple

from bridge.errors import MissingDependencyError

USES = START, RECORD, REVIEW, REBUILD, PLAN, EVALUATE, EXCHANGE = (
    "Start here",
    "Record",
    "Review",
    "Rebuild and replay",
    "Plan and gate",
    "Evaluate",
    "Exchange",
)
"""What one does with the commands, in the order of the help."""


class Command(NamedTuple):
    """One command of the front door."""

    name: str
    """As it is typed: ``record``, ``publish ur``."""
    target: str
    text: str
    example: str
    """What may follow the name."""
    use: str
    """What one does with it: the heading that it stands under."""


@dataclass(frozen=True, kw_only=True)
class Leaf:
    """Where a leaf lies, how to get it, and what it brings."""

    modules: tuple[str, ...]
    """Packages and modules that go with it."""
    extra: str
    purpose: str
    """What one wants it for, as a message ends."""
    entries: Mapping[str, str] = field(default_factory=dict)
    """What the core asks of it: ``module:name`` by a name of its own."""
    commands: tuple[Command, ...] = ()


def commands_of(use: str, module: str, table: str) -> tuple[Command, ...]:
    """Read a table: a command, what it does, what may follow it; its function is named like it."""
    rows = [[cell.strip() for cell in line.split("|")] for line in table.strip().splitlines()]
    return tuple(
        Command(name, f"{module}:{name.replace(' ', '_')}", text, example, use)
        for name, text, example in rows
    )


LEAVES: dict[str, Leaf] = {
    "open": Leaf(
        modules=("dashboards.opening", "dashboards.robot_file", "dashboards.scene_index"),
        extra="record",
        purpose="opening what others recorded",
        entries={"propose": "dashboards.robot_file:propose"},
        commands=commands_of(
            START,
            "dashboards.opening",
            "open | Say what a file or folder holds, or import it. | bags/monday runs/monday",
        ),
    ),
    "planner": Leaf(
        modules=("twin.plan",),
        extra="replay",
        purpose="planning",
        commands=commands_of(
            PLAN,
            "twin.plan.cli",
            "plan | Plan from words, or for a cell. | runs/x --task 'put the cube into the box'",
        ),
    ),
    "perception": Leaf(
        modules=("twin.scene.semantics", "twin.scene.foundation"),
        extra="foundation",
        purpose="naming the things of a scene",
        entries={
            "check_models": "twin.scene.foundation.stage:check_models",
            "name_things": "twin.scene.foundation.stage:write_scene_semantics",
        },
        commands=commands_of(
            REBUILD,
            "twin.scene.foundation.cli",
            'find | Find things of the scene by words. | runs/x "the box\'s rim"',
        ),
    ),
    "depth from colour": Leaf(
        modules=("twin.sweep",),
        extra="twin",
        purpose="rebuilding from colour alone",
        entries={"estimate": "twin.sweep.estimate:estimated_depth"},
    ),
    "policies": Leaf(
        modules=("twin.policies",),
        extra="policies",
        purpose="policies in the loop",
        commands=(
            *commands_of(
                EVALUATE,
                "twin.policies.cli",
                "rollout | Let a policy act in the twin. | runs/x --policy ws://127.0.0.1:8000",
            ),
            *commands_of(
                EXCHANGE, "twin.policies.cli", "export env | The twin for LeRobot. | runs/x DIR"
            ),
        ),
    ),
    "soft": Leaf(
        modules=(
            "twin.physics.soft",
            "twin.physics.soft_solver",
            "twin.physics.soft_world",
            "dashboards.soft_nodes",
        ),
        extra="replay",
        purpose="replaying soft objects",
        entries={
            "shape": "twin.physics.soft:shape_of",
            "world": "twin.physics.soft_world:SoftWorld",
            "bent": "dashboards.soft_nodes:bent",
        },
    ),
    "stand-in": Leaf(
        modules=(
            "bridge.sources.standin",
            "dashboards.standin_cli",
            "dashboards.standin_settings",
            "dashboards.demo",
            "dashboards.trials",
            "dashboards.learned",
        ),
        extra="standin",
        purpose="the stand-in cell",
        commands=(
            *commands_of(
                START,
                "dashboards.standin_cli",
                """
                demo | Run the whole loop on the stand-in cell, in minutes. | runs/demo
                trials | Try policies without and with replanning. | runs/study --trials 20
                """,
            ),
            *commands_of(
                RECORD,
                "bridge.sources.standin.cli",
                """
                publish standin | The stand-in cell: a simulated laboratory. | --trials 3 --seed 1
                """,
            ),
        ),
    ),
    "cluster": Leaf(
        modules=("twin.ray_cluster",),
        extra="cluster",
        purpose="replays on Ray",
        entries={"runner": "twin.ray_cluster:RayRunner"},
    ),
    "ur": Leaf(
        modules=("bridge.sources.ur",),
        extra="ur",
        purpose="publishing a UR arm",
        commands=commands_of(
            RECORD,
            "bridge.sources.ur.cli",
            "publish ur | A UR arm: joints, tool, gripper, modes. | 192.168.1.10 --cell lab",
        ),
    ),
    "realsense": Leaf(
        modules=("bridge.sources.realsense",),
        extra="realsense",
        purpose="publishing RealSense cameras",
        commands=commands_of(
            RECORD,
            "bridge.sources.realsense.cli",
            "publish realsense | RealSense cameras: colour, depth. | --camera side=123622270224",
        ),
    ),
    "lerobot": Leaf(
        modules=("bridge.exchange.lerobot",),
        extra="video",
        purpose="exchange with LeRobot",
        entries={
            "read_info": "bridge.exchange.lerobot.layout:read_info",
            "read_episodes": "bridge.exchange.lerobot.importing:read_episodes",
            "import": "bridge.exchange.lerobot.cli:import_lerobot",
        },
        commands=commands_of(
            EXCHANGE,
            "bridge.exchange.lerobot.cli",
            """
            import lerobot | A LeRobotDataset v3.0 or v2. | DIR runs/x --episodes 0-9
            export lerobot | Trials as a LeRobotDataset v3.0. | runs/x DIR
            """,
        ),
    ),
}


def has_leaf(name: str) -> bool:
    """Whether a leaf is here; what it needs may still be missing."""
    return name in LEAVES and all(map(_is_here, LEAVES[name].modules))


def _is_here(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # a package above it is gone, too
        return False


def load_leaf(name: str, entry: str) -> Any:
    """Return what a leaf brings under a name."""
    refuse_missing(name)
    module, _, attribute = LEAVES[name].entries[entry].partition(":")
    return getattr(importlib.import_module(module), attribute)


def refuse_missing(name: str) -> None:
    """Refuse to go on without a leaf."""
    if has_leaf(name):
        return
    leaf = LEAVES.get(name, Leaf(modules=(), extra="all", purpose=f"what is asked ({name})"))
    package = next((module for module in leaf.modules if not _is_here(module)), name)
    raise MissingDependencyError(package=package, extra=leaf.extra, purpose=leaf.purpose)


def leaf_commands() -> tuple[Command, ...]:
    """Commands that leaves bring."""
    return tuple(command for leaf in LEAVES.values() for command in leaf.commands)


def refuse_missing_command(tokens: Sequence[str]) -> None:
    """Refuse a command whose leaf is not here."""
    typed = " ".join(tokens[:2]) + " "
    for name, leaf in LEAVES.items():
        if any(typed.startswith(f"{command.name} ") for command in leaf.commands):
            refuse_missing(name)
