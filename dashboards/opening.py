"""What somebody's files are, what they lack for each use, how they come in, and what follows.

Heads, summaries and small texts are read; nothing is unpickled or run. Commands that import do so.
"""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from inspect import signature
from itertools import chain, islice
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from bridge.cli.exchange import import_rgbd, import_rosbag2
from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode import topics as named
from bridge.episode.catalogue import find_episodes
from bridge.episode.cdr.messages import JointSample, string_from_cdr, string_to_cdr
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import robot_description
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.exchange.driver_names import mapped
from bridge.exchange.rosbag2 import METADATA_FILE, count_messages, find_files, unpacked
from bridge.exchange.trials_csv import trials_path, trials_text
from bridge.leaves import load_leaf
from bridge.robots.robot import Robot, read_robot, robot_of, robots_with
from bridge.sources.folder.messages import find_frames, read_index
from bridge.sources.folder.scene_json import INDEX_NAME
from bridge.sources.folder.transforms import TRANSFORMS
from bridge.sources.folder.tum import find_lists
from bridge.terminal import Output
from bridge.whole_file import write_whole
from dashboards.robot_file import propose, write_robot_file
from dashboards.scene_index import is_paired, propose_index, write_index

OUTPUT = Output()
MOST_INSIDE, MOST_NAMED, MOST_EPISODES, MOST_SURVEYED = 200, 5, 50, 500
"""Things of a folder that are looked at, and that a message names; episodes that are opened, and
messages of a bag that are read."""
MOST_HEAD_BYTES, MOST_TABLE_BYTES = 1 << 16, 1 << 26
HEADS = {b"\x89MCAP0\r\n": "bag", b"SQLite format 3\0": "bag", b"#ROSBAG": "ROS 1 bag"}
HEADS |= {b"ply\n": "splat", b"ply\r": "splat"}
ENDINGS = {
    "bag": (".mcap", ".db3", ".mcap.zstd", ".db3.zstd"),
    "table": (".csv", ".tsv", ".xlsx", ".xlsm"),
    "robot description": (".urdf", ".xacro"),
    "HDF5 file": (".h5", ".hdf5"),
}
OF_BAG = (*ENDINGS["bag"], METADATA_FILE)
SPLAT_FIELDS = frozenset({"x", "f_dc_0", "opacity", "scale_0", "rot_0"})
STREAMS = (named.COLOR_IMAGE, named.COLOR_INFO, named.DEPTH_IMAGE, named.DEPTH_INFO)
JOINTS = (named.JOINT_STATES, named.GRIPPER_STATE)
IMAGES = {schema.IMAGE: "image", schema.COMPRESSED_IMAGE: "image", schema.CAMERA_INFO: "info"}
STREAM = re.compile(f"{named.CAMERAS}([^/]+)({'|'.join(STREAMS)})$")
USES = ("record", "rebuild", "replay", "evaluate")
ONLY_SEEN = "joint states and a task"


@dataclass(frozen=True, kw_only=True)
class Found:
    """What lies at a path."""

    what: str
    holds: tuple[str, ...] = ()
    record: str = "a robot and cameras that publish (docs/recording.md)"
    """What each use lacks; "": nothing."""
    rebuild: str = ""
    replay: str = ""
    evaluate: str = ""
    bring: Callable[..., int] | None = None
    """Imports it into a run."""
    then: tuple[str, ...] = ()
    """Commands that lead on."""

    def lines(self, path: Path) -> list[str]:
        """Say it to a person."""
        lines = [f"{path}: {self.what}", *(f"  {text}" for text in self.holds)]
        for use in USES:
            lack = getattr(self, use)
            lines.append(f"  {use} needs {lack}" if lack else f"  {use}: ready")
        steps = self.then or ((f"open {path} RUN",) if self.bring else ())
        typed = (step.replace(str(path), quote(str(path))) for step in steps)
        return [*lines, *(f"next: robot-gst {step}" for step in typed)]


