"""A robot file for a URDF that comes without one: its arm, its tool and what may open its gripper.

A URDF says how links hang together, not which of them are an arm. What is chosen here by the
order of the joints and by the names of links is a proposal, to be looked at.
"""

import json
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from bridge.errors import PathNotFoundError, UsageError
from bridge.robots.robot import NUM_JOINTS, PACKAGE, Finger, Gripper, Robot, number_of
from bridge.terminal import Output

FINGERS = re.compile(
    r"finger|grip|jaw|knuckle|thumb|index|middle|little|pinky|(^|_)(ring|hand)_", re.IGNORECASE
)
JAWS = re.compile(r"finger|jaw|knuckle", re.IGNORECASE)
FINGER_M = 0.15
"""A joint at the end that slides by less opens something."""
TOOLS = ("tcp", "tool0", "grasp", "ee", "eef", "effector", "tool", "flange")
"""What frames of tools are called, the surest first."""
MOST_NAMED, MOST_JOINTS = 5, 500


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF, as far as it says what hangs on what."""

    name: str
    kind: str
    parent: str
    child: str
    lower: float
    upper: float
    leader: str
    """The joint that it follows; "": none."""

    @property
    def moves(self) -> bool:
        """Whether somebody drives it."""
        return self.kind in ("revolute", "continuous", "prismatic") and not self.leader

    @property
    def turns(self) -> bool:
        """Whether it may be one of an arm's: those that slide are held."""
        return self.moves and self.kind != "prismatic"

    @property
    def opens(self) -> bool:
        """Whether it looks like a finger's."""
        slides = self.kind == "prismatic" and self.upper - self.lower < FINGER_M
        return slides or bool(FINGERS.search(self.name) or JAWS.search(self.child))


def propose(path: Path) -> tuple[Robot, list[str]]:
    """Propose a robot file for a URDF; also what was chosen and nobody said.

    Raises:
        UsageError: It cannot be read, or no chain of its joints is an arm.
    """
    if not path.is_file():
        raise PathNotFoundError(path=path, what="robot description", hint="Check the path.")
    robot = Robot(
        name=path.stem,
        urdf=path.name,
        joints=(),
        mesh_folders=_mesh_folders(path),
        folder=path.absolute().parent,
    )
    lost: list[str] = []
    root = robot.parsed(robot.urdf, lost)
    joints = _joints(root)
    if len(joints) > MOST_JOINTS:
        raise UsageError(f"{path} has {len(joints)} joints; up to {MOST_JOINTS} are looked at.")
    arm, notes = _arm(joints, path)
    below = _below(arm[-1].child, joints)
    gripper, told = _gripper([each for each in below if each.kind not in ("fixed", "continuous")])
    driven = {joint.name for joint in arm} | {finger.joint for finger in gripper.fingers}
    tool_frame, unsure = _tool(arm[-1].child, below, gripper)
    base_frame, carriers = _root(arm, joints)
    proposed = replace(
        robot,
        name=re.sub(r"\W+", "_", root.get("name") or path.stem),
        joints=tuple(joint.name for joint in arm),
        base_frame=base_frame,
        tool_frame=tool_frame,
        gripper=gripper,
        held=tuple(each.name for each in joints if each.moves and each.name not in driven),
    )
    return proposed, notes + carriers + told + unsure + lost


def _mesh_folders(path: Path) -> dict[str, str]:
    """Find the folders of packages that its meshes name, among those above it and beside them."""
    text = path.read_text(errors="replace")
    folders: dict[str, str] = {}
    for package, mesh in re.findall(r"package:/{2,}([^/\"']+)/([^\"']+)", text):
        if package in (*folders, PACKAGE):
            continue
        places = [place for above in path.absolute().parents for place in (above / package, above)]
        there = next((place for place in places if (place / mesh).is_file()), None)
        if there is not None:
            folders[package] = str(there)
    return folders


def _joints(root: ET.Element) -> list[Joint]:
    found = []
    for item in root.findall("joint"):
        ends = {tag: item.find(tag) for tag in ("parent", "child", "limit", "mimic")}
        read = {tag: {} if e is None else e.attrib for tag, e in ends.items()}
        lower, upper = (number_of(read["limit"].get(key, "0")) for key in ("lower", "upper"))
        found.append(
            Joint(
                name=item.get("name", ""),
                kind=item.get("type", ""),
                parent=read["parent"].get("link", ""),
                child=read["child"].get("link", ""),
                lower=lower,
                upper=upper,
                leader=read["mimic"].get("joint", ""),
            )
        )
    return found


def _arm(joints: list[Joint], path: Path) -> tuple[list[Joint], list[str]]:
    """The joints of the longest chain that is an arm by its names, or else of the longest.

    What opens at its end is left out, and what also moves other chains at its beginning.
    """
    chains = _chains(joints)
    long = sorted((chain for chain in chains if len(chain) >= NUM_JOINTS[0]), key=_rank)
    if not long:
        most = max(chains, key=len, default=[])
        names = ", ".join(joint.name for joint in most) or "none"
        raise UsageError(
            f"{path}: no arm of {NUM_JOINTS[0]} to {NUM_JOINTS[-1]} joints was found. The longest "
            f"chain has {len(most)}: {names}."
        )
    arm, others = long[0], [chain for chain in chains if chain != long[0]]
    while len(arm) > NUM_JOINTS[0] and any(arm[0] in chain for chain in others):
        arm = arm[1:]
    arm = arm[-NUM_JOINTS[-1] :]
    held = [f"{each[0].name} to {each[-1].name} ({len(each)})" for each in long[1:]]
    return arm, [f"other chains are held: {', '.join(held)}"] if held else []