class Survey(NamedTuple):
    """What a recording says of its topics before all of it is read."""

    types: dict[str, str]
    rates_hz: dict[str, float]  # of its first messages
    first: dict[str, bytes]


def survey(source: Path) -> Survey:
    """Look at the topics of a bag and at its first messages."""
    times, first = dict[str, list[int]](), dict[str, bytes]()
    with unpacked(find_files(source), None) as bag:
        for item in islice(bag.messages(), MOST_SURVEYED):
            times.setdefault(item.topic, []).append(item.log_time_ns)
            first.setdefault(item.topic, item.data)
        types = bag.types()
    spans = {topic: (len(t) - 1, (t[-1] - t[0]) / NS_PER_S) for topic, t in times.items()}
    rates_hz = {topic: steps / seconds for topic, (steps, seconds) in spans.items() if seconds}
    return Survey(dict(types), rates_hz, first)


def open(
    path: Path, run: Path | None = None, /, *, map: Path | None = None, output: Output = OUTPUT
) -> int:
    """Say what a file or folder of yours holds, what it lacks and what comes next; or import it.

    Bags, LeRobot datasets, RGB-D images, splats, tables of trials, runs, URDFs.
    Example: robot-gst open bags/monday runs/monday

    Args:
        path: A file or folder; without RUN it is only read.
        run: Run folder to import it into, made where needed; of a URDF the robot file to write.
        map: TOML file with options of the import (docs/exchange.md): task, robot, topics.
    """
    found = look_at(path)
    lines = found.lines(path)
    if run is None:
        record = {name: value for name, value in vars(found).items() if name != "bring"}
        output.result({"path": str(path), **record}, "\n".join(lines))
        return 0
    if found.bring is None:
        raise UsageError("\n".join([*lines, "It cannot be imported."]))
    output.say(lines[0])
    robot, options = _mapped(map, found.bring)
    code = found.bring(path, run, output=output, **options)
    if run.is_dir():
        output.say("\n".join(_run(run, robot).lines(run)))
    return code


def _mapped(file: Path | None, bring: Callable[..., int]) -> tuple[str, dict[str, Any]]:
    """The robot, where the import leaves it to replays, and the options that a map names."""
    known = signature(bring).parameters
    try:
        options = {} if file is None else tomllib.loads(file.read_text("utf-8"))
        robot = "" if "robot" in known else str(options.pop("robot", ""))
        if topics := dict(options.pop("topics", {})):
            options["remap"] = tuple(f"{old}={new}" for old, new in topics.items())
        if "config" in known:
            options = {"config": type(known["config"].default)(**options)}
        signature(bring).bind(Path(), Path(), output=OUTPUT, **options)
    except (OSError, ValueError, TypeError) as error:
        may = known["config"].default.__dict__ if "config" in known else known
        names = {*may, "robot", "topics"} - {"output", "remap", "config", "folder", "bag", "run"}
        hint = f"It may have: {', '.join(sorted(names))}; topics is a table."
        raise UsageError(f"--map {file} is not understood ({error}). {hint}") from error
    return robot, options


def look_at(path: Path) -> Found:
    """Find out what lies at a path; UsageError where it is nothing known, or several things."""
    if not path.exists():
        raise PathNotFoundError(path=path, what="file or folder", hint="Check the path.")
    kinds = kinds_of(path)
    if not kinds:
        raise _unknown(path)
    if len(kinds) > 1:
        each = " and ".join(f"a {kind}" for kind in kinds)
        raise UsageError(f"{path} is {each} at once. Put each into a folder of its own.")
    of_run = next((p for p in (path, path.parent) if p.name in ("episodes", "derived")), None)
    if of_run is not None and kinds == ["bag"]:
        raise UsageError(f"{path} is part of a run. Open that: robot-gst open {of_run.parent}")
    return KINDS[kinds[0]](path)