def _chains(joints: list[Joint]) -> list[list[Joint]]:
    """The joints that move each end, without what opens there; none that is part of another."""
    above = {joint.child: joint for joint in joints}
    parents = {joint.parent for joint in joints}
    chains = []
    for leaf in (joint.child for joint in joints if joint.child not in parents):
        chain, link = dict[str, Joint](), leaf
        while link in above and link not in chain:
            chain[link] = above[link]
            link = above[link].parent
        moving = [joint for joint in reversed(chain.values()) if joint.moves]
        while moving and moving[-1].opens:
            moving.pop()
        chains.append([joint for joint in moving if joint.turns])
    return [
        chain
        for index, chain in enumerate(chains)
        if chain not in chains[:index]
        and not any(len(c) > len(chain) and c[: len(chain)] == chain for c in chains)
    ]


def _rank(chain: list[Joint]) -> tuple[bool, int]:
    is_arm = sum("arm" in (joint.name + joint.child).lower() for joint in chain) > 1
    return not is_arm, -len(chain)


def _below(link: str, joints: list[Joint]) -> list[Joint]:
    """What hangs on a link, the nearest first."""
    found, links = list[Joint](), {link}
    while links:
        hung = [joint for joint in joints if joint.parent in links and joint not in found]
        found += hung
        links = {joint.child for joint in hung}
    return found


def _root(arm: list[Joint], joints: list[Joint]) -> tuple[str, list[str]]:
    """Where all hangs, and which other joints move the arm."""
    above, link, others = {joint.child: joint for joint in joints}, arm[-1].child, list[str]()
    while link in above:
        others += [above[link].name] if above[link].moves and above[link] not in arm else []
        link = above[link].parent
    return link, [f"{name} moves the arm and is held at 0" for name in others]


def _gripper(moving: list[Joint]) -> tuple[Gripper, list[str]]:
    """Two jaws that slide, where there are such; what turns or is more than two is held."""
    jaws = [joint for joint in moving if joint.kind == "prismatic" and joint.opens]
    span_m = sum(joint.upper - joint.lower for joint in jaws)
    if len(jaws) != 2 or len(moving) != 2 or not 0 < span_m < math.inf:
        names = [joint.name for joint in moving if joint.moves]
        some = ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")
        told = f"a URDF does not say how wide a gripper is, so it is held: {some}"
        return Gripper(), [told] if names else []
    fingers = []
    for jaw in (joint for joint in jaws if joint.moves):
        closed, open_ = sorted((jaw.lower, jaw.upper), key=abs)
        fingers.append(Finger(joint=jaw.name, closed=closed, per_m=(open_ - closed) / span_m))
    hands = {joint.parent for joint in jaws}
    links = (*sorted(hands), *(joint.child for joint in jaws))
    gripper = Gripper(
        links=links,
        finger_links=links[len(hands) :],
        fingers=tuple(fingers),
        max_width_m=round(span_m, 6),
    )
    return gripper, ["the gripper is taken for closed where its joints are next to 0"]


def _tool(last: str, below: list[Joint], gripper: Gripper) -> tuple[str, list[str]]:
    """The frame that is called like a tool's, else the last one that hangs fixed on the arm."""
    fixed = [joint.child for joint in _below(last, [j for j in below if j.kind == "fixed"])]
    for word in TOOLS:
        named = [name for name in fixed if word in re.split(r"[_\W]+", name.lower())]
        if named:
            return named[-1], []
    fixed = fixed or [last]
    where = "" if not gripper.fingers else "; it should lie between the pads"
    return fixed[-1], [f"no frame is named like a tool's, so {fixed[-1]} was taken{where}"]


def write_robot_file(urdf: Path, path: Path, /, *, output: Output) -> int:
    """Write a proposal beside nothing that is there."""
    if path.suffix != ".toml":
        raise UsageError(f"a robot file ends with .toml: robot-gst open {urdf} {urdf.stem}.toml")
    text = toml_of(propose(urdf)[0], str(urdf.absolute()))
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with path.open("x") as stream:
            stream.write(text)
    except FileExistsError:
        raise UsageError(f"{path} is there already; name another file.") from None
    output.say(f"{path} was written; look at it: robot-gst robot check {path}")
    return 0


def toml_of(robot: Robot, urdf: str) -> str:
    """Return the robot file's text, with a URDF's path as it is to name it."""
    lines = [
        "# A proposal made from the URDF alone; every field is explained in docs/robots.md.",
        "schema_version = 1",
        f"name = {json.dumps(robot.name)}",
        f"urdf = {json.dumps(urdf)}",
        f"base_frame = {json.dumps(robot.base_frame)}",
        f"tool_frame = {json.dumps(robot.tool_frame)}",
        f"joints = {json.dumps(robot.joints)}",
        *([f"held = {json.dumps(robot.held)}"] if robot.held else []),
        "# payload_kg = 5.0 # what it may carry; without it the gate says nothing of what is held",
        "# home_rad = [] # a posture free of contact",
        *_table("mesh_folders", robot.mesh_folders),
    ]
    gripper = robot.gripper
    if gripper.fingers:
        lines += _table(
            "gripper",
            {key: getattr(gripper, key) for key in ("links", "finger_links", "max_width_m")},
        )
    for finger in gripper.fingers:
        row = {key: getattr(finger, key) for key in ("joint", "closed", "per_m")}
        lines += _table("[gripper.fingers]", row)
    return "\n".join(lines) + "\n"


def _table(name: str, values: Mapping[str, object]) -> list[str]:
    keys = {key: key if re.fullmatch(r"[\w-]+", key) else json.dumps(key) for key in values}
    rows = [f"{keys[key]} = {json.dumps(value)}" for key, value in values.items()]
    return ["", f"[{name}]", *rows] if rows else []