def kinds_of(path: Path) -> list[str]:
    """Say what a path looks like: by the first bytes of a file, by the files of a folder."""
    if path.is_dir():
        return [kind for kind, is_it in FOLDERS.items() if is_it(path)]
    if not path.is_file() or not path.stat().st_size:
        return []
    with path.open("rb") as stream:
        start = stream.read(16)
    found = [kind for magic, kind in HEADS.items() if start.startswith(magic)]
    return found or [kind for kind, ends in ENDINGS.items() if path.name.lower().endswith(ends)]


def _unknown(path: Path) -> UsageError:
    inside = sorted(islice(path.iterdir(), MOST_INSIDE)) if path.is_dir() else []
    known = [f"{each.name} ({', '.join(kinds)})" for each in inside if (kinds := kinds_of(each))]
    if known:
        return UsageError(f"{path} holds {_some(known)}. Open one: robot-gst open {path}/NAME")
    if path.name.endswith(".part"):
        return UsageError(f"{path} was not finished. Repair it: robot-gst recover {path}")
    is_empty = not inside if path.is_dir() else not path.stat().st_size
    found = "is empty" if is_empty else "is nothing known here"
    return UsageError(f"{path} {found}. Known are: {', '.join(KINDS)}.")


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return (", ".join(names[:MOST_NAMED]) or "none") + more


def _is_rgbd(folder: Path) -> bool:
    is_indexed = any((folder / name).is_file() for name in (INDEX_NAME, TRANSFORMS))
    return bool(is_indexed or find_lists(folder) or find_frames(folder))


def _is_rlds(folder: Path) -> bool:
    found = (folder.glob(f"{deep}dataset_info.json") for deep in ("", "*/", "*/*/"))
    return any(any(path.parent.glob("*.tfrecord*")) for paths in found for path in paths)


FOLDERS: dict[str, Callable[[Path], bool]] = {
    "run": lambda at: any(at.glob("episodes/*.mcap*")) or trials_path(RunFolder(at)).is_file(),
    "bag": lambda folder: any(each.name.endswith(OF_BAG) for each in folder.glob("*.*")),
    "LeRobot dataset": lambda folder: (folder / "meta/info.json").is_file(),
    "RLDS dataset": _is_rlds,
    "RGB-D folder": _is_rgbd,
    "COLMAP model": lambda folder: any(
        any(folder.glob(f"{deep}points3D.*")) for deep in ("", "sparse/", "sparse/0/")
    ),
    "RGB-D folder without an index": lambda folder: is_paired(folder) and not _is_rgbd(folder),
}


def _bag(path: Path) -> Found:
    seen = survey(path)
    names = mapped(seen.types)
    cameras, views = _cameras(seen, names)
    robot, lacks, robots = _robot(seen)
    file = (robots[0].name if len(robots) == 1 else "FILE.toml") if robot else ""
    count = count_messages(path)
    renamed = [f"{old} will be {new}" for old, new in names.items() if not old.endswith("_info")]
    return Found(
        what=f"a bag{f' of {count} messages' if count else ''}, topics: {len(seen.types)}",
        holds=(*robot, *cameras, *renamed, *_proposal(seen, names, file)),
        record="the same nodes, live (docs/recording.md, section 4)",
        rebuild="; ".join(views),
        replay="; ".join(lacks + views),
        evaluate="its task and outcome: label it when it is imported",
        bring=import_rosbag2,
    )


def _proposal(seen: Survey, names: Mapping[str, str], robot: str) -> Iterator[str]:
    """A map to fill in, of topics as they will be called and of those that are not understood."""
    topics = dict(names)
    for topic, kind in seen.types.items():
        if kind in IMAGES and not STREAM.search(names.get(topic, topic)):
            stream = "depth" if "depth" in topic else "color"
            place = re.sub(r"\W+", "_", topic.strip("/").split("/")[0])
            topics[topic] = f"{named.CAMERAS}{place}/{stream}/{IMAGES[kind]}"
        elif kind == schema.JOINT_STATE and not topic.endswith(JOINTS):
            topics[topic] = f"/NAME{named.JOINT_STATES}"
    if robot == "FILE.toml" or topics.keys() != names.keys():
        yield from ("a map for --map FILE, to be corrected:", *[f'robot = "{robot}"'] * bool(robot))
        yield from ("[topics]", *(f'"{old}" = "{new}"' for old, new in topics.items()))


def _cameras(seen: Survey, names: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """What is known of the cameras by what an episode calls topics, and what a scene lacks."""
    cameras: dict[str, dict[str, str]] = {}
    for topic in seen.types:
        place = STREAM.search(names.get(topic, topic))
        if place and not named.is_truth(topic):
            rate = f" {seen.rates_hz[topic]:.3g} Hz" if topic in seen.rates_hz else ""
            text = place[2][1:].replace("/", " ") + (rate if "image" in place[2] else "")
            cameras.setdefault(place[1], {})[place[2]] = text
    holds = [f"camera {name}: {', '.join(has.values())}" for name, has in cameras.items()]
    lacks = []
    if not any(len(has) == len(STREAMS) for has in cameras.values()):
        streams = [f"{c}{s}" for c, has in cameras.items() for s in STREAMS if s not in has]
        lacks.append(_some(streams) if streams else "a calibrated camera with colour and depth")
    if not {named.TF, named.TF_STATIC} & set(seen.types):
        lacks.append(f"where the cameras are ({named.TF}, {named.TF_STATIC})")
    return holds, lacks


def _robot(seen: Survey, asked: str = "") -> tuple[list[str], list[str], list[Robot]]:
    """What is known of the robot, what is missing, and the robots that it may be."""
    tracks = {
        topic: JointSample.from_cdr(data).names
        for topic, data in seen.first.items()
        if topic.endswith(named.JOINT_STATES) and seen.types.get(topic) == schema.JOINT_STATE
    }
    if not tracks:
        return [], [f"joint states on a topic that ends in {named.JOINT_STATES}"], []
    topic = max(tracks, key=lambda each: len(tracks[each]))
    joints = [*tracks.pop(topic), *chain(*tracks.values())]  # of others they are joined in
    urdf = seen.first.get(named.ROBOT_DESCRIPTION)
    known = [robot_of(string_from_cdr(urdf))] if urdf else []
    fits = robots_with(joints, [read_robot(asked)] if asked else known)
    name = " or ".join(robot.name for robot in fits) or "none of the robot files"
    name += ", by the names of its joints (another: --map)" if fits and not (urdf or asked) else ""
    lacks = [] if fits else ["a robot file with its joints (docs/robots.md)"]
    fingers = {joint for robot in fits for joint in robot.finger_joints}
    if not fingers & set(joints) and not any(t.endswith(named.GRIPPER_STATE) for t in seen.types):
        lacks.append(f"the gripper's width on a topic that ends in {named.GRIPPER_STATE}")
    rate = f"{seen.rates_hz.get(topic, 0.0):.3g} Hz"
    return [f"robot: {name}; {_some(joints)} at {rate} on {topic}"], lacks, fits


def _lerobot(path: Path) -> Found:
    info = load_leaf("lerobot", "read_info")(path)
    episodes = load_leaf("lerobot", "read_episodes")(info, None)
    state = info.features.get("observation.state")
    images = [key for key, each in info.features.items() if each.dtype in ("video", "image")]
    return Found(
        what=f"a LeRobot dataset {info.version}: {len(episodes)} episodes at {info.fps:g} Hz",
        holds=(
            f"robot: {info.robot_type or 'not named'}, {_some(state.names if state else ())}",
            f"cameras: {_some(images)}",
            f"tasks: {_some(sorted({task for each in episodes for task in each.tasks}))}",
        ),
        rebuild="depth images, which the format has none of",
        replay="depth images, and the gripper's width in metres",
        evaluate="" if "next.success" in info.features else "outcomes: label them when imported",
        bring=load_leaf("lerobot", "import"),
    )


def _read(read: Callable[[Path], Any], path: Path, command: str) -> Any:
    """Read, or say which command takes the options that an error asks for."""
    try:
        return read(path)
    except UsageError as error:
        raise UsageError(f"{error} Options go to: robot-gst {command}") from error


def _rgbd(path: Path) -> Found:
    index = _read(read_index, path, f"import rgbd {path} RUN")
    return Found(
        what=f"RGB-D images, {index.summary}",
        holds=tuple(f"assumed {name}: {value}" for name, value in index.assumed.items()),
        replay=ONLY_SEEN,
        bring=import_rgbd,
    )


def _splat(path: Path) -> Found:
    with path.open("rb") as stream:
        start = stream.read(MOST_HEAD_BYTES)
    line = b"end_header\r\n" if b"end_header\r\n" in start else b"end_header\n"
    head, end, _ = start.partition(line)
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    fields = [word[-1] for word in words if word[:1] == ["property"]]
    counts = [word[-1] for word in words if word[:2] == ["element", "vertex"]]
    is_splat = set(fields) >= SPLAT_FIELDS
    least = 4 * len(fields) * int(counts[0]) if counts and counts[0].isdecimal() else 0
    if not end or not least or (is_splat and path.stat().st_size < len(head + end) + least):
        raise UsageError(f"{path} ends early or has no PLY header. Copy it again from its origin.")
    return Found(
        what=f"a splat of {counts[0]} Gaussians" if is_splat else "a PLY file without Gaussians",
        rebuild="the RGB-D images that it was made of: scenes are fitted, not imported",
        replay=f"RGB-D images, {ONLY_SEEN}",
        evaluate="images and renders: robot-gst evaluate --reference DIR --renders NAME=DIR",
    )


def _table(path: Path) -> Found:
    from evaluator.compare.intake import take  # noqa: PLC0415 - only tables need what it loads

    if path.stat().st_size > MOST_TABLE_BYTES:
        raise UsageError(f"{path} is larger than any table of trials. Open what it was made of.")
    taken = _read(take, path, f"evaluate {path}")

    def keep(path: Path, run: Path, *, output: Output) -> int:
        file = trials_path(RunFolder.create(run))
        if file.exists():
            raise UsageError(f"{file} exists already. Delete it to replace it, or use another run.")
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, trials_text(taken.trials).encode())
        output.result({"file": str(file), "trials": len(taken.trials)}, f"{file}: {taken.summary}")
        return 0

    return Found(
        what=f"a table of {len(taken.trials) or len(taken.rates)} {taken.kind}",
        holds=(f"understood as {taken.summary}",),
        rebuild="recordings: a table has none",
        replay="recordings: a table has none",
        bring=keep if taken.trials else None,
        then=(f"evaluate {path}",),
    )


def _converted(kind: str, into: str, path: Path) -> Found:
    made = f"{into.format(path=path, stem=path.stem)} makes one: open that"
    return Found(what=f"{kind}, not read here", rebuild=made, replay=made, evaluate=made)


def _run(path: Path, robot_file: str = "") -> Found:
    """What a run holds and lacks, and the commands from there to a page with numbers."""
    run = RunFolder.open(path)
    entries, seen = find_episodes(run), _survey(run)
    cameras, views = _cameras(seen, {})
    robot, lacks, robots = _robot(seen, robot_file)
    has_scene, has_table = (run.scene_dir / "scene.json").is_file(), trials_path(run).is_file()
    trials = [e for e in entries if not e.error and e.kind in ("trial", "imported")]
    unknown = [entry for entry in trials if entry.outcome == "unknown"]
    broken = [entry.id for entry in entries if entry.error]
    steps = [f"recover {path}"] * bool(run.unfinished())
    steps += [f"rebuild {path}"] * (not views and not has_scene)
    task = " --task NAME" if unknown and unknown[0].kind == "imported" else ""
    if unknown and (views or robots or not task):
        steps.append(f"label {path} {unknown[0].id}{task} --result success")
    if trials and not lacks and not views:
        guess = robots[0].name if len(robots) == 1 else "NAME"  # as many robots have such joints
        which = robot_file or ("" if named.ROBOT_DESCRIPTION in seen.types else guess)
        steps.append(f"replay {path}" + (f" --robot {which}" if which else ""))
    steps += [f"evaluate {path}"] * bool(trials or has_table or has_scene or not views)
    more = [f"unreadable: {_some(broken)}"] * bool(broken)
    more += ["a scene"] * has_scene + ["a table of trials"] * has_table
    return Found(
        what=f"a run of {len(entries)} episode{'' if len(entries) == 1 else 's'}",
        holds=(*more, *robot, *cameras),
        rebuild="; ".join(views),
        replay="; ".join(lacks + views),
        evaluate=f"task and outcome of {len(unknown)} of {len(trials)} trials" if unknown else "",
        then=(*steps, f"dashboard {path}"),
    )


def _survey(run: RunFolder) -> Survey:
    """The topics of a run's first episodes, as those of one recording."""
    seen = Survey({}, {}, {})
    for path in run.episodes()[:MOST_EPISODES]:
        with suppress(GstError):  # ls and check say what is wrong with it
            episode = Episode.open(path)
            if named.ROBOT_DESCRIPTION not in seen.types and (urdf := robot_description(episode)):
                seen.types[named.ROBOT_DESCRIPTION] = schema.STRING
                seen.first[named.ROBOT_DESCRIPTION] = string_to_cdr(urdf)
            for topic, about in episode.topics().items():
                if topic not in seen.types and about.count:
                    seen.types[topic] = about.type_name
                    seen.rates_hz[topic] = about.count / max(episode.duration_s, 1e-9)
                    seen.first[topic] = next(episode.messages([topic])).data
    return seen


def _description(path: Path) -> Found:
    robot, notes = propose(path)
    fingers = ", ".join(robot.finger_joints)
    opens = f"{fingers}, 0 to {robot.gripper.max_width_m:g} m" if fingers else "none"
    return Found(
        what=f"a robot description with an arm of {len(robot.joints)} joints",
        holds=(
            f"joints: {', '.join(robot.joints)}",
            f"base {robot.base_frame}, tool {robot.tool_frame}, gripper {opens}",
            *notes,
        ),
        rebuild="images of a cell",
        replay="trials, recorded with it or replayed with --robot FILE.toml",
        evaluate="trials",
        bring=write_robot_file,
        then=(f"robot check {path}", f"open {path} {path.stem}.toml"),
    )


def _unindexed(path: Path) -> Found:
    _, notes = propose_index(path)
    return Found(
        what="colour and depth images in folders of their own",
        holds=tuple(notes),
        rebuild=f"an index: robot-gst open {path} {path / INDEX_NAME} writes it",
        replay=f"an index, {ONLY_SEEN}",
        evaluate="trials",
        bring=write_index,
        then=(f"open {path} {path / INDEX_NAME}",),
    )


KINDS: dict[str, Callable[[Path], Found]] = {
    "run": _run,
    "bag": _bag,
    "LeRobot dataset": _lerobot,
    "RGB-D folder": _rgbd,
    "RGB-D folder without an index": _unindexed,
    "COLMAP model": partial(
        _converted,
        "a COLMAP model",
        "depth images and transforms.json; ns-process-data --skip-colmap of nerfstudio",
    ),
    "splat": _splat,
    "table": _table,
    "robot description": _description,
    "ROS 1 bag": partial(
        _converted, "a ROS 1 bag", "a ROS 2 bag; rosbags-convert --src {path} --dst {stem}"
    ),
    "RLDS dataset": partial(
        _converted, "an RLDS dataset", "a LeRobot dataset; openx2lerobot of any4lerobot"
    ),
    "HDF5 file": partial(
        _converted,
        "an HDF5 file (ALOHA, robomimic)",
        "a LeRobot dataset; convert_aloha_data_to_lerobot.py of openpi, or a script like it,",
    ),
}
